"""Standard deviations that outliers do not spoil."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAD_TO_STD = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""


def robust_std(x: NDArray[Any], axis: int = 0) -> NDArray[Any]:
    """Standard deviation of a normal distribution with the same median absolute deviation."""
    centre = np.median(x, axis=axis, keepdims=True)
    return np.asarray(MAD_TO_STD * np.median(np.abs(x - centre), axis=axis))
