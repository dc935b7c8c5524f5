"""Robust estimates of the level and the standard deviation of data with outliers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAD_TO_STD = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute deviation."""


def robust_std(x: NDArray[Any]) -> NDArray[Any]:
    """Return the median absolute deviation, scaled to the standard deviation of a normal distribution."""
    return np.asarray(MAD_TO_STD * np.median(np.abs(x - np.median(x, axis=0)), axis=0))


def level_and_spread(x: NDArray[Any]) -> tuple[float, float]:
    """Return the median and the robust standard deviation; both are NaN if there are no values."""
    return (float(np.median(x)), float(robust_std(x))) if len(x) else (float("nan"), float("nan"))


def level_of(x: NDArray[Any], width: float, share: float) -> float | None:
    """Return the median of the values within `width` of the mode if their fraction exceeds `share`.

    >>> level_of(np.array([5.0, 5.1, 4.9, 40.0, -7.0]), 1.0, 0.5)
    5.0
    """
    if not len(x):
        return None
    bins, counts = np.unique(np.floor(x / width), return_counts=True)
    near = x[np.abs(x - width * (bins[counts.argmax()] + 0.5)) <= width]
    return float(np.median(near)) if len(near) > share * len(x) else None
