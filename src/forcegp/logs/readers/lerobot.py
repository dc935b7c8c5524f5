"""LeRobot data sets, version 2.1 and 3: a folder with `meta/info.json` and Parquet files of episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs import bounds
from forcegp.logs.readers.parquet import read_columns
from forcegp.logs.table import Column, LogTable, Progress, Stream, Wanted, foreign

MAX_INFO_BYTES = 4 << 20
"""Size of the description of a data set."""


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the columns of numbers of all episodes; `observation.state` of six motors becomes six columns.

    The columns are named as in `meta/info.json`: `observation.state.<motor>`, or `observation.state[i]`
    where the motors have no names. Images and videos are not read.

    Raises:
        DataError: the folder is not a LeRobot data set, or is damaged or too large.
    """
    features = _features(path / "meta" / "info.json")
    files = sorted((path / "data").rglob("*.parquet"))
    bounds.check_count(str(path), "files", len(files), limits.LOG_FILES)
    if not files:
        raise DataError(f"{path}: no episodes", expected=f"Parquet files below {path / 'data'}")
    names: dict[str, str] = {}
    for feature, description in features.items():
        for i, motor in enumerate(_motors(description)):
            names[f"{feature}[{i}]"] = f"{feature}.{motor}"[: limits.LOG_NAME]
    remarks: list[str] = []
    with foreign(str(path), "a LeRobot data set"):
        columns = read_columns(files, lambda n: wanted(names.get(n, n)), rows, remarks, progress)
    renamed: dict[str, Column] = {}
    for name, values in columns.items():
        renamed[names.get(name, name)] = values
    return LogTable(str(path), "lerobot", (Stream("", renamed),), tuple(remarks))


def _features(file: Path) -> dict[str, Any]:
    bounds.check_count(str(file), "bytes", file.stat().st_size, MAX_INFO_BYTES)
    try:
        info = json.loads(file.read_text(encoding="utf-8"))
        features = info["features"]
        if not isinstance(features, dict):
            raise TypeError("features is not a table")
    except (ValueError, KeyError, TypeError, RecursionError) as cause:
        raise DataError(
            f"{file}: not the description of a LeRobot data set",
            expected="JSON with 'features'",
            got=str(cause)[:200],
        ) from cause
    return features


def _motors(description: Any) -> list[str]:
    """Names of the numbers of a feature: a list, or a list under one key such as `motors`."""
    names = description.get("names") if isinstance(description, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if isinstance(names, list) and all(isinstance(n, str) for n in names) and len(set(names)) == len(names):
        return names[: limits.COLUMNS]
    return []
