"""Processing of time stamps: order, restarts, gaps, repeated rows, alignment of streams, and resampling."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.data.derivative import UNIFORM_TOLERANCE
from forcegp.errors import DataError
from forcegp.guards import check_count
from forcegp.logs.table import Array, ImportReport, Signals
from forcegp.robust import robust_std
from forcegp.rows import describe, numbered, repeats

RESTART_STEPS, SHORTEST_TRAJECTORY = 2.0, 10
"""A clock has restarted if it falls back to within this many steps of the start of its trajectory, and the
trajectory has at least this many rows. Otherwise, the time stamps are out of order."""
GAP_STEPS = 5.0
"""A step longer than this multiple of the usual step counts as a gap."""
PARTS_OF_CLOCK = {1.0: ("fractions of a second", "whole seconds"), 60.0: ("seconds", "minutes")}
"""Periods of columns that are the last part of a clock [s], and names of this part and of the missing one."""
BURST_ROWS = 20
"""Mean number of rows between gaps below which the clock is at fault, not the recording."""


def usual_step(t: Array) -> float:
    """Return the median of the positive time steps [s]; raise `DataError` if time never increases."""
    steps = np.diff(t)
    steps = steps[steps > 0.0]
    if not len(steps):
        text = "time never increases in the log"
        got = ", ".join(f"{stamp:.6g}" for stamp in t[:5]) + (", …" if len(t) > 5 else "")
        raise DataError(text, expected="a column of time stamps", got=got)
    return float(np.median(steps))


def drop_repeated(signals: Signals, report: ImportReport) -> None:
    """Drop rows that repeat the previous row; raise `DataError` if only the time stamp repeats."""
    same = np.append(False, np.diff(signals.t) == 0.0)
    if not same.any():
        return
    equal = same & repeats(*signals.vectors.values())
    different = np.flatnonzero(same & ~equal)
    if len(different):
        rows = signals.row[different]
        text = f"{describe(numbered(rows))}: the time stamp of the row before, with other values"
        hint = "is this the correct time column? Its resolution may be too coarse"
        raise DataError(text, expected="one row per time stamp", got=f"{len(rows)} such rows", hint=hint)
    report.find("repeated", f"{equal.sum()} repeated rows were dropped", signals.row[equal])
    signals.keep(~equal)


def split_trajectories(signals: Signals, gap: float | None, report: ImportReport) -> None:
    """Number the trajectories. A new trajectory begins if the trajectory number in the log changes, if the
    clock restarts, or after a step longer than `gap` [s], which is `GAP_STEPS` usual steps by default.

    Rows out of order are sorted by time if the positions then move less.

    Raises:
        DataError: time runs backward without a restart. The message lists the rows.
    """
    t = signals.t
    step = usual_step(t)
    new = np.append(True, np.diff(signals.segment) != 0)
    back = np.append(False, np.diff(t) < 0.0) & ~new
    if back.any():
        start, wrong = 0, []
        for row in np.flatnonzero(back | new):
            if back[row] and (t[row] > t[start] + RESTART_STEPS * step or row - start < SHORTEST_TRAJECTORY):
                wrong.append(row)
            else:
                start = row
        if wrong and _sort(signals, report):
            split_trajectories(signals, gap, report)
            return
        if wrong:
            raise DataError(
                f"time runs backward in {describe(numbered(signals.row[wrong]))}",
                expected=f"more than {t[wrong[0] - 1]:.9g} s in row {signals.row[wrong[0]]}",
                got=f"{t[wrong[0]]:.9g} s",
                hint="sort the log by time, or use a time column that increases within a trajectory",
            )
        message = f"the clock restarts {back.sum()} times: each restart begins a trajectory"
        period = t[:-1][back[1:]] - t[1:][back[1:]] + step
        for seconds, (part, whole) in PARTS_OF_CLOCK.items():
            if back.sum() > 1 and (np.abs(period - seconds) < 2.0 * step).all() and step < 0.1:
                message += f". It counts {part}: the column of {whole} is missing under [time]"
        report.find("restart", message, signals.row[back])
    longest = gap if gap is not None else GAP_STEPS * step
    gaps = np.append(False, np.diff(t) > longest) & ~new & ~back
    if gaps.any():
        message = f"{gaps.sum()} gaps longer than {longest:.4g} s: a new trajectory begins after each"
        report.find("gap", message, signals.row[gaps])
        if len(t) < BURST_ROWS * gaps.sum():
            rows = len(t) / (gaps.sum() + 1)
            text = f"time stamps come in bursts of about {rows:.2g} rows: the clock of a receiver or a buffer"
            report.find("bursts", f"{text}, not of the robot", signals.row[gaps])
    signals.segment = np.cumsum(new | back | gaps) - 1


def _sort(signals: Signals, report: ImportReport) -> bool:
    """Sort rows by time within each trajectory of the log, if positions then change less in total.

    A clock that was set back would make them change more.
    """
    part = np.cumsum(np.append(False, np.diff(signals.segment) != 0))
    order = np.lexsort((signals.t, part))
    within = np.diff(part) == 0
    before, after = (
        np.abs(np.diff(q, axis=0))[within].sum() for q in (signals.vectors["q"], signals.vectors["q"][order])
    )
    if not after < before:
        return False
    # Those that a later row precedes
    latest = np.concatenate([np.maximum.accumulate(signals.t[part == k]) for k in range(part[-1] + 1)])
    late = signals.t < latest
    report.find("order", f"{late.sum()} rows were out of order, and were sorted by time", signals.row[late])
    signals.reorder(order)
    drop_repeated(signals, report)
    return True


def find_held(signals: Signals, drop: bool, report: ImportReport) -> None:
    """Find rows that repeat because the logger is faster than its source, and drop them if requested."""
    same = repeats(signals.vectors["q"], signals.vectors["tau"])
    held = same & np.append(False, np.diff(signals.segment) == 0)
    if held.any():
        done = "were dropped" if drop else 'are kept; held = "drop" under [time] drops them'
        share = f"{held.sum()} rows ({100 * held.mean():.2g} %)"
        message = f"{share} repeat the values of the previous row and {done}"
        kind = "faster than its source" if 2 * held.sum() > len(held) and not drop else "held"
        report.find(kind, message, signals.row[held])
        if drop:
            signals.keep(~held)


def join_stream(
    signals: Signals, name: str, t: Array, values: Array, gap: float | None, report: ImportReport
) -> None:
    """Interpolate a vector from a stream with time stamps t (k,), and drop rows outside its range."""
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if len(back):
        text = f"the stream of {name} has a clock that does not increase in row {back[0] + 1}"
        expected = "increasing stamps, to align it with the positions"
        raise DataError(text, expected=expected, hint="import the trajectories separately")
    longest = gap if gap is not None else GAP_STEPS * usual_step(t)
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
        signals.keep(covered, split=True)
    signals.vectors[name] = onto(t, values, signals.t)
    rate = f"{1.0 / usual_step(t):.4g} Hz"
    report.steps.append(f"interpolated {name} from {rate} onto the clock of the positions")


def onto(t: Array, values: Array, at: Array, cubic: bool = False) -> Array:
    """Interpolate values (n, d) from times t to times `at`, linearly or by a cubic spline."""
    from scipy.interpolate import CubicSpline, make_interp_spline

    result, logged = np.full((len(at), values.shape[1]), np.nan), ~np.isnan(values).all(axis=0)
    x = values[:, logged]
    result[:, logged] = CubicSpline(t, x)(at) if cubic and len(t) >= 4 else make_interp_spline(t, x, k=1)(at)
    return result


def even_clock(signals: Signals, period: float | None, report: ImportReport) -> None:
    """Resample uneven trajectories with the step `period` [s] (default: the usual step)."""
    stretches = [rows for rows in signals.runs() if rows.stop - rows.start > 1]
    if not stretches:
        raise DataError("the log has no trajectory of two rows or more")
    steps = [np.diff(signals.t[rows]) for rows in stretches]
    worst = max(float(np.abs(s - np.median(s)).max() / np.median(s)) for s in steps)
    if worst > UNIFORM_TOLERANCE:
        jitter = robust_std(np.concatenate(steps)) > UNIFORM_TOLERANCE * usual_step(signals.t)
        message = f"time steps deviate by up to {100.0 * worst:.3g} % from the usual step"
        report.find("jitter" if jitter else "uneven", message)
    elif period is None:
        return
    step = period if period is not None else usual_step(signals.t)
    length = sum(float(signals.t[rows.stop - 1] - signals.t[rows.start]) for rows in stretches)
    most = max(limits.FREE_ROWS, limits.TABLE_EXPANSION * len(signals))
    check_count(report.source, "rows on an even clock", math.ceil(min(length / step, 2.0**62)), most)
    parts = []
    for rows in stretches:
        t = signals.t[rows]
        count = int(np.floor((t[-1] - t[0]) / step + 1e-6)) + 1
        grid = np.minimum(t[0] + step * np.arange(count), t[-1])
        nearest = np.searchsorted(t, grid + 0.5 * step).clip(1, len(t)) - 1 + rows.start
        parts.append((rows, t, grid, nearest))
    for name in list(signals.vectors):
        old, cubic = signals.vectors.pop(name), name in ("q", "qd")  # the others are noisier
        new = [onto(t, old[rows], grid, cubic) for rows, t, grid, _ in parts]
        signals.vectors[name] = np.concatenate(new)
    index: NDArray[np.int64] = np.concatenate([nearest for *_, nearest in parts])
    signals.contact = {name: value[index] for name, value in signals.contact.items()}
    signals.t = np.concatenate([grid for _, _, grid, _ in parts])
    signals.row, signals.segment = signals.row[index], signals.segment[index]
    report.steps.append(f"resampled to steps of {step:.9g} s (positions by cubic splines, torques linearly)")
