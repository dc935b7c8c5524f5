"""Detection of torques that are clipped at a limit of the amplifier."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.rows import Intervals, intervals

Array = NDArray[np.float64]

CLIPPED_RUN, OFTENER = 3, 5.0
"""Minimum number of successive rows at an extreme value that form a plateau; factor by which a clipped value
occurs more often than its neighbours (2.4 at the peaks of a sine)."""
BAND = 0.03
"""Width of the band of a noisy clipped torque, as a fraction of the torque's range."""
PLATEAUS, FLAT_ROWS, FLAT = 3, 10, 0.35
"""Three criteria for a noisy clipped torque: minimum number of plateaus while its joint moves, minimum number
of rows in each, and minimum ratio of the variance of steps to twice the variance of values in the middle
halves of plateaus. The ratio is 1 for white noise about a limit, 0.43 for the current of a real drive, and
0.05 to 0.3 at smooth peaks."""
MOVES = 0.02
"""Fraction of its maximum speed above which a joint moves. The torque of a joint at rest is constant."""


def clipped(tau: Array, qd: Array, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask `(n, nq)` of unfiltered torques that stay at the maximum or minimum of their joint.

    Args:
        tau, qd: torques and velocities in time order, `(n, nq)`.
        usable: mask of the rows to check, `(n,)`.
    """
    mask = np.zeros(tau.shape, bool)
    for j in range(tau.shape[1]):
        x = tau[:, j]
        if not usable.any() or np.ptp(x[usable]) == 0.0:
            continue
        for extreme in limits_of(x[usable]):
            for first, last in _plateaus(x, np.abs(qd[:, j]), usable, extreme):
                mask[first:last, j] = True
    return mask


def limits_of(values: Array) -> tuple[float, float]:
    """Return the most frequent values near the maximum and minimum, which a filter's overshoot may exceed."""
    limits = []
    for extreme in (values.max(), values.min()):
        band = values[np.abs(values - extreme) <= BAND * np.ptp(values)]
        near, counts = np.unique(band, return_counts=True)
        often = near[counts == counts.max()]
        limits.append(float(often[np.abs(often - extreme).argmin()]))
    return limits[0], limits[1]


def _plateaus(tau: Array, speed: Array, valid: NDArray[np.bool_], extreme: float) -> Intervals:
    """Return the runs of rows in which a joint's torque is clipped at `extreme`, exactly or up to noise."""
    moves = speed > MOVES * speed[valid].max()
    usable, width = tau[valid], BAND * np.ptp(tau[valid])
    if extreme == 0.0:
        return ()
    # A value that occurs far more often than neighbouring values is a limit.
    at = (tau == extreme) & valid
    near = np.abs(usable - extreme) <= width
    runs = tuple((a, b) for a, b in intervals(at) if b - a >= CLIPPED_RUN)
    others = (near.sum() - at.sum()) / max(len(np.unique(usable[near])) - 1, 1)
    if runs and at.sum() > OFTENER * max(others, 1.0):
        return runs
    # With noise, compare a band of values with the adjacent band of equal width.
    band = (np.abs(tau - extreme) <= width) & valid & moves
    beside = (np.abs(tau - extreme) > width) & (np.abs(tau - extreme) <= 2.0 * width) & valid & moves
    runs = tuple((a, b) for a, b in intervals(band) if b - a >= FLAT_ROWS)
    if len(runs) < PLATEAUS or band.sum() <= OFTENER * max(beside.sum(), 1):
        return ()
    middles = [tau[(3 * a + b) // 4 : (a + 3 * b + 3) // 4] for a, b in runs]
    steps = sum(float((np.diff(x) ** 2).sum()) for x in middles)
    return runs if steps > 2.0 * FLAT * sum(len(x) * float(x.var()) for x in middles) else ()
