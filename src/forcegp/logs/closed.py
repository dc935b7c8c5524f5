"""Intervals in which a contact is closed, from a force, the distance to the surface, or λ and the motion.

A force has two levels, of open and of closed contact. On a walking robot, unmodelled friction changes λ by as
much as the load of a foot that is about to leave. Then, large λ marks parts of closed intervals, and the
motion determines their ends: a foot that leaves its surface has a normal speed, and a foot that is pulled has
left it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from forcegp.errors import DataError
from forcegp.logs.mapping import ContactStateSection
from forcegp.logs.table import Array, Signals
from forcegp.robust import MAD_TO_STD, level_and_spread
from forcegp.rows import intervals, runs

SEPARATION, SHARP, RELEASE_STD, RELEASE = 6.0, 16.0, 4.0, 0.01
"""Minimum difference between the force levels of open and closed contact, in standard deviations of the open
level: for a result, and for a result from λ without the motion. Minimum margin above the open level in closed
intervals, in the same unit and as a fraction of it."""
USUAL, MOVES, LEAVING, LEFT, PULL = 0.95, 3.0, 0.04, 3e-3, 0.1
"""Quantile that limits λ, beyond which it may be an impact. Minimum ratio of the normal speed where λ is low
to that where it is high, if the motion is to decide. Smallest speed of a point that leaves its surface [m/s],
at which it moves by `TOUCHING` in 25 ms, and smallest distance at which it has left [m], while the base of an
estimator drifts. Largest pull on a closed contact as a fraction of its usual λ, since λ has errors."""
TOUCHING, DISTANCE_STD, SMALLEST_DISTANCE = 1e-3, 6.0, 1e-6
"""Largest distance in contact [m]; margin above the median distance in contact, in standard deviations;
smallest margin, to allow for rounding [m]. A mapping may override the result."""


def touching(distance: Array) -> float:
    """Return the distance up to which a contact counts as closed [m], at most `TOUCHING`.

    Most rows within `TOUCHING` belong to the closed contact. The threshold is their median plus
    `DISTANCE_STD` standard deviations, which separates them from approach and departure.

    >>> touching(np.array([0.0, 0.001, -0.001, 0.0, 0.002, 0.9, 30.0]) * 1e-3) < 1e-5
    True
    """
    near = distance[np.abs(distance) <= TOUCHING]
    if not len(near):
        return TOUCHING
    level, spread = level_and_spread(near)
    return min(TOUCHING, level + max(DISTANCE_STD * spread, SMALLEST_DISTANCE))


@dataclass(frozen=True)
class Levels:
    """Two groups of forces with the least variance, separated at `high` (Otsu 1979) [N]."""

    high: float
    open: float
    open_spread: float
    closed: float

    @classmethod
    def of(cls, values: Array) -> Levels:
        """Return the groups of the values (n,)."""
        counts, edges = np.histogram(values, bins=512)
        centers = 0.5 * (edges[1:] + edges[:-1])
        below, sums = np.cumsum(counts), np.cumsum(counts * centers)
        above = below[-1] - below
        with np.errstate(divide="ignore", invalid="ignore"):
            between = below * above * (sums / below - (sums[-1] - sums) / above) ** 2
        high = float(edges[1:][int(np.nanargmax(between[:-1]))])
        return cls(
            high, *level_and_spread(values[values <= high]), level_and_spread(values[values > high])[0]
        )

    def differ(self, separation: float) -> bool:
        """Whether the levels differ by more than some standard deviations of the open one."""
        return self.closed - self.open > separation * self.open_spread


def force_levels(values: Array, name: str, section: ContactStateSection) -> tuple[float, float]:
    """Return the force above which a contact is closed, and the lower force to which intervals extend [N].

    The second exceeds the median of the open group by `RELEASE_STD` standard deviations, or by a fraction
    `RELEASE` of the difference if that is larger. Raise `DataError` if the groups are not distinct.
    """
    if section.threshold is not None:
        return section.threshold, section.release or 0.5 * section.threshold
    levels = Levels.of(values)
    if not levels.differ(SEPARATION):
        raise DataError(
            f"the {section.source} does not determine when contact {name!r} is closed",
            expected=f"two levels at least {SEPARATION:g} standard deviations apart",
            got=f"{levels.open:.3g} ± {levels.open_spread:.2g} N and {levels.closed:.3g} N",
            hint=f"set threshold under [contact.{name}], or source to always, never or distance",
        )
    away = max(RELEASE_STD * levels.open_spread, RELEASE * (levels.closed - levels.open))
    return levels.high, min(section.release or levels.open + away, levels.high)


def closed_by_force(
    signals: Signals, values: Array, name: str, section: ContactStateSection, moves: Array | None = None
) -> tuple[NDArray[np.bool_], float, float, str]:
    """Return the mask (n,) of a closed contact, the forces above which it closes and stays closed [N], and
    the source.

    If the levels of λ are not sharp, the motion also decides: `moves` `(n, 2)` holds c [m] and ċ [m/s]. Raise
    `DataError` if neither is distinct.
    """
    stated = section.threshold is not None or section.release is not None
    if moves is not None and not stated and not (levels := Levels.of(values)).differ(SHARP):
        # Impacts of several times the weight would raise the threshold.
        high, low = Levels.of(np.minimum(values, np.quantile(values, USUAL))).high, -PULL * levels.closed
        closed = resting(signals, values, moves, high, low, section.shortest)
        if closed is not None:
            return closed, high, low, f"{section.source} and motion"
    high, low = force_levels(values, name, section)
    return hysteresis(values, high, low, signals.segment), high, low, section.source


def resting(
    signals: Signals, multiplier: Array, moves: Array, high: float, low: float, shortest: float
) -> NDArray[np.bool_] | None:
    """Return the mask (n,) of rows in which a contact is closed according to λ and its motion.

    Closed intervals contain rows with λ > `high`. They extend over rows with λ > `low` in which the point is
    slow along the normal and as high as in the nearest of those rows, wherever the surface is. They may be
    interrupted for less than `shortest` [s], as by a foot that chatters. Return `None` if the normal speed
    where λ is high is not much smaller than elsewhere.
    """
    (c, speed), pressed = moves.T, multiplier > high
    if pressed.all() or not pressed.any():
        return None
    apart, usual = int(shortest / np.median(np.diff(signals.t))), spread_about_zero(speed[pressed])
    place = np.full_like(c, np.nan)
    for rows in signals.runs():
        spans = intervals(pressed[rows], least=max(1, apart // 4))
        if spans:
            known = np.concatenate([np.arange(a, b) for a, b in spans])
            smooth = [median_filter(c[rows][a:b], apart // 2 | 1, mode="nearest") for a, b in spans]
            place[rows] = np.interp(np.arange(rows.stop - rows.start), known, np.concatenate(smooth))
    away, held = np.abs(c - place), pressed & np.isfinite(place)
    if not held.any() or not np.sqrt(np.mean(speed[~pressed] ** 2)) > MOVES * usual:
        return None
    near = away <= max(LEFT, DISTANCE_STD * spread_about_zero(away[held]))
    slow = np.abs(speed) <= max(LEAVING, RELEASE_STD * usual)
    stays, closed = pressed | (near & slow & (multiplier > low)), np.zeros_like(pressed)
    for rows in signals.runs():
        for a, b in intervals(stays[rows], join=apart):
            closed[rows][a:b] = pressed[rows][a:b].any()
    return closed


def spread_about_zero(x: Array) -> float:
    """Return the robust standard deviation about zero."""
    return MAD_TO_STD * float(np.median(np.abs(x)))


def hysteresis(values: Array, high: float, low: float, segment: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the mask of all runs above `low` that reach `high`.

    >>> hysteresis(np.array([0.0, 2, 5, 2, 0, 2, 0]), 4.0, 1.0, np.zeros(7, dtype=np.int64)).astype(int)
    array([0, 1, 1, 1, 0, 0, 0])
    """
    result = values >= low
    for rows in runs(segment, result):
        result[rows] &= (values[rows] >= high).any()
    return result


def merge_short(closed: NDArray[np.bool_], signals: Signals, shortest: float) -> int:
    """Merge intervals shorter than `shortest` [s] with their neighbours, and return how many were merged.

    The shortest interval is merged first, and of equal ones that with the longest neighbours.
    """
    count = 0
    for trajectory in signals.runs():
        t, state = signals.t[trajectory], closed[trajectory]
        bounds = np.concatenate([[0], np.flatnonzero(np.diff(state)) + 1, [len(state)]])
        while len(bounds) > 3:
            length = t[bounds[1:] - 1] - t[bounds[:-1]]
            duration, around = length[1:-1], length[:-2] + length[2:]
            i = int(np.lexsort((-around, duration))[0])
            if duration[i] >= shortest:
                break
            bounds, count = np.delete(bounds, [i + 1, i + 2]), count + 1
        for start, stop in pairwise(bounds):
            state[start:stop] = state[start]
    return count
