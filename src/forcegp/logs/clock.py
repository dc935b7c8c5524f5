"""Time stamps: units, steps back, restarts, gaps, repeated and held rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.errors import DataError
from forcegp.logs.report import Report, listed
from forcegp.logs.signals import Array, Signals, runs

RESTART_STEPS = 2.0
"""A clock that falls back to within so many steps of where its trajectory began, or before, has restarted."""
SHORTEST_TRAJECTORY = 10
"""Rows before a restart; fewer are stamps out of order."""
GAP_STEPS = 5.0
"""A step longer than so many usual ones is a gap."""


def usual_step(t: Array) -> float:
    """The median of the positive time steps [s].

    Raises:
        DataError: time never increases.
    """
    steps = np.diff(t)
    steps = steps[steps > 0.0]
    if not len(steps):
        raise DataError(
            "time never increases in the log", expected="a column of time stamps", got=listed_values(t)
        )
    return float(np.median(steps))


def drop_repeated(signals: Signals, report: Report) -> None:
    """Drop rows that repeat the one before, stamp and values.

    Raises:
        DataError: rows with the same stamp hold different values.
    """
    same = np.concatenate([[False], np.diff(signals.t) == 0.0])
    if not same.any():
        return
    equal = same.copy()
    for values in signals.vectors.values():
        equal[1:] &= (values[1:] == values[:-1]).all(axis=1)
    different = np.flatnonzero(same & ~equal)
    if len(different):
        rows = signals.row[different]
        raise DataError(
            f"rows {listed(rows)} have the time stamp of the row before, with other values",
            expected="one row for each time",
            got=f"{len(rows)} such rows",
            hint="is this the right column of time? Its resolution may be too coarse",
        )
    report.find("repeated", f"{equal.sum()} repeated rows were dropped", signals.row[equal])
    signals.keep(~equal)


def split(signals: Signals, gap: float | None, report: Report) -> None:
    """Number the trajectories: a new one begins where the clock restarts and after a gap.

    Args:
        signals: the log; its `segment` holds what the log itself says.
        gap: longest step within a trajectory [s], or `None` for `GAP_STEPS` usual steps.
        report: gets what was found.

    Raises:
        DataError: time steps back without restarting; the message has the rows.
    """
    t = signals.t
    step = usual_step(t)
    new = np.concatenate([[True], signals.segment[1:] != signals.segment[:-1]])
    back = np.concatenate([[False], np.diff(t) < 0.0]) & ~new
    if back.any():
        start, wrong = 0, []
        for row in np.flatnonzero(back | new):
            if back[row] and (t[row] > t[start] + RESTART_STEPS * step or row - start < SHORTEST_TRAJECTORY):
                wrong.append(row)
            else:
                start = row
        _refuse_steps_back(signals, np.array(wrong, dtype=np.int64))
        report.find("restart", f"the clock restarts {back.sum()} times: a trajectory each", signals.row[back])
    longest = gap if gap is not None else GAP_STEPS * step
    gaps = np.concatenate([[False], np.diff(t) > longest]) & ~new & ~back
    if gaps.any():
        message = f"{gaps.sum()} gaps longer than {longest:.4g} s: a new trajectory begins after each"
        report.find("gap", message, signals.row[gaps])
    signals.segment = np.cumsum(new | back | gaps) - 1


def _refuse_steps_back(signals: Signals, rows: NDArray[np.int64]) -> None:
    if not len(rows):
        return
    first, t = int(rows[0]), signals.t
    raise DataError(
        f"time goes back in row{'s' * (len(rows) > 1)} {listed(signals.row[rows])}",
        expected=f"more than {t[first - 1]:.9g} s in row {signals.row[first]}",
        got=f"{t[first]:.9g} s",
        hint="sort the log by time, or take a column of time that increases within a trajectory",
    )


def find_held(signals: Signals, drop: bool, report: Report) -> None:
    """Find rows whose positions and torques are those of the row before, to the last bit.

    A logger that is faster than its source writes such rows; they flatten derivatives. At rest, an
    encoder's position stays the same, so only rows in which the torque stays too are counted.

    Args:
        signals: the log.
        drop: drop them; the clock is made even again later.
        report: gets what was found.
    """
    held = np.zeros(len(signals), dtype=bool)
    held[1:] = signals.segment[1:] == signals.segment[:-1]
    for name in ("q", "tau"):
        values = signals.vectors[name]
        held[1:] &= (values[1:] == values[:-1]).all(axis=1)
    if held.any():
        done = "were dropped" if drop else 'are kept; held = "drop" under [time] drops them'
        report.find(
            "held", f"{held.sum()} rows hold the values of the row before and {done}", signals.row[held]
        )
        if drop:
            signals.keep(~held)


def unevenness(t: Array, segment: NDArray[np.int64]) -> float:
    """Largest departure of a step within a trajectory from that trajectory's median step, as a fraction."""
    worst = 0.0
    for rows in runs(segment):
        steps = np.diff(t[rows])
        if len(steps):
            median = float(np.median(steps))
            worst = max(worst, float(np.abs(steps - median).max()) / median)
    return worst


def listed_values(values: Array) -> str:
    """The first values of a column."""
    return ", ".join(f"{v:.6g}" for v in values[:5]) + (", …" if len(values) > 5 else "")
