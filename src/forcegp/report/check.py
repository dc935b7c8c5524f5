"""Page on a checked log: the verdict, and each finding with a plot of the affected columns and rows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp import dynamics
from forcegp.checks import KINDS, Finding, Log, Report
from forcegp.checks.contact import tip_path
from forcegp.checks.log import Array, of_robot
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.files import write_text
from forcegp.plots import unit
from forcegp.report.page import INK, OTHER, Picture, draw, render
from forcegp.rows import describe

COLOURS = {"error": "#a1121f", "warning": "#d08c00", "note": "#0072b2"}
POINTS = 1500
"""Maximum number of points in a curve. More could not be distinguished on a page."""
CONTEXT = 3.0
"""Number of surrounding rows shown, relative to the length of the interval."""
LEAST_ROWS = 200
JOINTS, FEW = 7, 3
"""Maximum number of joints shown for a finding that names joints, and for one that names none."""
SIZE = (12.0, 1.35)
"""Width of a plot, and height of each panel [inch]."""

Paint = Callable[[Axes, Log, slice, int], None]


def _axis(log: Log) -> tuple[Array, str]:
    """Return the time since the first row [s], or row numbers if it is not monotonic, and the axis label."""
    runs = bool(log.header.ordered and np.isfinite(log.t).all() and (np.diff(log.t) >= 0.0).all())
    return (log.t - log.t[0], "time [s]") if runs and len(log) else (np.arange(float(len(log))), "row")


def draw_overview(report: Report, log: Log) -> Picture:
    """Draw the time intervals of each finding in a separate lane."""
    x, name = _axis(log)

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for lane, finding in enumerate(reversed(report.findings)):
            least = (x[-1] - x[0]) / 300.0
            spans = [(x[a], max(x[b - 1] - x[a], least)) for a, b in finding.intervals]
            axes.broken_barh(spans, (lane - 0.35, 0.7), color=COLOURS[finding.severity], linewidth=0)
        lanes = [" or ".join(finding.kinds) for finding in reversed(report.findings)]
        axes.set_yticks(range(len(lanes)), lanes)
        axes.set_xlim(x[0], x[-1])
        axes.set_xlabel(name)

    kinds = ", ".join(" or ".join(finding.kinds) for finding in report.findings)
    size = (SIZE[0], 0.7 + 0.22 * len(report.findings))
    return draw(paint, size, f"Times affected by each finding: {kinds}")


def picture_of(finding: Finding, system: ConstrainedSystem, log: Log) -> Picture | None:
    """Return the plot for a finding, chosen by its family, or `None` for findings about the import."""
    rows, family = _window(finding, log), KINDS[finding.kind].family
    if family == "import":
        return None
    if family.startswith("contact") and finding.contact is not None:
        return _contact(finding, system, log, rows)
    joints = [log.joint_names.index(name) for name in finding.joints][:JOINTS] or _largest(log)
    column = next((name for name in ("tau", "qdd", "qd", "q") if f"{name}." in finding.message), None)
    whole = rows.stop - rows.start > 0.9 * len(log)
    paint, quantity = _column(column or "q"), column or "q"
    if family in ("torque", "mechanics", "learned"):
        paint, quantity = _torque(system, log, rows), "tau"
    elif finding.kind in ("torque-saturated", "torque-limit"):
        paint, quantity = _column("tau"), "tau"
    elif finding.kind == "acceleration-mismatch" or finding.message.startswith("qdd "):
        paint, quantity = _rates("qd", "qdd"), "qdd"
    elif family == "kinematics" or finding.message.startswith("qd "):
        paint, quantity = _rates("q", "qd"), "qd"
    elif finding.kind == "impact":
        paint, quantity = _column("qd"), "qd"
    elif family == "clock":
        joints, paint, quantity = [0], _steps, "time step"
    elif family == "noise":
        paint, quantity = _acceleration, "qdd"
    if whole and paint.__name__ == "rates":  # plotting the whole log would hide how the two curves differ
        rows = slice(rows.start, rows.start + max(LEAST_ROWS, len(log) // 20))
    return _panels(finding, system, log, rows, joints, paint, quantity)


def _window(finding: Finding, log: Log) -> slice:
    """Return the rows of the first interval with some context, or all rows if there is no interval."""
    start, stop = finding.intervals[0] if finding.intervals else (0, len(log))
    margin = max(LEAST_ROWS, round(CONTEXT * (stop - start))) // 2
    return slice(max(start - margin, 0), min(stop + margin, len(log)))


def _largest(log: Log) -> list[int]:
    """Return the joints with the largest torques."""
    return sorted(np.argsort(-np.nan_to_num(np.nanmean(log.tau**2, axis=0)))[:FEW].tolist())


def _panels(
    finding: Finding,
    system: ConstrainedSystem,
    log: Log,
    rows: slice,
    joints: list[int],
    paint: Paint,
    quantity: str,
) -> Picture:
    """Return a plot with one panel per joint, in which the rows of the finding are shaded."""

    def fill(figure: Figure) -> None:
        panels = figure.subplots(len(joints), 1, sharex=True, squeeze=False)[:, 0]
        for axes, j in zip(panels, joints, strict=True):
            _shade(axes, finding, rows, log)
            paint(axes, log, rows, j)
            axes.set_ylabel(f"{quantity} [{unit(quantity, [system.robot.joint_types[j]]) or 's'}]")
            axes.margins(x=0.0)
            if quantity != "time step":
                axes.set_title(log.joint_names[j], loc="left")
        panels[-1].set_xlabel(_axis(log)[1])

    names = ", ".join(log.joint_names[j] for j in joints)
    alt = f"{quantity} of {names} in rows {rows.start} to {rows.stop - 1}: {finding.message}"
    return draw(fill, (SIZE[0], 0.5 + SIZE[1] * len(joints)), alt)


def _shade(axes: Axes, finding: Finding, rows: slice, log: Log) -> None:
    if finding.intervals == log.all_rows:
        return
    x = _axis(log)[0]
    for a, b in finding.intervals:
        if a < rows.stop and b > rows.start:
            ends = x[max(a, rows.start)], x[min(b, rows.stop) - 1]
            axes.axvspan(*ends, color=COLOURS[finding.severity], alpha=0.18, linewidth=1.0)


def _line(axes: Axes, log: Log, rows: slice, y: Array, colour: str = INK, name: str | None = None) -> None:
    """Draw a curve over time. A long curve is reduced to the minimum and maximum in each bin."""
    x = _axis(log)[0][rows]
    if len(y) > POINTS:
        width = -(-len(y) // (POINTS // 2))
        whole = len(y) // width * width
        bins = y[:whole].reshape(-1, width)
        y = np.stack([bins.min(axis=1), bins.max(axis=1)], axis=1).ravel()
        x = np.repeat(x[:whole:width], 2)
    axes.plot(x, y, color=colour, label=name, linewidth=0.9)


def _column(name: str) -> Paint:
    return lambda axes, log, rows, j: _line(axes, log, rows, getattr(log, name)[rows, j])


def _steps(axes: Axes, log: Log, rows: slice, j: int) -> None:
    _line(axes, log, rows, np.diff(log.t[rows], prepend=np.nan))


def _acceleration(axes: Axes, log: Log, rows: slice, j: int) -> None:
    middle = (rows.start + rows.stop) // 2
    few = slice(max(rows.start, middle - LEAST_ROWS // 2), min(rows.stop, middle + LEAST_ROWS // 2))
    _line(axes, log, few, log.qdd[few, j])


def _rates(value: str, rate: str) -> Paint:
    """Return a function that plots a logged rate and the numerical derivative of the logged value."""

    def rates(axes: Axes, log: Log, rows: slice, j: int) -> None:
        with np.errstate(all="ignore"):
            change = np.gradient(getattr(log, value)[rows, j]) / np.gradient(log.t[rows])
        _line(axes, log, rows, change, OTHER, f"rate of change of {value}")
        _line(axes, log, rows, getattr(log, rate)[rows, j], COLOURS["error"], rate)
        axes.legend(loc="upper right", ncols=2)

    return rates


def _torque(system: ConstrainedSystem, log: Log, rows: slice) -> Paint:
    """Return a function that plots the logged torque and the torque computed from the robot file."""
    q, qd, qdd = (torch.from_numpy(np.ascontiguousarray(x[rows])) for x in (log.q, log.qd, log.qdd))
    robot = system.robot.to("cpu", torch.float64)
    with torch.no_grad():
        needed = (dynamics.inverse_dynamics(robot, q, qd, qdd) - dynamics.damping_force(robot, qd)).numpy()

    def paint(axes: Axes, log: Log, rows: slice, j: int) -> None:
        _line(axes, log, rows, needed[:, j], OTHER, "robot file")
        _line(axes, log, rows, log.tau[rows, j], COLOURS["error"], "logged")
        axes.legend(loc="upper right", ncols=2)

    return paint


def _contact(finding: Finding, system: ConstrainedSystem, log: Log, rows: slice) -> Picture:
    """Return a plot of the distance of the tip from the surface, highlighting rows labelled as closed."""
    contact = system.contact(finding.contact or "")
    c = tip_path(system, contact, log).c if isinstance(contact, SurfaceContact) else np.full(len(log), np.nan)

    def fill(figure: Figure) -> None:
        axes = figure.subplots()
        _shade(axes, finding, rows, log)
        _line(axes, log, rows, 1e3 * c[rows], INK, "distance")
        if contact.name in log.contact:
            closed = np.where(log.contact[contact.name][rows], 1e3 * c[rows], np.nan)
            _line(axes, log, rows, closed, COLOURS["warning"], "labelled closed")
        axes.axhline(0.0, color=OTHER, linewidth=0.6)
        axes.set_ylabel("distance [mm]")
        axes.set_xlabel(_axis(log)[1])
        axes.legend(loc="upper right", ncols=2)

    return draw(fill, (SIZE[0], 2.4), f"Distance of the tip from {contact.name}: {finding.message}")


def write_check(path: Path, title: str, report: Report, system: ConstrainedSystem, log: Log) -> Path:
    """Write the page on a checked log as a self-contained HTML file."""
    log, everything = of_robot(log, system.robot), ((0, report.samples),)
    sections = [
        {
            "finding": finding,
            "title": ", or ".join(KINDS[kind].title for kind in finding.kinds),
            "rows": "all rows" if finding.intervals == everything else describe(finding.intervals, most=6),
            "picture": picture_of(finding, system, log),
        }
        for finding in report.findings
    ]
    overview = draw_overview(report, log) if report.findings else None
    page = render("check.html.j2", title=title, report=report, sections=sections, overview=overview)
    write_text(path, page)
    return path
