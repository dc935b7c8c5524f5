"""What the steps of an import hand on: the quantities of a log, and the report of what was found and done.

Quantities are in SI units and in the robot's joint order, on one clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from forcegp.rows import numbered, runs

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
        first = tuple((a, b - 1) for a, b in numbered(numbers)[:MOST_INTERVALS])
        self.findings.append(ImportFinding(kind, message, len(numbers), first))
