"""`python -m reproduction`: the paper's experiments, end to end."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from forcegp.cli import main
from forcegp.cli.common import progress_bar, show
from forcegp.cli.options import AsJson

app = typer.Typer(
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command()
def reproduce(
    profile: Annotated[
        Literal["quick", "paper", "paper-exact", "large", "real-contact"],
        typer.Option(
            help="quick: a few minutes; paper: the paper's sizes; paper-exact: also the paper's models and "
            "settings; large: all samples of a ten-minute log; real-contact: from a log in CSV to the "
            "contact force, on scenes whose contact MuJoCo's solver makes."
        ),
    ] = "quick",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the page and its data.")] = Path("out"),
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    processes: Annotated[
        int | None,
        typer.Option(min=1, help="Stages run at the same time. By default, one per processor, at most 8."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate the paper's task, select data, fit all models, and write a page with the results.

    Finished stages with unchanged inputs are not run again.

    **Examples**

    python -m reproduction --profile quick --out out/quick

    python -m reproduction --profile paper --out out/paper --seed 1
    """
    from reproduction.real_contact_page import run_real_contact
    from reproduction.stages import MOST_PROCESSES, available_processors
    from reproduction.study import run

    processes = processes or min(available_processors(), MOST_PROCESSES)
    with progress_bar(f"{processes} processes", 1) as advance:

        def say(line: str, done: int, total: int) -> None:
            typer.echo(line, err=True)
            advance(done, total)

        if profile == "real-contact":
            numbers = run_real_contact(out, seed=seed, processes=processes, say=say)
        else:
            numbers = run(profile, out, seed=seed, processes=processes, say=say).summary()
    show(numbers, as_json)


if __name__ == "__main__":
    main(app)
