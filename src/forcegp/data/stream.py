"""Long logs in Parquet files that are read piece by piece. Filter windows extend into adjacent pieces."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forcegp.data.columns import as_tensors, parse
from forcegp.data.dataset import Dataset
from forcegp.data.derivative import SavitzkyGolay
from forcegp.data.fields import DataHeader, check_alike, common_header
from forcegp.data.table import Columns, IgnoredColumnsWarning, existing, numeric, opened_parquet
from forcegp.errors import DataError

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Piece:
    """Consecutive rows of a file that start at row `first`. `columns` starts `before` rows earlier."""

    columns: Columns
    header: DataHeader
    first: int
    before: int
    rows: int
    last_segment: int


def shape_of(path: Path) -> tuple[int, DataHeader]:
    """Return the number of rows and the header of a Parquet file."""
    file = existing(path)
    if file.suffix.lower() != ".parquet":
        hint = "write the log as Parquet: Dataset.read(path).write('run.parquet')"
        raise DataError(f"{file}: only Parquet files are read piece by piece", got=file.suffix, hint=hint)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ignored columns are reported when the file is read.
        with opened_parquet(file) as (parquet, _, header):
            return parquet.metadata.num_rows, header


def pieces_of(path: Path, size: int, window: int, number: int) -> Iterator[Piece]:
    """Yield the pieces of a file, each with `size` rows and `window` rows around them in the same trajectory.

    Trajectories are numbered from `number`. A damaged file or a non-contiguous trajectory raises `DataError`.
    """
    import pyarrow as pa

    file, first, seen = existing(path), 0, _Trajectories(str(path), number)
    with opened_parquet(file) as (parquet, usable, header):
        before: Columns = {}
        batches = parquet.iter_batches(size, columns=usable, use_threads=False)
        tables = (pa.Table.from_batches([batch]).select(usable) for batch in batches if len(batch))
        following = next(tables, None)
        while following is not None:
            columns, following = _columns(file, following), next(tables, None)
            seen.number(columns, header.ordered)
            after = {} if following is None else _columns(file, following.slice(0, window))
            if window and after:
                seen.peek(after)
            whole, context = _with_context(before, columns, after if window else {})
            rows = len(columns["segment"])
            yield Piece(whole, header, first, context, rows, int(columns["segment"][-1]))
            before = {name: x[max(0, rows - window) :] for name, x in columns.items()} if window else {}
            first += rows


def _columns(file: Path, table: pa.Table) -> Columns:
    columns = {name: numeric(file, name, table[name], "refuse") for name in table.column_names}
    return columns | {"segment": columns.get("segment", np.zeros(table.num_rows, np.int64))}


def _with_context(before: Columns, columns: Columns, after: Columns) -> tuple[Columns, int]:
    """Return a piece with context rows of its first and last trajectory, and the number of rows before it."""
    segment = columns["segment"]
    parts = [
        {name: values[part["segment"] == number] for name, values in part.items()}
        for part, number in ((before, segment[0]), (after, segment[-1]))
    ]
    parts.insert(1, columns)
    whole = {name: np.concatenate([part[name] for part in parts if part]) for name in columns}
    return whole, len(parts[0].get("segment", ()))


class _Trajectories:
    """Numbers trajectories consecutively, and checks that each is contiguous and in time order."""

    def __init__(self, source: str, number: int) -> None:
        self.source, self.last_number = source, number - 1
        self.raw, self.time, self.segments = np.nan, -np.inf, set[float]()

    def number(self, columns: Columns, ordered: bool) -> None:
        """Renumber the segments of the next rows, continuing the numbering of the previous rows."""
        raw, t = columns["segment"], columns.get("t")
        if ordered and t is not None and raw[0] == self.raw and t[0] <= self.time:
            text = f"{self.source}: column 't' does not increase"
            hint = "sort the log by time, or number its trajectories in a column 'segment'"
            raise DataError(text, expected=f"more than {self.time:.9g} s", got=f"{t[0]:.9g} s", hint=hint)
        starts = self._starts(raw)
        fresh = set(raw[starts].astype(float).tolist())
        repeated = fresh & self.segments
        if ordered and (repeated or len(fresh) < int(starts.sum())):
            which = next(iter(repeated), None)
            text = f"{self.source}: the rows of a segment are not contiguous"
            hint = "sort the log by 'segment' and 't'"
            raise DataError(text, got=None if which is None else f"segment {which:g} again", hint=hint)
        self.segments |= fresh
        columns["segment"] = self.last_number + np.cumsum(starts)
        self.raw, self.last_number = float(raw[-1]), int(columns["segment"][-1])
        self.time = -np.inf if t is None else float(t[-1])

    def peek(self, columns: Columns) -> None:
        """Renumber the segments of the next rows without advancing."""
        columns["segment"] = self.last_number + np.cumsum(self._starts(columns["segment"]))

    def _starts(self, raw: NDArray[np.generic]) -> NDArray[np.bool_]:
        return np.append(raw[0] != self.raw, raw[1:] != raw[:-1])


PIECE_ROWS = 8192
"""Number of rows read at a time."""
Keep = Callable[[Dataset], Tensor]
"""A function that returns the numbers of the rows to keep in a piece."""


@dataclass(frozen=True)
class StreamedDataset:
    """A log of any length in one or more Parquet files, each with separate trajectories.

    Missing columns are computed as in `Dataset.read`. Their noise is estimated piece by piece.

    Args:
        paths: the files. Their joints, contacts and additional columns must agree.
        differentiate: the method for computing `qd` and `qdd` if they are missing.
        joints: the joints to read, in this order. The default is the joints of the files.
        dtype, device: data type and device of the tensors.

    Example:
        >>> import tempfile, torch
        >>> from forcegp import Dataset, StreamedDataset
        >>> x = torch.zeros(5, 1, dtype=torch.float64)
        >>> t = torch.arange(5, dtype=torch.float64)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     Dataset(t, x, x, x, x, ("joint",)).write(f"{folder}/a.parquet")
        ...     stream = StreamedDataset((f"{folder}/a.parquet",) * 2)
        ...     len(stream), [len(piece) for piece in stream.pieces()]
        (10, [5, 5])
    """

    paths: str | Path | Sequence[str | Path]
    differentiate: SavitzkyGolay | None = None
    joints: tuple[str, ...] | None = None
    dtype: torch.dtype = torch.float64
    device: torch.device | str = "cpu"

    def __post_init__(self) -> None:
        if not self.files:
            raise DataError("there are no files to read", expected="at least one Parquet file", got="none")
        self._shapes  # noqa: B018  (damaged files are rejected before any computation)

    @cached_property
    def files(self) -> tuple[Path, ...]:
        """The files as paths."""
        return tuple(map(Path, (self.paths,) if isinstance(self.paths, str | Path) else self.paths))

    @cached_property
    def _shapes(self) -> tuple[tuple[int, DataHeader], ...]:
        """Number of rows and header of each file."""
        return tuple(map(shape_of, self.files))

    def __len__(self) -> int:
        """Return the number of samples."""
        return sum(rows for rows, _ in self._shapes)

    @property
    def piece_count(self) -> int:
        """Number of pieces."""
        return sum(-(-rows // PIECE_ROWS) for rows, _ in self._shapes)

    @cached_property
    def header(self) -> DataHeader:
        """Header with the content common to all files."""
        headers = [header for _, header in self._shapes]
        return headers[0] if len(headers) == 1 else common_header(headers)

    def select(self, joints: Sequence[str]) -> StreamedDataset:
        """Return the log with only the given joints, in the given order."""
        return dataclasses.replace(self, joints=tuple(joints))

    def pieces(self, share: tuple[int, int] = (0, 1)) -> Iterator[Dataset]:
        """Yield the log in order, `PIECE_ROWS` rows at a time, with consecutive segment numbers.

        Args:
            share: (r, k) yields only piece r of every k. The others belong to other processes.

        Raises:
            DataError: a file is damaged, is not a valid log, or has different columns from the first file.
        """
        first, number, count = None, 0, 0
        window = self.differentiate.window if self.differentiate is not None else 0
        for path in self.files:
            for piece in pieces_of(path, PIECE_ROWS, window, number):
                number = piece.last_segment
                if count % share[1] == share[0]:
                    data = self._dataset(path, piece, first)
                    first = data[:1] if first is None else first
                    yield data
                count += 1
            number += 1

    def _dataset(self, path: Path, piece: Piece, first: Dataset | None) -> Dataset:
        """Return a piece as a data set with the same columns as the first piece."""
        source = str(path) if piece.first == 0 else f"{path} (rows counted from {piece.first - piece.before})"
        with warnings.catch_warnings():
            if piece.first:  # One warning per file is sufficient.
                warnings.simplefilter("ignore", IgnoredColumnsWarning)
            fields = parse(source, piece.columns, piece.header, self.differentiate)
        names = {name: fields["header"].__dict__[name] for name in ("joint_names", "contact_names")}
        fields["header"] = self.header.model_copy(update=names)
        with DataError.within(source):
            data = Dataset(**as_tensors(fields, self.dtype, torch.device(self.device)))
        data = data[piece.before : piece.before + piece.rows]
        if self.joints is not None and not set(self.joints) - set(data.joint_names):
            data = data.select(self.joints)
        with DataError.within(str(path)):
            check_alike([data[:1] if first is None else first, data[:1]])
        return data


def spaced_sample(pieces: Iterable[Dataset], count: int, keep: Keep | None = None) -> tuple[Dataset, int]:
    """Return evenly spaced rows of a log of unknown length, and the total number of rows kept by `keep`.

    The number of rows is between `count` and 2 `count`, or all rows if there are fewer. The log is read in
    one pass. Raise `DataError` if there are no pieces.
    """
    kept: list[tuple[Tensor, Dataset]] = []
    step, total = 1, 0
    for piece in pieces:
        rows = torch.arange(len(piece), device=piece.device) if keep is None else keep(piece)
        place = total + torch.arange(len(rows), device=piece.device)
        chosen = place % step == 0
        kept.append((place[chosen], piece[rows[chosen]]))
        total += len(rows)
        while sum(len(place) for place, _ in kept) >= 2 * count:
            step *= 2
            kept = [(place[place % step == 0], data[place % step == 0]) for place, data in kept]
        kept = [part for i, part in enumerate(kept) if len(part[0]) or i == 0]
    if not kept:
        raise DataError("there are no samples to read", expected="at least one", got="none")
    parts = [data for _, data in kept]
    segment = torch.cat([part.segment for part in parts])  # a segment may extend over several pieces
    return Dataset.concatenate(parts).replace(segment=segment, header=parts[0].header), total
