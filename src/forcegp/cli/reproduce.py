"""`forcegp reproduce`: the paper's experiments, end to end."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from forcegp.cli.common import AsJson, progress_bar, show


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

    [bold]Examples[/bold]

    forcegp reproduce

    forcegp reproduce --profile paper --out out/paper --seed 1

    forcegp reproduce --profile paper-exact --out out/paper-exact

    forcegp reproduce --profile large --out out/large

    forcegp reproduce --profile real-contact --out out/real-contact
    """
    from forcegp.paper.parallel import MOST_PROCESSES, available_processors

    def say(line: str) -> None:
        typer.echo(line, err=True)

    if profile == "real-contact":
        from forcegp.paper.real_contact_page import run_real_contact

        show(run_real_contact(out, seed=seed, progress=progress_bar, say=say).summary(), as_json)
        return
    from forcegp.paper.reproduce import run

    processes = processes or min(available_processors(), MOST_PROCESSES)
    made = run(profile, out, seed=seed, processes=processes, progress=progress_bar, say=say)
    show(made.summary(), as_json)
