"""Robust statistics and intervals of rows that the checks share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def intervals(mask: NDArray[np.bool_], join: int = 0) -> tuple[tuple[int, int], ...]:
    """Half-open runs of true rows; runs that are at most `join` rows apart become one.

    >>> intervals(np.array([True, True, False, True]))
    ((0, 2), (3, 4))
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    runs = [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
    joined: list[tuple[int, int]] = []
    for start, stop in runs:
        if joined and start - joined[-1][1] <= join:
            joined[-1] = (joined[-1][0], stop)
        else:
            joined.append((start, stop))
    return tuple(joined)


def any_row(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`(n,)` bool, rows of `(n, d)` in which any column is true."""
    return np.asarray(mask.any(axis=1))


def describe(spans: tuple[tuple[int, int], ...], most: int = 3) -> str:
    """Rows in words, such as `row 4` or `rows 4 to 9, 20 to 31 and 5 more intervals`."""
    texts = [f"{a}" if b - a == 1 else f"{a} to {b - 1}" for a, b in spans[:most]]
    many = len(spans) > 1 or any(b - a > 1 for a, b in spans)
    rest = f" and {len(spans) - most} more" if len(spans) > most else ""
    return f"row{'s' * many} {', '.join(texts)}{rest}"


OUTER = np.array([-10.0, 10.0, -5.0, 2.0]) / 3.0
"""Minus the weights that carry a cubic from x = −2, −1, 1, 2 to −3."""
SPREAD = 3.7
"""Standard deviation of that contrast over the one of the middle value, for white noise."""


def spikes(x: Array) -> tuple[Array, Array]:
    """Departure of each value from the cubic through its four neighbours, and how well six neighbours agree.

    e_i = x_i − (−x_{i−2} + 4 x_{i−1} + 4 x_{i+1} − x_{i+2})/6. The second result is the same departure
    measured on the neighbours alone, without x_i: a kink of the motion raises both, a spike the first only.

    Args:
        x: `(n, d)` evenly sampled values, n ≥ 7.

    Returns:
        Both departures `(n, d)`, zero in the three outermost rows.
    """
    own, around = np.zeros_like(x), np.zeros_like(x)
    a, b, c, middle, d, e, f = (x[k : len(x) - 6 + k] for k in range(7))
    own[3:-3] = middle - (-b + 4.0 * c + 4.0 * d - e) / 6.0
    left = a + sum(w * v for w, v in zip(OUTER, (b, c, d, e), strict=True))
    right = f + sum(w * v for w, v in zip(OUTER, (e, d, c, b), strict=True))
    around[3:-3] = np.maximum(np.abs(left), np.abs(right)) / SPREAD
    return own, around
