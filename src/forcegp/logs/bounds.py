"""Checks of what a foreign log claims, before the work is done; the bounds are in `forcegp.limits`.

A small compressed file can claim to hold more than memory does.
"""

from __future__ import annotations

from forcegp import limits
from forcegp.errors import DataError
from forcegp.resources import announce_memory

COPIES = 2
"""A table is in memory as it is in the file, and as float64."""


def check_count(source: str, what: str, count: int, most: int) -> None:
    """Raise `DataError` where a log claims more than `most` of something.

    Args:
        source: name of the file, for the message.
        what: what is counted, in the plural.
        count: the claim.
        most: the bound.

    >>> check_count("run.csv", "columns", 12, limits.COLUMNS)
    """
    if count > most:
        raise DataError(
            f"{source}: the log claims too many {what}",
            expected=f"at most {most:,}",
            got=f"{count:,}",
            hint="split the log, or export only the columns that are needed",
        )


def check_expansion(source: str, size: int, file: int) -> None:
    """Raise `DataError` where a small file claims to hold far more than it is long.

    Args:
        source: name of the file, for the message.
        size: of what it claims to hold [bytes].
        file: length of the file [bytes].
    """
    allowed = max(limits.FREE_TABLE_BYTES, limits.TABLE_EXPANSION * file)
    if size > allowed:
        raise DataError(
            f"{source}: the file claims to be larger than what is read at once",
            expected=f"at most {allowed:,} bytes in a file of this size",
            got=f"{size:,}",
            hint="split the log into several files",
        )


def check_values(source: str, rows: int, columns: int) -> None:
    """Raise `DataError` where a table is wider or larger than what is read; announce a large one."""
    check_count(source, "columns", columns, limits.COLUMNS)
    check_count(source, f"numbers ({rows:,} rows × {columns} columns)", rows * columns, limits.LOG_VALUES)
    announce_memory(COPIES * 8 * rows * columns, f"reading {source}")
