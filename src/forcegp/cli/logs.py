"""`forcegp import`, `check` and `select`: convert a log to a data set, find faults, and select points."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

import forcegp
from forcegp.cli import common
from forcegp.cli.common import Verbatim, progress_bar, save, say, show
from forcegp.cli.options import AsJson, Differentiate, RobotName, SceneOrNone
from forcegp.errors import ForceGPError

if TYPE_CHECKING:
    from forcegp.checks import Finding, Report
    from forcegp.data.selection import Split
    from forcegp.logs import Imported


def import_(
    log: Annotated[Path, Argument(help="Log file or folder.")],
    scene: SceneOrNone = None,
    robot: RobotName = None,
    mapping: Annotated[
        str | None, Option("--mapping", "-m", help="Mapping file, or name of a bundled mapping.")
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", writable=True, help="Output file for the data set (.parquet).")
    ] = None,
    guess: Annotated[
        Path | None, Option(writable=True, help="Write a proposed mapping to this file instead of importing.")
    ] = None,
    fit_surface: Annotated[
        Literal["plane", "sphere"] | None,
        Option(help="Fit a surface to the path of each contact point and propose it for the scene."),
    ] = None,
    tip_radius: Annotated[
        str | None,
        Option(
            help="With --fit-surface: radius of a rounded tip that ends at the scene's point, in metres, or "
            "'fit' to estimate it; default: the radius in the scene."
        ),
    ] = None,
    recording: Annotated[
        str | None, Option(help="Name of the recording; default: that of the log with its hash.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Import a log from a CSV, text, Parquet, NumPy, MATLAB, HDF5, ROS bag, MCAP or LeRobot file.

    A mapping file in TOML assigns columns to joints and states their units, signs and frames. With --guess,
    the command proposes a mapping file.

    **Examples**

    forcegp import run.csv --scene my_scene.toml --guess mapping.toml

    forcegp import run.csv --scene my_scene.toml --mapping mapping.toml --out log.parquet

    forcegp import run.bag --robot ur3.urdf --mapping ur3_bag --out log.parquet
    """
    from forcegp.destination import check_destination
    from forcegp.logs import import_log

    place = guess or out
    if place is None or (guess is None and place.suffix.lower() != ".parquet"):
        raise ForceGPError("no output path was given", expected="--out log.parquet", got=out)
    check_destination(place)
    common.check_robot_named(scene, robot)
    system = common.system_of(scene, robot)
    if guess is not None:
        show(_guess(log, system, guess), as_json)
        return
    with progress_bar(f"reading {log.name}", 1) as advance:
        imported = import_log(log, system, mapping, advance, displaced=fit_surface is not None)
    data = imported.data if recording is None else imported.data.named(recording)
    save(data.write, place)
    result = _json(imported) if as_json else _summary(imported)
    if fit_surface is not None:
        result |= _surfaces(imported, system, fit_surface, _tip_radius(tip_radius))
    show(result | {"file": str(place)}, as_json)


def _guess(log: Path, system: forcegp.ConstrainedSystem, out: Path) -> dict[str, object]:
    from forcegp.files import write_text
    from forcegp.logs.guess import guess_mapping

    with progress_bar(f"reading {log.name}", 1) as advance:
        guessed = guess_mapping(log, system, progress=advance)
    save(lambda path: write_text(path, guessed.toml()), out)
    doubts = {f"doubt_{i + 1}": text for i, text in enumerate(guessed.doubts)}
    step = f"fill in [{'] and ['.join(guessed.incomplete)}] in" if guessed.incomplete else "check"
    if guessed.left_out:
        doubts["not_read"] = guessed.left_out.removeprefix("; not read: ")
    return {"mapping": str(out), **doubts, "next": f"{step} {out}, then import with --mapping {out}"}


def _summary(imported: Imported) -> dict[str, object]:
    """Return the numbers of rows and trajectories and the period, then findings and processing steps."""
    data, report = imported.data, imported.report
    rows, segments = f"{len(data)} from {report.rows_read} logged", int(data.segment[-1]) + 1
    result: dict[str, object] = {"rows": rows, "segments": segments, "period_s": data.header.dt}
    result |= {f"found_{i + 1}": finding.message for i, finding in enumerate(report.findings)}
    return result | {f"step_{i + 1}": step for i, step in enumerate(report.steps)}


def _tip_radius(text: str | None) -> float | Literal["fit"] | None:
    """Parse the radius of the tip."""
    if text is None or text == "fit":
        return text
    with suppress(ValueError):
        if 0.0 <= float(text) < float("inf"):
            return float(text)
    raise ForceGPError("invalid tip radius", expected="a length in metres, or fit", got=text)


