"""`forcegp check`: is a log fit for a model?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from forcegp.cli.common import AsJson, RobotName, SceneOrNone, check_apart, progress_bar, show, system_of

if TYPE_CHECKING:
    from forcegp.checks import Report

NOT_USABLE = 1
"""Exit code where a finding makes a fit worthless."""
COLOURS = {"error": "bold red", "warning": "yellow", "note": "cyan"}


def check(
    data: Annotated[
        Path, typer.Option("--data", "-d", help="Log, .parquet or .csv; NaN and gaps are findings.")
    ],
    scene: SceneOrNone = None,
    robot: RobotName = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="HTML page with a picture of each finding.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check a log against a scene before fitting: clock, units, signs, masses, contact, noise, motion.

    The last line says whether to go on. The exit code is 0 where a model can be fitted, 1 where a finding
    makes a fit worthless, and 2 where scene or log cannot be read.

    [bold]Examples[/bold]

    forcegp check --scene kuka_plane --data run.parquet

    forcegp check -s my_scene.toml -d run.parquet --out check.html --json

    forcegp check --robot ur3.urdf --data run.parquet
    """
    from threadpoolctl import threadpool_limits

    from forcegp.checks import check as run
    from forcegp.checks import read_log
    from forcegp.destination import check_destination, write_or_keep

    if out is not None:
        check_destination(out)
        check_apart(out, data)
    system = system_of(scene, robot)
    log = read_log(data)
    # Matrices are small: threads of BLAS cost more than they save, and two checks at once would fight.
    with progress_bar("checking", 1) as progress, threadpool_limits(1, user_api="blas"):
        report = run(system, log, progress=progress)
    if out is not None:
        from forcegp.report.check import write_check

        title = f"{data} on {scene or robot}"
        write_or_keep(lambda path: write_check(path, title, report, system, log), out)
    if as_json:
        show({**report.to_dict(), "page": str(out) if out else None}, as_json)
    else:
        _print(report)
        typer.echo(f"page: {out}" if out else "", nl=out is not None)
        typer.secho(report.verdict, bold=True)
    if not report.usable:
        raise typer.Exit(NOT_USABLE)


def _print(report: Report) -> None:
    """The findings as a table."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from forcegp.checks.log import describe

    if report.findings:
        table = Table(box=None, pad_edge=False)
        for heading in ("severity", "kind", "rows", "finding and remedy"):
            table.add_column(heading, no_wrap=heading in ("severity", "kind"), overflow="fold")
        for finding in report.findings:
            whole = finding.intervals == ((0, report.samples),)
            rows = (
                "all"
                if whole
                else describe(finding.intervals, most=2).removeprefix("rows ").removeprefix("row ")
            )
            # Joint and parameter names may hold brackets, which are no markup.
            body = Text(f"{finding.message}\n").append(f"→ {finding.remedy}", style="dim")
            kinds = "\nor ".join(finding.kinds)
            table.add_row(Text(finding.severity, style=COLOURS[finding.severity]), kinds, rows, body)
        Console().print(table)
    for name, reason in report.skipped.items():
        typer.echo(f"not checked: {name} ({reason})")
