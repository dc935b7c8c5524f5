"""Named numeric columns on disk: Parquet files with a JSON header, and CSV files."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.data.fields import DataHeader
from forcegp.errors import DataError, near_names
from forcegp.files import atomic_file
from forcegp.guards import allowed_bytes, damaged, foreign
from forcegp.resources import announce_memory

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

Columns = dict[str, NDArray[np.generic]]

HEADER_KEY = b"forcegp"
COPIES = 4
"""Number of copies of a table in memory: the reader's columns, arrays, concatenated arrays, and tensors."""

GROUP_ROWS = 1 << 18
"""Number of rows to write at a time, which avoids a second copy of a long log in memory."""


class IgnoredColumnsWarning(UserWarning):
    """Warning that columns with unknown names were ignored."""


def check_ending(path: str | Path) -> None:
    """Raise `DataError` unless the name of an output file ends in `.parquet`."""
    if Path(path).suffix.lower() != ".parquet":
        raise DataError(f"{path}: data sets are written as Parquet", hint="end the name in .parquet")


def write_parquet(path: str | Path, columns: Columns, header: DataHeader) -> None:
    """Write columns and header to a Parquet file atomically; raise `OSError` if this fails."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema({name: pa.from_numpy_dtype(values.dtype) for name, values in columns.items()})
    schema = schema.with_metadata({HEADER_KEY: header.to_json().encode()})
    rows = max(map(len, columns.values()), default=0)
    with atomic_file(path) as file, pq.ParquetWriter(file.absolute(), schema, compression="zstd") as writer:
        for start in range(0, rows, GROUP_ROWS):
            group = {name: pa.array(values[start : start + GROUP_ROWS]) for name, values in columns.items()}
            writer.write_table(pa.table(group, schema=schema))


def read_table(
    path: str | Path, *, missing: Literal["refuse", "nan"] = "refuse"
) -> tuple[Columns, DataHeader]:
    """Return the numeric columns and the header (or a default header) of a Parquet or CSV file.

    Empty values are errors, or NaN if `missing` is `"nan"`. Unreadable files raise `DataError`.
    """
    file = existing(path)
    readers = {".parquet": _read_parquet, ".csv": _read_csv}
    if file.suffix.lower() not in readers:
        kinds, text = " or ".join(readers), f"{file}: this type of data file is not supported"
        raise DataError(text, expected=kinds, got=file.suffix)
    table, header = readers[file.suffix.lower()](file)
    return {name: numeric(file, name, table[name], missing) for name in table.column_names}, header


def existing(path: str | Path) -> Path:
    """Return the path of an existing file; raise a `DataError` that suggests the nearest name otherwise."""
    file = Path(path)
    with foreign(str(path), "a path"):
        if file.is_file():
            return file
        if not file.parent.is_dir():
            hint = f"the folder {file.parent} does not exist"
        else:
            near = near_names(file.name, (other.name for other in file.parent.iterdir()))
            hint = f"did you mean {file.with_name(near[0])}?" if near else None
    raise DataError(f"{file}: no such file", hint=hint)


def _read_parquet(file: Path) -> tuple[pa.Table, DataHeader]:
    """Return the columns after checking their size in memory, which may be far larger than the file."""
    with opened_parquet(file) as (parquet, usable, header):
        rows, columns = parquet.metadata.num_rows, len(usable)
        allowed = min(allowed_bytes(file.stat().st_size), limits.TABLE_BYTES)
        if 8 * rows * columns > allowed:
            raise DataError(
                f"{file}: the declared size of the file exceeds the limit",
                expected=f"at most {allowed // 8:,} numbers in a file of this size",
                got=f"{rows:,} rows × {columns} columns",
                hint="split the log into several files",
            )
        announce_memory(COPIES * 8 * rows * columns, f"reading {file}")
        return parquet.read(columns=usable, use_threads=False), header


@contextmanager
def opened_parquet(file: Path) -> Iterator[tuple[pq.ParquetFile, list[str], DataHeader]]:
    """Open a Parquet file, and yield it with its numeric columns and header; raise `DataError` if invalid."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # pre_buffer is off: a damaged offset must not make the reader request the whole address space.
        with pq.ParquetFile(file.absolute()) as parquet:  # Arrow expands a leading ~
            shape = parquet.metadata
            _check_count(file, shape.num_columns)
            text = (parquet.schema_arrow.metadata or {}).get(HEADER_KEY)
            header = DataHeader() if text is None else DataHeader.from_json(text, str(file), DataError)
            usable = _usable(file, parquet.schema_arrow)
            _check_flat(file, usable, [parquet.schema.column(i).path for i in range(shape.num_columns)])
            yield parquet, usable, header
    except (pa.ArrowException, OSError, MemoryError, OverflowError, UnicodeDecodeError) as cause:
        raise damaged(str(file), "Parquet", cause) from cause