def _surfaces(
    imported: Imported,
    system: forcegp.ConstrainedSystem,
    kind: Literal["plane", "sphere"],
    tip_radius: float | Literal["fit"] | None,
) -> dict[str, object]:
    """Return the fitted surface of each contact that was closed, as a line for the scene file."""
    from forcegp.logs.surface_fit import fit_surface

    touched = [name for name, closed in imported.data.contact.items() if bool(closed.any())]
    fits = ((name, fit_surface(imported.data, system, name, kind, tip_radius)) for name in touched)
    return {name: Verbatim(fit.toml().strip()) for name, fit in fits}


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


NOT_USABLE = 1
"""Exit code if a finding makes a fit worthless."""
COLOURS = {"error": "red", "warning": "yellow", "note": "cyan"}
FIRST, TABLES = 3, ("faults-hidden",)
"""Number of findings that are printed without --all, and kinds of findings that are not, which are tables."""


def check(
    data: Annotated[
        list[Path],
        Option("--data", "-d", help="Log (.parquet or .csv), or several; NaN and gaps become findings."),
    ],
    scene: SceneOrNone = None,
    robot: RobotName = None,
    out: Annotated[
        Path | None, Option("--out", "-o", writable=True, help="HTML page with a plot of each finding.")
    ] = None,
    every: Annotated[bool, Option("--all", help="Print all findings, and not only the first three.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check a log against a scene before fitting: clock, units, signs, masses, contact, noise and motion.

    The last line is the verdict. The exit code is 0 if a model can be fitted, 1 if a finding makes a fit
    worthless, and 2 if the scene or the log cannot be read.

    **Examples**

    forcegp check --scene kuka_plane --data run.parquet

    forcegp check --robot ur3.urdf -d run.parquet --out check.html --json
    """
    from threadpoolctl import threadpool_limits

    from forcegp import checks
    from forcegp.destination import check_destination

    if out is not None and len(data) > 1:
        text, hint = "a page shows one log", "check the logs one by one, or leave out --out"
        raise ForceGPError(text, expected="one --data", got=f"{len(data)}", hint=hint)
    if out is not None:
        check_destination(out)
    system, reports = common.system_of(scene, robot), {}
    for path in data:
        log = checks.read_log(path)
        # Matrices are small, so BLAS threads cost more than they save, and concurrent checks would compete.
        with progress_bar("checking", 1) as progress, threadpool_limits(1, user_api="blas"):
            reports[path] = report = checks.check(system, log, progress=progress)
        if out is not None:
            from forcegp.report.check import write_check

            title = f"{path} on {scene or robot}"
            save(
                lambda to, title=title, report=report, log=log: write_check(to, title, report, system, log),
                out,
            )
        if not as_json:
            if len(data) > 1:
                say(path, "log: ", bold=True)
            _print(report, every, out)
            if out is not None:
                say(out, "page: ")
            say("", report.verdict, bold=True)
    if as_json:
        each = [{**report.to_dict(), "page": str(out) if out else None} for report in reports.values()]
        logs = [{"data": str(path), **one} for path, one in zip(reports, each, strict=True)]
        show(each[0] if len(each) == 1 else {"logs": logs}, as_json)
    if not all(report.usable for report in reports.values()):
        raise typer.Exit(NOT_USABLE)


def _print(report: Report, every: bool, page: Path | None) -> None:
    """Print the first or all findings, one paragraph each, and count the others."""
    texts = [finding for finding in report.findings if finding.kind not in TABLES]
    shown = report.findings if every else texts[:FIRST]
    for finding in shown:
        say(_paragraph(finding, report), f"{finding.severity}: ", fg=COLOURS[finding.severity])
    counts = Counter(finding.severity for finding in report.findings) - Counter(f.severity for f in shown)
    if counts:
        more = ", ".join(f"{n} {severity}{'s' * (n > 1)}" for severity, n in counts.items())
        say(f"also {more}: {f'see {page}, or ' if page else ''}pass --all")
    for reason in dict.fromkeys(report.skipped.values()):
        names = ", ".join(name for name, why in report.skipped.items() if why == reason)
        say(f"not checked: {names} ({reason})")


def _paragraph(finding: Finding, report: Report) -> str:
    """Return a finding as one paragraph, which starts with its joints."""
    from forcegp.rows import describe

    named = [joint for joint in finding.joints if joint not in finding.message]
    everywhere = len(named) == len(report.joint_names) > 1
    where = "all joints: " if everywhere else f"{', '.join(named)}: " * bool(named)
    part = finding.intervals != ((0, report.samples),) and describe(finding.intervals) not in finding.message
    rows = f", {describe(finding.intervals, most=2)}" if part else ""
    return f"{where}{finding.message} → {finding.remedy} [{' or '.join(finding.kinds)}{rows}]"


ORDER_LOST = (
    "the points are not evenly spaced in time, which delays, averages over time and friction memory require: "
    "use --method even"
)
"""Note about points that are not evenly spaced."""


def select(
    log: Annotated[Path, Argument(help="Data set to select from (.parquet or .csv).")],
    count: Annotated[int, Option("--count", "-n", min=1, help="Number of training points.")],
    out: Annotated[
        Path, Option("--out", "-o", writable=True, help="Output file for the training points (.parquet).")
    ],
    rest: Annotated[
        Path | None, Option(writable=True, help="Output file for the test points (.parquet).")
    ] = None,
    split: Annotated[
        Literal["selection", "stretches"],
        Option(help="Test on all unselected points (as in the paper) or on held-out stretches."),
    ] = "selection",
    stretch: Annotated[float, Option(help="Duration of a held-out stretch in seconds.")] = 3.0,
    fraction: Annotated[float, Option(help="Fraction of the motion to hold out.")] = 0.2,
    margin: Annotated[
        float, Option(help="Gap between held-out stretches and training points in seconds.")
    ] = 0.0,
    method: Annotated[
        Literal["farthest", "even", "random"], Option(help="Method for selecting training points.")
    ] = "farthest",
    keep_impacts: Annotated[
        bool, Option("--keep-impacts", help="Keep rows that are marked as close to an impact.")
    ] = False,
    differentiate: Differentiate = None,
    seed: Annotated[int, Option(help="Seed for held-out stretches and random selection.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Select training points that cover a log, and keep the rest for testing.

    By default, points are selected by exact farthest-point sampling of standardized positions, velocities
    and torques. The points are deterministic and in the order of selection, so that the first k rows are
    those selected for k points.

    **Examples**

    forcegp select run.parquet -n 1000 --out train.parquet --rest test.parquet

    forcegp select run.csv -n 400 --split stretches --differentiate 11 -o train.parquet --rest test.parquet
    """
    from forcegp.data import split_by_selection, split_by_stretches, without_marked_impacts
    from forcegp.rows import describe

    for path in (out, rest):
        if path is not None:
            common.check_data_destination(path)
    whole = common.read_data(log, differentiate=differentiate)
    data = whole if keep_impacts else without_marked_impacts(whole)
    held_out = {"stretch": stretch, "fraction": fraction, "margin": margin}
    with progress_bar("selecting points", count) as progress:
        if split == "selection":
            parts = split_by_selection(data, count, method=method, seed=seed, progress=progress)
        else:
            parts = split_by_stretches(data, count, **held_out, method=method, seed=seed, progress=progress)
    how = f"of {len(data)} rows by {method} points, split by {split}, seed {seed}"
    result = _written(data, parts, how, out, rest)
    if parts.stretches:
        rows = [list(rows) for rows in parts.stretches]
        result["held_out_rows"] = rows if as_json else describe(tuple(parts.stretches)).split(" ", 1)[1]
    if method == "random":
        result["note"] = ORDER_LOST
    if len(data) < len(whole):
        result["rows_at_impacts_left_out"] = len(whole) - len(data)
    show(result, as_json)


def _written(
    data: forcegp.Dataset, parts: Split, how: str, out: Path, rest: Path | None
) -> dict[str, object]:
    """Write training and test points, and return a summary."""
    result: dict[str, object] = {}
    files = ("selected", "training", parts.train, out), ("kept", "test", parts.test, rest)
    for done, kind, rows, path in files:
        if path is not None:
            step = f"{done} {len(rows)} {kind} points {how}"
            points = _split_at_gaps(data[rows]) if parts.stretches and kind == "test" else data[rows]
            save(points.with_step(step).write, path)
            result |= {f"{kind}_points": len(rows), f"{kind}_file": str(path)}
    return result


def _split_at_gaps(data: forcegp.Dataset) -> forcegp.Dataset:
    """Number the trajectories so that a new one begins after each gap, as in an import."""
    import torch

    from forcegp.logs.clock import GAP_STEPS

    steps = data.t.diff()
    new = (data.segment.diff() != 0) | (steps > GAP_STEPS * steps.median())
    return data.replace(segment=torch.nn.functional.pad(new.cumsum(0), (1, 0)))
