"""Torques that clip at a limit of the amplifier."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.rows import Intervals, intervals

Array = NDArray[np.float64]

CLIPPED_RUN, OFTENER = 3, 5.0
"""Successive rows at an extreme value that make a plateau; factor by which a clipped value occurs more
often than its neighbours; at the peaks of a sine, 2.4."""
BAND = 0.03
"""Part of the range of a torque that noise of a clipped one stays within."""
PLATEAUS, FLAT_ROWS, FLAT = 3, 10, 0.35
"""Least plateaus of a noisy clipped torque while its joint moves, rows of each, and variance of steps over
twice that of the values in their middle halves: 1 for white noise about a limit, 0.43 for the current of a
real drive, 0.05 to 0.3 at smooth peaks."""
MOVES = 0.02
"""Part of its largest speed from which a joint moves; the torque of one that rests is constant."""


def clipped(tau: Array, qd: Array, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask `(n, nq)` of unfiltered torques that stay at the largest or smallest value of their joint.

    Args:
        tau, qd: torques and velocities `(n, nq)`, in order of time.
        usable: rows that are looked at `(n,)`.
    """
    found = np.zeros(tau.shape, bool)
    for j in range(tau.shape[1]):
        x = tau[:, j]
        if not usable.any() or np.ptp(x[usable]) == 0.0:
            continue
        for extreme in limits_of(x[usable]):
            for first, last in _plateaus(x, np.abs(qd[:, j]), usable, extreme):
                found[first:last, j] = True
    return found


def limits_of(values: Array) -> tuple[float, float]:
    """Value taken most often near the maximum, and near the minimum: a filter overshoots a limit."""
    limits = []
    for extreme in (values.max(), values.min()):
        near, counts = np.unique(
            values[np.abs(values - extreme) <= BAND * np.ptp(values)], return_counts=True
        )
        often = near[counts == counts.max()]
        limits.append(float(often[np.abs(often - extreme).argmin()]))
    return limits[0], limits[1]


def _plateaus(tau: Array, speed: Array, valid: NDArray[np.bool_], extreme: float) -> Intervals:
    """Runs of rows in which the torque of a joint is clipped at an extreme value, exactly or up to noise."""
    moves = speed > MOVES * speed[valid].max()
    usable, width = tau[valid], BAND * np.ptp(tau[valid])
    if extreme == 0.0:
        return ()
    # A value that the column reaches far more often than its neighbourhood is a limit.
    at = (tau == extreme) & valid
    near = np.abs(usable - extreme) <= width
    runs = tuple((a, b) for a, b in intervals(at) if b - a >= CLIPPED_RUN)
    others = (near.sum() - at.sum()) / max(len(np.unique(usable[near])) - 1, 1)
    if runs and at.sum() > OFTENER * max(others, 1.0):
        return runs
    # With noise, a band of values, beside the next one of the same width.
    band = (np.abs(tau - extreme) <= width) & valid & moves
    beside = (np.abs(tau - extreme) > width) & (np.abs(tau - extreme) <= 2.0 * width) & valid & moves
    runs = tuple((a, b) for a, b in intervals(band) if b - a >= FLAT_ROWS)
    if len(runs) < PLATEAUS or band.sum() <= OFTENER * max(beside.sum(), 1):
        return ()
    middles = [tau[(3 * a + b) // 4 : (a + 3 * b + 3) // 4] for a, b in runs]
    steps = sum(float((np.diff(x) ** 2).sum()) for x in middles)
    return runs if steps > 2.0 * FLAT * sum(len(x) * float(x.var()) for x in middles) else ()
