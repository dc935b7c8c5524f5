"""What the steps of an import hand on: the quantities of a log, and the report of what was found and done.

Quantities are in SI units and in the robot's joint order, on one clock.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass
class Signals:
    """Quantities of a log; each step of the import takes them and leaves them valid.

    Attributes:
        joint_names: the robot's joints.
        t: `(n,)` time [s].
        row: `(n,)` number of each row in the log.
        segment: `(n,)` number of the trajectory.
        vectors: `q`, `qd`, `qdd`, `tau` as far as they are logged, `(n, nq)` each; `wrench` `(n, 6)`.
        contact: name → `(n,)` bool.
    """

    joint_names: tuple[str, ...]
    t: Array
    row: NDArray[np.int64]
    segment: NDArray[np.int64]
    vectors: dict[str, Array]
    contact: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.t)

    def keep(self, mask: NDArray[np.bool_], split: bool = False) -> None:
        """Keep only some rows, one column after another, so that memory holds one copy.

        Args:
            mask: `(n,)` the rows to keep.
            split: what lies on two sides of dropped rows is not one trajectory.
        """
        if mask.all():
            return
        if split:
            self.segment = self.segment + np.cumsum(np.concatenate([[False], mask[1:] & ~mask[:-1]]))
        self.t, self.row, self.segment = self.t[mask], self.row[mask], self.segment[mask]
        for name in list(self.vectors):
            self.vectors[name] = self.vectors.pop(name)[mask]
        self.contact = {name: value[mask] for name, value in self.contact.items()}

    def runs(self, *keys: NDArray[np.generic]) -> list[slice]:
        """Stretches of rows within one segment on which further keys do not change."""
        return runs(self.segment, *keys)


def runs(*keys: NDArray[np.generic]) -> list[slice]:
    """Stretches of rows on which none of the keys changes.

    >>> runs(np.array([0, 0, 1, 1]), np.array([True, True, True, False]))
    [slice(0, 2, None), slice(2, 3, None), slice(3, 4, None)]
    """
    n = len(keys[0])
    cut = np.zeros(max(n - 1, 0), dtype=bool)
    for key in keys:
        cut |= key[1:] != key[:-1]
    edges = [0, *(np.flatnonzero(cut) + 1).tolist(), n] if n else []
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


MOST_INTERVALS = 20
"""Intervals of rows that a finding lists; its count covers all."""


@dataclass(frozen=True)
class ImportFinding:
    """Something that the import found in a log.

    Attributes:
        kind: a word for it: `held`, `repeated`, `gap`, `restart`, …
        message: one sentence, with what was done about it.
        count: rows concerned.
        rows: the first intervals of rows, first and last, as they are numbered in the log.
    """

    kind: str
    message: str
    count: int = 0
    rows: tuple[tuple[int, int], ...] = ()


@dataclass
class ImportReport:
    """What was found and done, in order.

    Attributes:
        rows_read: rows of the stream that sets the clock.
        findings: what is unusual in the log.
        steps: what was done to it, as lines of provenance.
    """

    source: str
    format: str = ""
    rows_read: int = 0
    findings: list[ImportFinding] = field(default_factory=list)
    steps: list[str] = field(default_factory=list)

    def find(self, kind: str, message: str, rows: NDArray[np.int64] | None = None) -> None:
        """Add a finding on some rows, given by their numbers in the log, increasing."""
        numbers = np.zeros(0, np.int64) if rows is None else rows
        self.findings.append(ImportFinding(kind, message, len(numbers), intervals(numbers)))

    def did(self, step: str) -> None:
        """Add a step."""
        self.steps.append(step)


def intervals(rows: NDArray[np.int64]) -> tuple[tuple[int, int], ...]:
    """The first intervals of consecutive numbers, as (first, last).

    >>> intervals(np.array([3, 4, 5, 9]))
    ((3, 5), (9, 9))
    """
    if not len(rows):
        return ()
    cuts = np.flatnonzero(np.diff(rows) != 1)[:MOST_INTERVALS]
    first = rows[np.concatenate([[0], cuts + 1])][:MOST_INTERVALS]
    last = rows[np.concatenate([cuts, [len(rows) - 1]])][:MOST_INTERVALS]
    return tuple((int(a), int(b)) for a, b in zip(first, last, strict=True))


def listed(rows: NDArray[np.int64]) -> str:
    """Rows as people write them: `3 to 5, 9`.

    >>> listed(np.array([3, 4, 5, 9]))
    '3 to 5, 9'
    """
    parts = [f"{a}" if a == b else f"{a} to {b}" for a, b in intervals(rows)[:4]]
    return ", ".join(parts) + (", …" if len(intervals(rows)) > 4 else "")
