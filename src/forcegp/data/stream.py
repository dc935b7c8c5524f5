"""A long log in Parquet files, read a piece at a time in memory that does not grow with its rows."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from forcegp.data import columns, compatible
from forcegp.data.batches import Piece, pieces_of, shape_of
from forcegp.data.dataset import Dataset
from forcegp.data.derivative import SavitzkyGolay
from forcegp.data.header import DataHeader
from forcegp.data.table import IgnoredColumnsWarning
from forcegp.errors import DataError

PIECE_ROWS = 8192
"""Rows that are read at a time."""
Keep = Callable[[Dataset], Tensor]
"""Row numbers of a piece that count."""


@dataclass(frozen=True)
class StreamedDataset:
    """A log of any length in one or several Parquet files, one after another.

    Each file has trajectories of its own. Velocities and accelerations that the files lack are computed as by
    `Dataset.read`, never across two trajectories; the noise of what is computed is estimated piece by piece.

    Args:
        paths: the files; their joints, contacts and further columns must agree.
        differentiate: how to compute the columns `qd` and `qdd` where the log has none.
        joints: the joints wanted, in this order; by default those of the files.
        dtype, device: of the tensors.
        distributed: whether the processes of `torch.distributed` share the pieces in a fit. Each of them
            makes the same call and gets the same fit.

    Raises:
        DataError: there is not a file, one does not exist, or one is not Parquet.

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
    distributed: bool = False

    def __post_init__(self) -> None:
        if not self.files:
            raise DataError("there are no files to read", expected="at least one Parquet file", got="none")
        self._shapes  # noqa: B018  (damaged files are refused before any work)

    @cached_property
    def files(self) -> tuple[Path, ...]:
        """The files as paths."""
        given = (self.paths,) if isinstance(self.paths, str | Path) else self.paths
        return tuple(map(Path, given))

    @cached_property
    def _shapes(self) -> tuple[tuple[int, DataHeader], ...]:
        """Rows and header of each file."""
        return tuple(shape_of(path) for path in self.files)

    def __len__(self) -> int:
        """Number of samples."""
        return sum(rows for rows, _ in self._shapes)

    @property
    def piece_count(self) -> int:
        """Number of pieces."""
        return sum(-(-rows // PIECE_ROWS) for rows, _ in self._shapes)

    @cached_property
    def header(self) -> DataHeader:
        """What the headers of all files agree on."""
        headers = [header for _, header in self._shapes]
        return headers[0] if len(headers) == 1 else compatible.common_header(headers)

    def select(self, joints: Sequence[str]) -> StreamedDataset:
        """The log with its joints reordered, or only some of them."""
        return dataclasses.replace(self, joints=tuple(joints))

    def pieces(self, start: int = 0, share: tuple[int, int] = (0, 1)) -> Iterator[Dataset]:
        """The log in order, `PIECE_ROWS` rows at a time; segments are numbered throughout.

        Args:
            start: number of pieces to skip.
            share: (r, k) leaves every piece but the r-th of each k empty, as it belongs to another process.

        Raises:
            DataError: a file is damaged or not a valid log, or differs from the first one in its columns.
        """
        first, number, count = None, 0, 0
        window = self.differentiate.window if self.differentiate is not None else 0
        for path in self.files:
            for piece in pieces_of(path, PIECE_ROWS, window, number):
                number = piece.last_segment
                count += 1
                own = count > start and (count - 1) % share[1] == share[0]
                if own or first is None:
                    data = self._dataset(path, piece)
                    first = data[:1] if first is None else first
                    _check_alike(path, first, data)
                    if own:
                        yield data
                if count > start and not own:
                    yield first[:0]
            number += 1

    def _dataset(self, path: Path, piece: Piece) -> Dataset:
        source = str(path) if piece.first == 0 else f"{path} (rows counted from {piece.first - piece.before})"
        with warnings.catch_warnings():
            if piece.first:  # One warning per file is enough.
                warnings.simplefilter("ignore", IgnoredColumnsWarning)
            fields = columns.parse(source, piece.columns, piece.header, self.differentiate)
        names = {name: fields["header"].__dict__[name] for name in ("joint_names", "contact_names")}
        fields["header"] = self.header.model_copy(update=names)
        try:
            data = Dataset(**columns.as_tensors(fields, self.dtype, torch.device(self.device)))
        except DataError as error:
            raise DataError.at(source, error) from None
        data = data[piece.before : piece.before + piece.rows]
        if self.joints is None or set(self.joints) - set(data.joint_names):
            return data
        return data.select(self.joints)


def _check_alike(path: Path, first: Dataset, data: Dataset) -> None:
    try:
        compatible.check_alike([first, data[:1]])
    except DataError as error:
        raise DataError.at(str(path), error) from None


def spaced_sample(pieces: Iterable[Dataset], count: int, keep: Keep | None = None) -> tuple[Dataset, int]:
    """Evenly spaced rows of a log of unknown length, in one pass.

    Args:
        pieces: the log.
        count: how many rows to keep at least, where there are so many; fewer than twice as many are kept.
        keep: which rows of a piece count; all by default.

    Returns:
        The rows as one data set, and the number of all rows that count.

    Raises:
        DataError: there are no pieces.
    """
    kept: list[tuple[Tensor, Dataset]] = []
    step, seen = 1, 0
    for piece in pieces:
        rows = torch.arange(len(piece), device=piece.device) if keep is None else keep(piece)
        place = seen + torch.arange(len(rows), device=piece.device)
        own = place % step == 0
        kept.append((place[own], piece[rows[own]]))
        seen += len(rows)
        while sum(len(place) for place, _ in kept) >= 2 * count:
            step *= 2
            kept = [(place[place % step == 0], data[place % step == 0]) for place, data in kept]
        kept = [part for i, part in enumerate(kept) if len(part[0]) or i == 0]
    return _joined([data for _, data in kept]), seen


def _joined(parts: list[Dataset]) -> Dataset:
    """Data sets one after another; a segment may go on from one to the next."""
    if not parts:
        raise DataError("there are no samples to read", expected="at least one", got="none")
    segment = torch.cat([part.segment for part in parts])
    return Dataset.concatenate(parts).replace(segment=segment, header=parts[0].header)
