"""The columns of a Parquet file, a piece at a time, with trajectories numbered throughout.

A window that reaches beyond a piece sees its neighbours, within the same trajectory only.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forcegp.data.header import DataHeader
from forcegp.data.table import Columns, existing, numeric, opened_parquet
from forcegp.errors import DataError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


@dataclass(frozen=True)
class Piece:
    """Neighbouring rows of a file.

    Attributes:
        columns: values by name, with rows before and after the piece that a window needs.
        header: of the file.
        first: row of the file that the piece begins with.
        before: rows in `columns` before it.
        rows: length of the piece.
        last_segment: number of the trajectory at its end.
    """

    columns: Columns
    header: DataHeader
    first: int
    before: int
    rows: int
    last_segment: int


def shape_of(path: Path) -> tuple[int, DataHeader]:
    """Number of rows and header of a Parquet file.

    Raises:
        DataError: no such file, or not a Parquet log.
    """
    file = existing(path)
    if file.suffix.lower() != ".parquet":
        raise DataError(
            f"{file}: only Parquet files are read piece by piece",
            expected="a name that ends in .parquet",
            got=file.suffix,
            hint="write the log as Parquet: Dataset.read(path).write('run.parquet')",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Columns that are left out are reported when they are read.
        with opened_parquet(file) as (parquet, _, header):
            return parquet.metadata.num_rows, header


def pieces_of(path: Path, size: int, window: int, number: int) -> Iterator[Piece]:
    """The pieces of a file, all but the last of the same size.

    Args:
        path: the file.
        size: rows of a piece.
        window: rows before and after a piece that are read with it, within its trajectories.
        number: of the first trajectory.

    Raises:
        DataError: the file is damaged, a value is missing, or rows of a trajectory are not together.
    """
    file, first, seen = existing(path), 0, _Trajectories(str(path), number)
    with opened_parquet(file) as (parquet, usable, header):
        before: Columns = {}
        tables = _tables(parquet, usable, size)
        following = next(tables, None)
        while following is not None:
            own, following = _columns(file, following), next(tables, None)
            seen.number(own, header.ordered)
            after = {} if following is None else _columns(file, following.slice(0, window))
            if window and after:
                seen.peek(after)
            whole, context = _with_context(before, own, after if window else {})
            rows = len(own["segment"])
            yield Piece(whole, header, first, context, rows, int(own["segment"][-1]))
            before = {name: values[max(0, rows - window) :] for name, values in own.items()} if window else {}
            first += rows


def _tables(parquet: pq.ParquetFile, usable: list[str], size: int) -> Iterator[pa.Table]:
    """Tables of `size` rows each, but for the last, whatever the row groups of the file."""
    import pyarrow as pa

    held = parquet.schema_arrow.empty_table().select(usable)
    for batch in parquet.iter_batches(batch_size=size, columns=usable, use_threads=False):
        held = pa.concat_tables([held, pa.Table.from_batches([batch]).select(usable)])
        while held.num_rows >= size:
            yield held.slice(0, size)
            held = held.slice(size)
    if held.num_rows:
        yield held


def _columns(file: Path, table: pa.Table) -> Columns:
    pairs = zip(table.column_names, table.columns, strict=True)
    columns = {name: numeric(file, name, column, "refuse") for name, column in pairs}
    return columns | {"segment": columns.get("segment", np.zeros(table.num_rows, np.int64))}


def _with_context(before: Columns, own: Columns, after: Columns) -> tuple[Columns, int]:
    """A piece with the rows around it that belong to its first and last trajectory."""
    if before:
        same = before["segment"] == own["segment"][0]
        before = {name: values[same] for name, values in before.items()}
    if after:
        same = after["segment"] == own["segment"][-1]
        after = {name: values[same] for name, values in after.items()}
    parts = [part for part in (before, own, after) if part]
    return {name: np.concatenate([part[name] for part in parts]) for name in own}, (
        len(before["segment"]) if before else 0
    )


class _Trajectories:
    """Numbers trajectories throughout, and checks that each is in one run and in order of time."""

    def __init__(self, source: str, number: int) -> None:
        self.source, self.last_number = source, number
        self.raw: float | None = None
        self.time = -np.inf
        self.known: set[float] = set()

    def number(self, columns: Columns, ordered: bool) -> None:
        """Replace the segments of the next rows by numbers that go on from those before."""
        raw, t = columns["segment"], columns.get("t")
        if ordered and self.raw is not None and t is not None and raw[0] == self.raw and t[0] <= self.time:
            raise DataError(
                f"{self.source}: column 't' does not increase",
                expected=f"more than {self.time:.9g} s",
                got=f"{t[0]:.9g} s",
                hint="sort the log by time, or number its trajectories in a column 'segment'",
            )
        starts = np.append(self.raw is not None and raw[0] != self.raw, raw[1:] != raw[:-1])
        fresh = {float(raw[0])} if self.raw is None else set()
        fresh |= set(raw[starts].astype(float).tolist())
        again = fresh & self.known
        if ordered and (again or len(fresh) < int(starts.sum()) + (self.raw is None)):
            which = next(iter(again), None)
            raise DataError(
                f"{self.source}: the rows of a segment are not together",
                got=None if which is None else f"segment {which:g} again",
                hint="sort the log by 'segment' and 't'",
            )
        self.known |= fresh
        columns["segment"] = self._counted(starts)
        self.raw, self.last_number = float(raw[-1]), int(columns["segment"][-1])
        self.time = -np.inf if t is None else float(t[-1])

    def peek(self, columns: Columns) -> None:
        """Number rows that come next, without passing on to them."""
        raw = columns["segment"]
        columns["segment"] = self._counted(np.append(raw[0] != self.raw, raw[1:] != raw[:-1]))

    def _counted(self, starts: NDArray[np.bool_]) -> NDArray[np.int64]:
        return (self.last_number + np.cumsum(starts)).astype(np.int64)
