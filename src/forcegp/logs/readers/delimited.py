"""CSV and text columns with any separator, decimal mark and heading, read in blocks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from forcegp import limits
from forcegp.logs import bounds
from forcegp.logs.readers.sniff import MISSING, Dialect, sniff
from forcegp.logs.table import Column, Growing, LogTable, Progress, Stream, Wanted, foreign

if TYPE_CHECKING:
    import pyarrow as pa

BLOCK_BYTES = 4 << 20
"""How much text is parsed at a time."""

_BLANKS = re.compile(rb"[ \t]+")
_EDGES = re.compile(rb"(?m)^ | (?=\r?$)")


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read a text table; columns of text are left out with a remark.

    Raises:
        DataError: not a table, a line with another number of fields, or a field that is not a number.
    """
    dialect = sniff(path)
    chosen = [name for name, kind in zip(dialect.names, dialect.kinds, strict=True) if wanted(name)]
    kinds = dict(zip(dialect.names, dialect.kinds, strict=True))
    remarks = [
        f"column {name!r} holds {kinds[name]} and was left out" for name in chosen if kinds[name] == "text"
    ]
    chosen = [name for name in chosen if kinds[name] not in ("text", "empty")]
    columns = {name: Growing(_rows_expected(path)) for name in chosen}
    with foreign(str(path), "a table of text"), path.open("rb") as file:
        for batch in _batches(path, file, dialect, chosen, kinds, progress) if chosen else ():
            read_rows = len(columns[chosen[0]]) + len(batch)
            bounds.check_values(str(path), read_rows, len(chosen))
            for name in chosen:
                columns[name].append(_numbers(batch.column(name), kinds[name]))
            if rows is not None and read_rows >= rows:
                break
    values = {name: columns.pop(name).array(rows) for name in chosen}
    if dialect.encoding == "cp1252":
        remarks.append("the file is not UTF-8 and was read as Windows-1252")
    units = {name: unit for name, unit in dialect.units.items() if name in values}
    return LogTable(str(path), "text", (Stream("", values, units),), tuple(remarks))


def _rows_expected(path: Path) -> int:
    """A guess from the length of the first lines."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    return int(path.stat().st_size / max(len(head), 1) * (head.count(b"\n") + 1) * 1.05)


def _batches(
    path: Path,
    file: IO[bytes],
    dialect: Dialect,
    chosen: list[str],
    kinds: dict[str, str],
    progress: Progress | None,
) -> Iterator[pa.RecordBatch]:
    """Batches of rows of the chosen columns."""
    import pyarrow as pa
    from pyarrow import csv

    types = {"number": pa.float64(), "bool": pa.bool_(), "date": pa.timestamp("ns")}
    source = _Blocks(file, dialect, path.stat().st_size, progress)
    options: dict[str, Any] = {"decimal_point": dialect.decimal, "null_values": list(MISSING)}
    reader = csv.open_csv(
        pa.PythonFile(source, mode="r"),
        read_options=csv.ReadOptions(
            use_threads=True,
            block_size=BLOCK_BYTES,
            skip_rows=dialect.first_line,
            column_names=list(dialect.names),
            encoding="utf-8" if dialect.encoding == "utf-8-sig" else dialect.encoding,
        ),
        parse_options=csv.ParseOptions(delimiter=dialect.separator, ignore_empty_lines=True),
        convert_options=csv.ConvertOptions(
            include_columns=chosen, column_types={name: types[kinds[name]] for name in chosen}, **options
        ),
    )
    yield from reader


def _numbers(values: pa.Array, kind: str) -> Column:
    """A column as float64: times of day in seconds of the epoch, true and false as 1 and 0."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if kind == "date":
        # Seconds since 2020 keep the nanoseconds that seconds since 1970 lose in float64.
        whole = pc.cast(values, pa.int64()).to_numpy(zero_copy_only=False)
        return (whole - DATE_ORIGIN_NS).astype(np.float64) * 1e-9
    return pc.cast(values, pa.float64()).to_numpy(zero_copy_only=False)


DATE_ORIGIN_NS = 1_577_836_800_000_000_000
"""2020-01-01 in nanoseconds of the epoch: the origin of times that are given as dates."""


class _Blocks:
    """A binary file for the parser: counts what was read, and makes one blank of a run of blanks."""

    def __init__(self, file: IO[bytes], dialect: Dialect, size: int, progress: Progress | None) -> None:
        self._file, self._size, self._progress = file, size, progress
        self._collapse = dialect.separator == " "
        self._rest = b""
        self._done = 0
        self.closed = False

    def read(self, count: int = -1) -> bytes:
        block = self._file.read(count if count and count > 0 else BLOCK_BYTES)
        self._done += len(block)
        if self._progress is not None:
            self._progress(self._done, self._size)
        if not self._collapse:
            return block
        text = self._rest + block
        # Blanks at the edges of a line are only known once the line is complete.
        end = text.rfind(b"\n") + 1 if block else len(text)
        self._rest, text = text[end:], text[:end]
        bounds.check_count("the text", "bytes in a line", len(self._rest), limits.LINE_BYTES + BLOCK_BYTES)
        result = _EDGES.sub(b"", _BLANKS.sub(b" ", text))
        return result if result or not block else self.read(count)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return False

    def writable(self) -> bool:
        return False

    def tell(self) -> int:
        return self._done

    def close(self) -> None:
        self.closed = True
