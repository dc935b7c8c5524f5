"""Named numeric columns on disk: Parquet with a JSON header, and CSV.

This file knows files and columns; what the columns mean is in `columns.py`.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from forcegp.data.header import DataHeader
from forcegp.errors import DataError
from forcegp.files import MAX_HEADER_BYTES, atomic_file

if TYPE_CHECKING:
    import pyarrow as pa

Columns = dict[str, NDArray[np.generic]]

HEADER_KEY = b"forcegp"
MAX_BYTES = 8 << 30
"""Largest table, in bytes of float64: a small compressed file can claim to hold more than memory does."""


class IgnoredColumnsWarning(UserWarning):
    """Columns of a log that are not of a name this library knows were left out."""


def write_parquet(path: str | Path, columns: Columns, header: DataHeader) -> None:
    """Write columns and header to a Parquet file, whole or not at all.

    Raises:
        OSError: the place cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({name: pa.array(values) for name, values in columns.items()})
    table = table.replace_schema_metadata({HEADER_KEY: header.to_json().encode()})
    with atomic_file(path) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def read_table(
    path: str | Path, *, missing: Literal["refuse", "nan"] = "refuse"
) -> tuple[Columns, DataHeader]:
    """Read the numeric columns of a Parquet or CSV file, and its header (defaults where it has none).

    Args:
        path: the file.
        missing: whether an empty value is an error or becomes a NaN.

    Raises:
        DataError: no such file, a kind of file that is not read, or one that is damaged or too large.
    """
    file = Path(path)
    if not file.is_file():
        raise DataError(f"{file}: no such file", hint=_files_beside(file))
    readers = {".parquet": _read_parquet, ".csv": _read_csv}
    if file.suffix.lower() not in readers:
        raise DataError(
            f"{file}: not a kind of data file that is read", expected=" or ".join(readers), got=file.suffix
        )
    table, header = readers[file.suffix.lower()](file)
    return {name: _numeric(file, name, table.column(name), missing) for name in _usable(file, table)}, header


def _files_beside(file: Path) -> str | None:
    from difflib import get_close_matches

    if not file.parent.is_dir():
        return f"the folder {file.parent} does not exist"
    near = get_close_matches(file.name, [other.name for other in file.parent.iterdir()], n=1)
    return f"did you mean {file.with_name(near[0])}?" if near else None


def _read_parquet(file: Path) -> tuple[pa.Table, DataHeader]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(file) as parquet:
            shape = parquet.metadata
            _check_size(file, shape.num_rows, shape.num_columns)
            header = _header(file, parquet.schema_arrow.metadata or {})
            # pre_buffer off: a damaged offset must not make the reader ask for the whole address space.
            return parquet.read(use_threads=False), header
    except (pa.ArrowException, OSError, MemoryError, OverflowError, UnicodeDecodeError) as cause:
        raise DataError(
            f"{file}: the file is damaged, truncated or not Parquet",
            got=str(cause).splitlines()[0] if str(cause) else type(cause).__name__,
            hint="write it again from its source; an interrupted copy is the usual cause",
        ) from cause


def _check_size(file: Path, rows: int, columns: int) -> None:
    if rows * columns * 8 > MAX_BYTES:
        raise DataError(
            f"{file}: the file claims to be larger than what is read at once",
            expected=f"at most {MAX_BYTES // 8:,} numbers",
            got=f"{rows:,} rows × {columns} columns",
            hint="split the log into several files",
        )


def _header(file: Path, metadata: dict[bytes, bytes]) -> DataHeader:
    if HEADER_KEY not in metadata:
        return DataHeader()
    text = metadata[HEADER_KEY]
    if len(text) > MAX_HEADER_BYTES:
        raise DataError(
            f"{file}: the header is too large", expected=f"at most {MAX_HEADER_BYTES} bytes", got=len(text)
        )
    return DataHeader.from_json(text, str(file), DataError)


def _read_csv(file: Path) -> tuple[pa.Table, DataHeader]:
    import pyarrow as pa
    from pyarrow import csv

    try:
        return csv.read_csv(file, read_options=csv.ReadOptions(use_threads=False)), DataHeader()
    except (pa.ArrowException, OSError, UnicodeDecodeError) as cause:
        raise DataError(
            f"{file}: the file cannot be read as CSV",
            expected="a first line of column names, and the same number of commas in every line",
            got=str(cause).splitlines()[0],
        ) from cause


def _usable(file: Path, table: pa.Table) -> list[str]:
    """Names of the numeric columns; the others are reported, a name that occurs twice is an error."""
    import pyarrow.types as kinds

    names = table.column_names
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(f"{file}: column {twice[0]!r} occurs more than once")
    numeric = [
        field.name
        for field in table.schema
        if kinds.is_floating(field.type) or kinds.is_integer(field.type) or kinds.is_boolean(field.type)
    ]
    left_out = [name for name in names if name not in numeric]
    # A text column that should be numbers is reported by name once it is missed; the rest is harmless.
    if left_out:
        warnings.warn(
            f"{file}: columns that hold no numbers are left out: {', '.join(left_out)}",
            IgnoredColumnsWarning,
            stacklevel=4,
        )
    return numeric


def _numeric(file: Path, name: str, column: pa.ChunkedArray, missing: str) -> NDArray[np.generic]:
    if column.null_count and missing == "refuse":
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise DataError(
            f"{file}: column {name!r} has {column.null_count} missing values, the first in row {row}",
            expected="a number in every row",
            got="an empty value",
        )
    return column.to_numpy()
