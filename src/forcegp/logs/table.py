"""Data structures of an import: columns as returned by readers, quantities in SI units, and the report."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.errors import DataError, did_you_mean
from forcegp.guards import check_count, check_expansion
from forcegp.resources import announce_memory
from forcegp.rows import numbered, runs


def check_values(source: str, rows: int, columns: int) -> None:
    """Raise `DataError` if a table is too wide or too large; warn if it needs a lot of memory."""
    check_count(source, "columns", columns, limits.COLUMNS)
    check_count(source, f"numbers ({rows:,} rows × {columns} columns)", rows * columns, limits.LOG_VALUES)
    announce_memory(2 * 8 * rows * columns, f"reading {source}")  # once as in the file, once as float64


Column = Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""A function called with the completed and the total work, in bytes or messages."""
Wanted = Callable[[str], bool]
"""A function that returns whether to read the column with a given name."""


@dataclass(frozen=True, eq=False)
class Stream:
    """Columns (n,) with a common clock, NaN for missing values, and the units declared in the log."""

    name: str
    columns: Mapping[str, Column]
    units: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(next(iter(self.columns.values()))) if self.columns else 0


@dataclass(frozen=True, eq=False)
class LogTable:
    """A log with notes (`remarks`) about omissions and assumptions of the reader, one sentence each."""

    source: str
    format: str
    streams: tuple[Stream, ...]
    remarks: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of all columns, stream by stream."""
        return [name for stream in self.streams for name in stream.columns]

    @property
    def left_out(self) -> str:
        """The omissions of the reader, to be appended to a sentence."""
        return left_out(self.remarks)

    def stream_of(self, column: str, stream: str | None = None) -> Stream:
        """Return the stream that contains a column; raise `DataError` if there is none, or more than one."""
        among = [s for s in self.streams if stream is None or s.name == stream]
        if not among:
            raise missing(self, "stream", stream or "", [s.name for s in self.streams])
        holding = [s for s in among if column in s.columns]
        if not holding:
            raise missing(self, "column", column, [n for s in among for n in s.columns])
        if len(holding) > 1:
            text, got = f"several streams have a column {column!r}", [s.name or "(unnamed)" for s in holding]
            expected = "a key 'stream' that names one of them"
            raise DataError(f"{self.source}: {text}", expected=expected, got=", ".join(got))
        return holding[0]


def joined(chunks: dict[str, list[Column]], rows: int | None) -> dict[str, Column]:
    """Join columns that were read in pieces. Truncate them to `rows`, copying one column at a time."""
    return {name: np.concatenate(chunks.pop(name))[:rows] for name in list(chunks)}


def streams_by_length(groups: Mapping[int, Mapping[str, Column]], common: int) -> tuple[Stream, ...]:
    """Return one stream for each number of rows. The stream with `common` rows comes first and is unnamed."""
    ordered = sorted(groups, key=lambda rows: rows != common)
    return tuple(Stream("" if rows == common else f"{rows} rows", groups[rows]) for rows in ordered)


def left_out(remarks: Sequence[str]) -> str:
    """Return the notes of a reader about omissions, to be appended to a sentence.

    >>> left_out(["'q' of shape (2, 3, 4) and type float64 was left out", "'t' was transposed"])
    "; not read: 'q' of shape (2, 3, 4) and type float64 was left out"
    """
    omitted = [note for note in remarks if re.search(r"left out|ignored|not read|not followed", note)]
    return f"; not read: {'; '.join(omitted)[:600]}" if omitted else ""


def missing(table: LogTable, kind: str, name: str, names: list[str]) -> DataError:
    """Return the error for a missing stream or column."""
    shown = ", ".join(repr(k) for k in names[:16]) + (f", … ({len(names)})" if len(names) > 16 else "")
    text = f"{table.source}: the log has no {kind} {name!r}{table.left_out}"
    expected = f"one of {shown}" if names else "a log with columns of numbers"
    return DataError(text, expected=expected, hint=did_you_mean(name, names, 0.5))


def table_of_arrays(
    path: Path, kind: str, arrays: Mapping[str, NDArray[np.generic]], remarks: Sequence[str] = ()
) -> LogTable:
    """Convert the arrays in a file to a log with one stream for each number of rows.

    A matrix `(n, d)` becomes the columns `name[0]` to `name[d-1]`. Rows run along the axis with the most
    common length, so that an array `(d, n)` is transposed. Arrays of other lengths form separate streams. The
    notes in `remarks` are followed by notes about transposed and omitted arrays.
    """
    usable, remarks, source = {}, list(remarks), str(path)
    check_expansion(source, 8 * sum(array.size for array in arrays.values()), path.stat().st_size)
    for name, array in arrays.items():
        # Simulink logs a signal as d × 1 × n.
        squeezed = array.squeeze() if array.size > 1 else array
        if squeezed.dtype.kind not in "fiub" or squeezed.ndim not in (1, 2) or squeezed.size < 2:
            remarks.append(f"{name!r} of shape {array.shape} and type {array.dtype} was left out")
        else:
            usable[name[: limits.LOG_NAME]] = squeezed
    lengths = [length for array in usable.values() for length in set(array.shape)]
    common = max(set(lengths), key=lambda length: (lengths.count(length), length), default=0)
    groups: dict[int, dict[str, Column]] = {}
    for name, array in usable.items():
        rows = common if common in array.shape else max(array.shape)
        if array.ndim == 2 and array.shape[0] != rows:
            array = array.T
            remarks.append(f"{name!r} was transposed: its rows are samples")
        check_values(source, rows, array.size // rows)
        parts = {name: array} if array.ndim == 1 else {f"{name}[{i}]": x for i, x in enumerate(array.T)}
        columns = {part: np.ascontiguousarray(x, dtype=np.float64) for part, x in parts.items()}
        groups.setdefault(rows, {}).update(columns)
    check_count(source, "arrays of different length", len(groups), limits.LOG_STREAMS)
    for rows, columns in groups.items():
        check_values(source, rows, len(columns))
    return LogTable(source, kind, streams_by_length(groups, common), tuple(remarks))


@dataclass
class Signals:
    """Quantities in a log: the time [s], row number in the log and trajectory of each row, shape (n,); the
    vectors `q`, `qd`, `qdd`, `tau` (n, nq) and `wrench` (n, 6), if logged; and contacts by name, (n,) bool.
    Columns of `qd` and `qdd` are NaN for joints in which they are not logged.
    """

    joint_names: tuple[str, ...]
    t: Array
    row: NDArray[np.int64]
    segment: NDArray[np.int64]
    vectors: dict[str, Array]
    contact: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t)

    def lacking(self, name: str) -> NDArray[np.bool_]:
        """Return the mask (nq,) of the joints in which `qd` or `qdd` is not logged."""
        if name not in self.vectors:
            return np.ones(len(self.joint_names), dtype=bool)
        return np.asarray(np.isnan(self.vectors[name]).all(axis=0))

    def keep(self, mask: NDArray[np.bool_], split: bool = False) -> None:
        """Keep only the rows in `mask` (n,). If `split` is set, trajectories are split at removed rows."""
        if mask.all():
            return
        if split:
            self.segment = self.segment + np.cumsum(np.concatenate([[False], mask[1:] & ~mask[:-1]]))
        self.t, self.row, self.segment = self.t[mask], self.row[mask], self.segment[mask]
        for name in list(self.vectors):
            self.vectors[name] = self.vectors.pop(name)[mask]
        self.contact = {name: value[mask] for name, value in self.contact.items()}

    def reorder(self, order: NDArray[np.int64]) -> None:
        """Put the rows into another order, given their present places (n,)."""
        self.t, self.row, self.segment = self.t[order], self.row[order], self.segment[order]
        self.vectors = {name: value[order] for name, value in self.vectors.items()}
        self.contact = {name: value[order] for name, value in self.contact.items()}

    def runs(self, *keys: NDArray[np.generic]) -> list[slice]:
        """Return runs of rows, each within one segment, over which the additional keys are constant."""
        return runs(self.segment, *keys)


@dataclass(frozen=True)
class ImportFinding:
    """A finding of an import: its kind, a sentence that states the action taken, the number of affected rows,
    and the first of their intervals, at most 20.
    """

    kind: str
    message: str
    count: int = 0
    rows: tuple[tuple[int, int], ...] = ()


@dataclass
class ImportReport:
    """Findings and actions of an import. `rows_read` is the length of the stream that defines the clock, and
    `log` is a hash of its times and positions.
    """

    source: str
    format: str = ""
    rows_read: int = 0
    log: str = ""
    findings: list[ImportFinding] = field(default_factory=list)
    steps: list[str] = field(default_factory=list)

    def find(self, kind: str, message: str, rows: NDArray[np.int64] | None = None) -> None:
        """Add a finding about the given rows, which are increasing row numbers in the log."""
        numbers = np.zeros(0, np.int64) if rows is None else rows
        first = tuple((a, b - 1) for a, b in numbered(numbers)[:20])
        self.findings.append(ImportFinding(kind, message, len(numbers), first))
