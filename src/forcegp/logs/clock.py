"""Time stamps: units, steps back, restarts, gaps, repeated and held rows; streams of different rates on one
clock, and uneven clocks made even.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.errors import DataError
from forcegp.logs.signals import Array, ImportReport, Signals, listed, runs

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


def drop_repeated(signals: Signals, report: ImportReport) -> None:
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


def split_trajectories(signals: Signals, gap: float | None, report: ImportReport) -> None:
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


def find_held(signals: Signals, drop: bool, report: ImportReport) -> None:
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


SMOOTH = ("q", "qd")
"""What is interpolated by a cubic spline; noisier quantities are interpolated linearly."""


def onto(t: Array, values: Array, at: Array, cubic: bool = False) -> Array:
    """Values of a stream at other times, column by column.

    Args:
        t: `(n,)` increasing stamps of the stream [s].
        values: `(n, d)`.
        at: `(k,)` times within the stream's [s].
        cubic: by a cubic spline (not-a-knot) instead of linearly.
    """
    from scipy.interpolate import CubicSpline

    result = np.empty((len(at), values.shape[1]))
    for i in range(values.shape[1]):
        if cubic and len(t) >= 4:
            result[:, i] = CubicSpline(t, values[:, i])(at)
        else:
            result[:, i] = np.interp(at, t, values[:, i])
    return result


def join_stream(
    signals: Signals, name: str, t: Array, values: Array, gap: float | None, report: ImportReport
) -> None:
    """Add a vector of a stream with a clock of its own, interpolated at the times of the log.

    Rows of the log that the stream does not cover are dropped: before its first stamp, after its last, and
    within its gaps.

    Args:
        signals: the log.
        name: under which the vector is added.
        t, values: the stream, `(k,)` and `(k, d)`.
        gap: longest step of the stream that is interpolated over [s], or `None` for five usual steps.
        report: gets what was dropped.

    Raises:
        DataError: the stream's clock does not increase, or the streams do not overlap.
    """
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if len(back):
        raise DataError(
            f"the stream of {name} has a clock that does not increase in row {back[0] + 1}",
            expected="increasing stamps, to align it with the positions",
            hint="import the trajectories one by one",
        )
    longest = gap if gap is not None else 5.0 * usual_step(t)
    after = np.searchsorted(t, signals.t, side="left").clip(1, len(t) - 1)
    covered = (signals.t >= t[0]) & (signals.t <= t[-1])
    covered &= (t[after] - t[after - 1] <= longest) | (signals.t == t[after])
    if not covered.any():
        raise DataError(
            f"the stream of {name} has no row at the times of the positions",
            expected=f"stamps between {signals.t[0]:.6g} and {signals.t[-1]:.6g} s",
            got=f"{t[0]:.6g} to {t[-1]:.6g} s",
            hint="are both on the same clock and in the same unit?",
        )
    if not covered.all():
        message = f"{(~covered).sum()} rows without {name} were dropped"
        report.find("uncovered", message, signals.row[~covered])
        # What lies on two sides of dropped rows is not one trajectory.
        cut = np.concatenate([[False], covered[1:] & ~covered[:-1]])
        signals.segment = signals.segment + np.cumsum(cut)
        signals.keep(covered)
    signals.vectors[name] = onto(t, values, signals.t)
    report.did(f"interpolated {name} from {1.0 / usual_step(t):.4g} Hz onto the clock of the positions")


def make_even(signals: Signals, period: float | None, report: ImportReport) -> None:
    """Put every trajectory on an evenly spaced clock of its own start.

    Args:
        signals: the log.
        period: the time step [s], or `None` for the log's usual step.
        report: gets the step.
    """
    step = period if period is not None else usual_step(signals.t)
    grids, rows, segments = [], [], []
    stretches = [s for s in signals.runs() if s.stop - s.start > 1]
    for stretch in stretches:
        t = signals.t[stretch]
        count = int(np.floor((t[-1] - t[0]) / step + 1e-6)) + 1
        grid = np.minimum(t[0] + step * np.arange(count), t[-1])
        grids.append(grid)
        nearest = np.searchsorted(t, grid + 0.5 * step).clip(1, len(t)) - 1
        rows.append(nearest + stretch.start)
        segments.append(np.full(count, signals.segment[stretch.start]))
    if not grids:
        raise DataError("the log has no trajectory of two rows or more")
    for name in list(signals.vectors):
        old = signals.vectors.pop(name)
        parts = [
            onto(signals.t[s], old[s], grid, cubic=name in SMOOTH)
            for s, grid in zip(stretches, grids, strict=True)
        ]
        signals.vectors[name] = np.concatenate(parts)
    index: NDArray[np.int64] = np.concatenate(rows)
    signals.contact = {name: value[index] for name, value in signals.contact.items()}
    signals.t, signals.row, signals.segment = (
        np.concatenate(grids),
        signals.row[index],
        np.concatenate(segments),
    )
    report.did(f"resampled to steps of {step:.9g} s (positions by cubic splines, torques linearly)")
