"""A folder of text files, each with one quantity: `q.txt`, `tau.txt`, …"""

from __future__ import annotations

from pathlib import Path

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs import bounds
from forcegp.logs.readers import delimited
from forcegp.logs.table import Column, LogTable, Progress, Stream, Wanted

ENDINGS = (".txt", ".csv", ".tsv", ".dat", ".asc")
"""Endings of the files that are read; others in the folder are not."""


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the tables of a folder; a column is `file[i]`, or `file.heading` where the file has headings.

    Files with the same number of rows share a clock and make one stream.

    Raises:
        DataError: a file is not a table of numbers, or the folder is too large.
    """
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in ENDINGS and p.is_file())
    bounds.check_count(str(path), "files", len(files), limits.LOG_FILES)
    groups: dict[int, dict[str, Column]] = {}
    remarks: list[str] = []
    for number, file in enumerate(files):
        try:
            table = delimited.read(file, wanted=_within(file.stem, wanted), rows=rows, progress=None)
        except DataError as error:
            if "no table of numbers" not in error.message:
                raise
            remarks.append(f"{file.name} holds no table of numbers and was left out")
            continue
        remarks += [f"{file.name}: {remark}" for remark in table.remarks]
        columns = {_name(file.stem, name): values for name, values in table.streams[0].columns.items()}
        if columns:
            groups.setdefault(len(next(iter(columns.values()))), {}).update(columns)
            bounds.check_values(str(path), 1, sum(map(len, groups.values())))
        if progress is not None:
            progress(number + 1, len(files))
    most = max(groups, key=lambda length: (len(groups[length]), length), default=0)
    ordered = sorted(groups.items(), key=lambda item: item[0] != most)
    streams = tuple(Stream("" if n == most else f"{n} rows", columns) for n, columns in ordered)
    return LogTable(str(path), "text folder", streams, tuple(remarks))


def _name(stem: str, column: str) -> str:
    return f"{stem}[{column}]" if column.isdigit() else f"{stem}.{column}"


def _within(stem: str, wanted: Wanted) -> Wanted:
    return lambda column: wanted(_name(stem, column))
