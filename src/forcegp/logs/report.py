"""What an import found and did, for the user to judge."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

MOST_INTERVALS = 20
"""Intervals of rows that a finding lists; its count covers all."""


@dataclass(frozen=True)
class Finding:
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
class Report:
    """What was found and done, in order.

    Attributes:
        source, format: the log.
        rows_read: rows of the stream that sets the clock.
        findings: what is unusual in the log.
        steps: what was done to it, as lines of provenance.
    """

    source: str
    format: str = ""
    rows_read: int = 0
    findings: list[Finding] = field(default_factory=list)
    steps: list[str] = field(default_factory=list)

    def find(self, kind: str, message: str, rows: NDArray[np.int64] | None = None) -> None:
        """Add a finding on some rows, given by their numbers in the log, increasing."""
        numbers = np.zeros(0, np.int64) if rows is None else rows
        self.findings.append(Finding(kind, message, len(numbers), intervals(numbers)))

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
