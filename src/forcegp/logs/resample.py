"""Streams of different rates on one clock, and uneven clocks made even."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.errors import DataError
from forcegp.logs.clock import usual_step
from forcegp.logs.report import Report
from forcegp.logs.signals import Array, Signals

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


def join(signals: Signals, name: str, t: Array, values: Array, gap: float | None, report: Report) -> None:
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


def make_even(signals: Signals, period: float | None, report: Report) -> None:
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
