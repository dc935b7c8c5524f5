"""Readers of Parquet tables and of LeRobot data sets.

Vectors may be list columns or separate columns. A LeRobot data set (version 2.1 or 3) is a folder with
`meta/info.json` and the Parquet files of its episodes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forcegp import guards, limits
from forcegp.errors import DataError
from forcegp.guards import within
from forcegp.logs import table
from forcegp.logs.table import Column, LogTable, Progress, Stream, Wanted

if TYPE_CHECKING:
    import pyarrow as pa


BATCH_ROWS = 1 << 16
"""Number of rows decoded at a time."""


def read_parquet(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read columns of numbers, flags and times. A list column becomes `name[0]`, `name[1]`, and so on."""
    remarks: list[str] = []
    with guards.foreign(str(path), "Parquet"):
        columns = read_columns([path], wanted, rows, remarks, progress)
    return LogTable(str(path), "parquet", (Stream("", columns),), tuple(remarks))


def read_columns(
    paths: list[Path], wanted: Wanted, rows: int | None, remarks: list[str], progress: Progress | None
) -> dict[str, Column]:
    """Return the joined columns of files, with lists as `name[i]`, and note omitted ones in `remarks`."""
    import pyarrow.parquet as pq

    chunks: dict[str, list[Column]] = {}
    total = 0
    for path in paths:
        with pq.ParquetFile(path.absolute(), pre_buffer=False) as file:
            total += _check(path, file, set(_readable(file, wanted, [])))
            table.check_values(str(path), total, 1)
    length = sum(path.stat().st_size for path in paths)
    done = 0
    for path in paths:
        with pq.ParquetFile(path.absolute(), pre_buffer=False) as file:
            names = _readable(file, wanted, remarks)
            for batch in file.iter_batches(BATCH_ROWS, columns=names, use_threads=False):
                for name in names:
                    for part, values in _expand(str(path), name, batch.column(name)).items():
                        if wanted(part) or wanted(name):
                            chunks.setdefault(part, []).append(values)
                done += len(batch)
                table.check_values(str(path), done, max(len(chunks), 1))
                guards.check_expansion(str(path), 8 * done * len(chunks), length)
                if progress is not None:
                    progress(done, total)
                if rows is not None and done >= rows:
                    break
    columns = table.joined(chunks, rows)
    for name, values in columns.items():
        if len(values) != min(done, rows or done):
            raise DataError(f"{paths[0]}: column {name!r} is missing in some of the files")
    return columns


def _check(path: Path, file: object, names: set[str]) -> int:
    """Return the number of rows in a file after checking the declared size of its columns."""
    shape = file.metadata  # pyright: ignore[reportAttributeAccessIssue]
    guards.check_count(str(path), "columns", shape.num_columns, limits.COLUMNS)
    groups = [shape.row_group(i) for i in range(shape.num_row_groups)]
    columns = [group.column(j) for group in groups for j in range(group.num_columns)]
    columns = [column for column in columns if column.path_in_schema.partition(".")[0] in names]
    numbers = sum(column.num_values for column in columns)
    guards.check_count(str(path), "numbers", numbers, limits.LOG_VALUES)
    unpacked = max(8 * numbers, sum(column.total_uncompressed_size for column in columns))
    guards.check_expansion(str(path), unpacked, path.stat().st_size)
    return shape.num_rows


def _readable(file: object, wanted: Wanted, remarks: list[str]) -> list[str]:
    import pyarrow.types as kinds

    names = []
    for field in file.schema_arrow:  # pyright: ignore[reportAttributeAccessIssue]
        listed = _is_list(field.type)
        kind = field.type.value_type if listed else field.type
        numeric = kinds.is_floating(kind) or kinds.is_integer(kind) or kinds.is_boolean(kind)
        selected = wanted(field.name) or (listed and any(wanted(f"{field.name}[{i}]") for i in range(64)))
        remark = f"column {field.name!r} of type {field.type} was left out"
        if selected and (numeric or (kinds.is_timestamp(kind) and not listed)):
            names.append(field.name)
        elif selected and remark not in remarks:
            remarks.append(remark)
    return names


def _is_list(kind: pa.DataType) -> bool:
    import pyarrow.types as kinds

    return kinds.is_list(kind) or kinds.is_fixed_size_list(kind) or kinds.is_large_list(kind)


def _expand(source: str, name: str, values: pa.Array) -> dict[str, Column]:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.types as kinds

    if kinds.is_timestamp(values.type):
        nanoseconds = pc.cast(pc.cast(values, pa.timestamp("ns")), pa.int64())
        return {name: nanoseconds.to_numpy(zero_copy_only=False) * 1e-9}
    if not _is_list(values.type):
        return {name: pc.cast(values, pa.float64(), safe=False).to_numpy(zero_copy_only=False)}
    lengths = pc.call_function("list_value_length", [values]).to_numpy(zero_copy_only=False)
    width = int(lengths[0]) if len(lengths) and lengths[0] == lengths[0] else 0
    if (other := lengths != width).any():
        row, text = int(np.argmax(other)), f"{source}: column {name!r} has lists of different length"
        got = f"{lengths[row]} in row {row}"
        raise DataError(text, expected=f"{width} numbers in every row", got=got)
    guards.check_count(source, "columns", width, limits.COLUMNS)
    flat = pc.cast(values.flatten(), pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    numbers = flat.reshape(len(values), width)
    return {f"{name}[{i}]": np.ascontiguousarray(numbers[:, i]) for i in range(width)}


MAX_INFO_BYTES = 4 << 20
"""Maximum size of the description of a data set."""


def read_lerobot(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the numbers in all episodes, named as in `meta/info.json` (e.g. `observation.state.<motor>`)."""
    listed = path / "meta" / "info.json", *sorted((path / "data").rglob("*.parquet"))
    description, *files = within(path, listed)
    guards.check_count(str(description), "bytes", description.stat().st_size, MAX_INFO_BYTES)
    try:
        features = json.loads(description.read_text(encoding="utf-8"))["features"]
        if not isinstance(features, dict):
            raise TypeError("features is not a table")
    except (ValueError, KeyError, TypeError, RecursionError) as cause:
        text = f"{description}: not the description of a LeRobot data set"
        raise DataError(text, expected="JSON with 'features'", got=str(cause)[:200]) from cause
    guards.check_count(str(path), "files", len(files), limits.LOG_FILES)
    if not files:
        raise DataError(f"{path}: no episodes", expected=f"Parquet files below {path / 'data'}")
    names = {
        f"{feature}[{i}]": f"{feature}.{motor}"[: limits.LOG_NAME]
        for feature, columns in features.items()
        for i, motor in enumerate(_motors(columns))
    }
    remarks: list[str] = []
    with guards.foreign(str(path), "a LeRobot data set"):
        columns = read_columns(files, lambda n: wanted(names.get(n, n)), rows, remarks, progress)
    renamed = {names.get(name, name): values for name, values in columns.items()}
    return LogTable(str(path), "lerobot", (Stream("", renamed),), tuple(remarks))


def _motors(description: Any) -> list[str]:
    """Return the names of a feature's values, which are a list, possibly under a key such as `motors`."""
    names = description.get("names") if isinstance(description, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if isinstance(names, list) and all(isinstance(n, str) for n in names) and len(set(names)) == len(names):
        return names[: limits.COLUMNS]
    return []
