"""Runs of consecutive rows in a log, and their description in messages."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Intervals = tuple[tuple[int, int], ...]
"""Half-open intervals in increasing order."""


def runs(*keys: NDArray[Any]) -> list[slice]:
    """Return the runs of consecutive rows over which all keys are constant.

    >>> runs(np.array([0, 0, 1, 1]), np.array([True, True, True, False]))
    [slice(0, 2, None), slice(2, 3, None), slice(3, 4, None)]
    """
    n = len(keys[0])
    cut = np.zeros(max(n - 1, 0), dtype=bool)
    for key in keys:
        cut |= key[1:] != key[:-1]
    edges = [0, *(np.flatnonzero(cut) + 1).tolist(), n] if n else []
    return [slice(first, last) for first, last in pairwise(edges)]


def intervals(mask: NDArray[np.bool_], join: int = 0) -> Intervals:
    """Return the intervals in which `mask` is true, merging those that are at most `join` rows apart.

    >>> intervals(np.array([True, True, False, True]))
    ((0, 2), (3, 4))
    """
    joined: list[tuple[int, int]] = []
    for rows in runs(mask):
        if mask[rows.start]:
            near = bool(joined) and rows.start - joined[-1][1] <= join
            start = joined.pop()[0] if near else rows.start
            joined.append((start, rows.stop))
    return tuple(joined)


def numbered(rows: NDArray[np.int64]) -> Intervals:
    """Return the intervals of consecutive row numbers.

    >>> numbered(np.array([3, 4, 5, 9]))
    ((3, 6), (9, 10))
    """
    mask = np.zeros(int(rows[-1]) + 1 if len(rows) else 0, dtype=bool)
    mask[rows] = True
    return intervals(mask)


def describe(spans: Intervals, most: int = 3) -> str:
    """Describe rows in words, for example `row 4` or `rows 4 to 9, 20 to 31 and 5 more`."""
    texts = [f"{a}" if b - a == 1 else f"{a} to {b - 1}" for a, b in spans[:most]]
    many = len(spans) > 1 or any(b - a > 1 for a, b in spans)
    rest = f" and {len(spans) - most} more" if len(spans) > most else ""
    return f"row{'s' * many} {', '.join(texts)}{rest}"
