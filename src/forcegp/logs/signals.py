"""What the steps of an import hand on: the quantities of a log, in SI units and in the robot's joint order on
one clock, and the report of what was found and done."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from forcegp.rows import numbered, runs

Array = NDArray[np.float64]


@dataclass
class Signals:
    """Quantities of a log; each step of the import takes them and leaves them valid.

    Time [s], number in the log and trajectory of each row, `(n,)`; `q`, `qd`, `qdd`, `tau` as far as they are
    logged, `(n, nq)` each, and `wrench` `(n, 6)`; name of each contact → `(n,)` bool.
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
        """Keep only some rows `(n,)`, one column after another, so that memory holds one copy.

        With `split`, what lies on two sides of dropped rows is not one trajectory.
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
    """Something that was found in a log: its kind in a word, and a sentence with what was done about it.

    `count` rows are concerned; `rows` has the first intervals, first and last, as numbered in the log.
    """

    kind: str
    message: str
    count: int = 0
    rows: tuple[tuple[int, int], ...] = ()


@dataclass
class ImportReport:
    """What was found and done, in order; `steps` are lines of provenance.

    `rows_read` counts the rows of the stream that sets the clock.
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
