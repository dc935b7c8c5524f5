"""`forcegp reproduce`: the paper's experiments, end to end."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from forcegp.cli.common import AsJson, progress_bar, show


def reproduce(
    profile: Annotated[
        Literal["quick", "paper"], typer.Option(help="A few minutes, or the paper's sizes.")
    ] = "quick",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the page and its data.")] = Path("out"),
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Simulate the paper's task, select data, fit all models, and write a page with the results.

    [bold]Examples[/bold]

    forcegp reproduce

    forcegp reproduce --profile paper --out out/paper --seed 1
    """
    from forcegp.paper.reproduce import run

    def say(line: str) -> None:
        typer.echo(line, err=True)

    show(run(profile, out, seed=seed, progress=progress_bar, say=say).summary(), as_json)