def _check_count(file: Path, columns: int) -> None:
    if columns > limits.COLUMNS:
        most, hint = f"at most {limits.COLUMNS}", "write only the columns of the robot"
        raise DataError(f"{file}: too many columns", expected=most, got=columns, hint=hint)


def _check_flat(file: Path, usable: list[str], paths: list[str]) -> None:
    """Check that the names of numeric columns do not also select lists or structs."""
    names = set(usable)
    for path in (path for path in paths if path not in names):
        prefixes = accumulate(path.split("."), "{}.{}".format)
        outer = next((prefix for prefix in prefixes if prefix in names), None)
        if outer is not None:
            raise DataError(f"{file}: {path!r} lies inside column {outer!r}", hint="rename one of them")


def _read_csv(file: Path) -> tuple[pa.Table, DataHeader]:
    import pyarrow as pa
    from pyarrow import csv

    with file.open("rb") as opened:
        first, second = (opened.readline(limits.HEADER_BYTES + 1) for _ in range(2))
    if len(first) > limits.HEADER_BYTES:
        most = f"at most {limits.HEADER_BYTES} bytes of column names"
        raise DataError(f"{file}: the first line is too long", expected=most)
    columns = first.count(b",") + 1
    _check_count(file, columns)
    rows = file.stat().st_size // max(len(second), 2 * columns)
    announce_memory(COPIES * 8 * rows * columns, f"reading {file}")
    try:
        table = csv.read_csv(file.absolute(), read_options=csv.ReadOptions(use_threads=False))
        return table.select(_usable(file, table.schema)), DataHeader()
    except (pa.ArrowException, OSError, MemoryError, UnicodeDecodeError) as cause:
        raise DataError(
            f"{file}: the file cannot be read as CSV",
            expected="a first line of column names in UTF-8, and the same number of commas in every line",
            got=str(cause).splitlines()[0] if str(cause) else type(cause).__name__,
        ) from cause


def _usable(file: Path, schema: pa.Schema) -> list[str]:
    """Return the names of the numeric columns; warn about other columns, and reject duplicate names."""
    import pyarrow.types as kinds

    names = schema.names
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise DataError(f"{file}: column {twice[0]!r} occurs more than once")
    if any(len(name) > limits.COLUMN_NAME for name in names):
        raise DataError(f"{file}: a column name is longer than {limits.COLUMN_NAME} characters")
    kept = (kinds.is_floating, kinds.is_integer, kinds.is_boolean)
    numeric = [field.name for field in schema if any(kind(field.type) for kind in kept)]
    ignored = sorted(set(names) - set(numeric), key=names.index)
    # Text columns that should be numeric are reported by name when they are needed; others are harmless.
    if ignored:
        text = f"{file}: non-numeric columns are ignored: {', '.join(ignored)}"
        warnings.warn(text, IgnoredColumnsWarning, stacklevel=5)
    return numeric


def numeric(file: Path, name: str, column: pa.ChunkedArray, missing: str) -> NDArray[np.generic]:
    """Return the values of a column. Missing values raise `DataError` or become NaN."""
    if column.null_count and missing == "refuse":
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        text = f"{file}: column {name!r} has {column.null_count} missing values, the first in row {row}"
        raise DataError(text, expected="a number in every row", got="an empty value")
    return column.to_numpy()
