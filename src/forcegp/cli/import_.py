"""`forcegp import`: from the log of any program to a data set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from forcegp.cli.common import (
    AsJson,
    RobotName,
    SceneOrNone,
    check_apart,
    check_robot_named,
    progress_bar,
    show,
    system_of,
)

if TYPE_CHECKING:
    from forcegp.constraints import ConstrainedSystem
    from forcegp.logs import Imported


def import_(
    log: Annotated[Path, typer.Argument(help="Log file or folder.")],
    scene: SceneOrNone = None,
    robot: RobotName = None,
    mapping: Annotated[
        str | None, typer.Option("--mapping", "-m", help="Mapping file, or the name of a bundled one.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Where the data set goes (.parquet).")
    ] = None,
    guess: Annotated[
        Path | None, typer.Option(help="Write a mapping to this file for you to check, and import nothing.")
    ] = None,
    fit_surface: Annotated[
        Literal["plane", "sphere"] | None,
        typer.Option(help="Fit a surface to the path of each contact, and propose it for the scene."),
    ] = None,
    tip_radius: Annotated[
        str | None,
        typer.Option(
            help="With --fit-surface: radius in metres of a ball that ends at the scene's point, or fit; "
            "default: the scene's tip."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Import a log: CSV, text, Parquet, NumPy, MATLAB, HDF5, ROS bags, MCAP or LeRobot.

    A mapping in TOML says which column is which joint, with units, signs and frames; --guess writes one.

    [bold]Examples[/bold]

    forcegp import run.csv --scene my_scene.toml --guess mapping.toml

    forcegp import run.csv --scene my_scene.toml --mapping mapping.toml --out log.parquet

    forcegp import run.bag --robot ur3.urdf --mapping ur3_bag --out log.parquet
    """
    from forcegp.destination import check_destination, write_or_keep
    from forcegp.errors import ForceGPError
    from forcegp.logs import import_log

    check_robot_named(scene, robot)
    if guess is not None:
        check_destination(guess)
        check_apart(guess, log)
        show(_guess(log, system_of(scene, robot), guess), as_json)
        return
    if out is None or out.suffix.lower() != ".parquet":
        raise ForceGPError("the data set has no place to go", expected="--out log.parquet", got=out)
    check_destination(out)
    check_apart(out, log)
    system = system_of(scene, robot)
    with progress_bar(f"reading {log.name}", 1) as advance:
        imported = import_log(log, system, mapping, progress=advance)
    write_or_keep(imported.data.write, out)
    result = _json(imported) if as_json else _summary(imported)
    if fit_surface is not None:
        result |= _surfaces(imported, system, fit_surface, _tip_radius(tip_radius))
    show(result | {"file": str(out)}, as_json)


def _guess(log: Path, system: ConstrainedSystem, out: Path) -> dict[str, object]:
    from forcegp.destination import write_or_keep
    from forcegp.files import write_text
    from forcegp.logs.guess import guess_mapping

    with progress_bar(f"looking at {log.name}", 1) as advance:
        guessed = guess_mapping(log, system, progress=lambda done, total: advance(done, total))
    write_or_keep(lambda path: write_text(path, guessed.toml), out)
    doubts = {f"doubt_{i + 1}": text for i, text in enumerate(guessed.doubts)}
    return {"mapping": str(out), **doubts, "next": f"check {out}, then import with --mapping {out}"}


def _summary(imported: Imported) -> dict[str, object]:
    """Rows, trajectories and period, then what was found and done."""
    data, report = imported.data, imported.report
    result: dict[str, object] = {
        "rows": f"{len(data)} from {report.rows_read} logged",
        "segments": int(data.segment[-1]) + 1,
        "period_s": data.header.dt,
    }
    result |= {f"found_{i + 1}": finding.message for i, finding in enumerate(report.findings)}
    return result | {f"step_{i + 1}": step for i, step in enumerate(report.steps)}


def _tip_radius(text: str | None) -> float | Literal["fit"] | None:
    """The radius of the tip as it was given.

    Raises:
        ForceGPError: neither a length nor `fit`.
    """
    from forcegp.errors import ForceGPError

    if text is None or text == "fit":
        return text
    try:
        radius = float(text)
    except ValueError:
        radius = -1.0
    if not 0.0 <= radius < float("inf"):
        raise ForceGPError("no such radius of the tip", expected="a length in metres, or fit", got=text)
    return radius


def _surfaces(
    imported: Imported,
    system: ConstrainedSystem,
    kind: Literal["plane", "sphere"],
    tip_radius: float | Literal["fit"] | None,
) -> dict[str, object]:
    """The surface of each contact that was closed, as a line for the scene."""
    from forcegp.logs.surface_fit import fit_surface

    touched = [name for name, closed in imported.data.contact.items() if bool(closed.any())]
    fits = {name: fit_surface(imported.data, system, name, kind, tip_radius) for name in touched}
    return {name: fit.toml().strip() for name, fit in fits.items()}


def _json(imported: Imported) -> dict[str, object]:
    from dataclasses import asdict

    data, report = imported.data, imported.report
    return {
        "format": report.format,
        "rows_read": report.rows_read,
        "rows": len(data),
        "segments": len(data.segment.unique()),
        "period_s": data.header.dt,
        "noise_std": data.header.noise_std,
        "contacts": [asdict(evidence) for evidence in imported.contacts],
        "findings": [asdict(finding) for finding in report.findings],
        "steps": report.steps,
    }
