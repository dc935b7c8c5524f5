"""Bounds on what is read from a foreign log, checked before the work is done.

A small compressed file can claim to hold more than memory does; each reader compares the claim with
these numbers first.
"""

from __future__ import annotations

from forcegp.errors import DataError

MAX_VALUES = 1 << 28
"""Numbers read from one log: 2 GiB of float64."""
MAX_COLUMNS = 4096
"""Columns of one stream; an arm with every sensor that it can carry has a few hundred."""
MAX_STREAMS = 1024
"""Topics, groups or arrays of different length in one log."""
MAX_FILES = 20_000
"""Files of a folder that is read as one log."""
MAX_MESSAGES = 20_000_000
"""Messages of one bag."""
MAX_MESSAGE_BYTES = 1 << 20
"""Bytes of one message; a joint state takes less than a kilobyte."""
MAX_NAME = 200
"""Characters of a column name."""
MAX_LINE_BYTES = 1 << 20
"""Bytes of one line of text."""
MAX_DEPTH = 16
"""Groups within groups."""


def check_count(source: str, what: str, count: int, most: int) -> None:
    """Raise `DataError` where a log claims more than `most` of something.

    Args:
        source: name of the file, for the message.
        what: what is counted, in the plural.
        count: the claim.
        most: the bound.

    >>> check_count("run.csv", "columns", 12, MAX_COLUMNS)
    """
    if count > most:
        raise DataError(
            f"{source}: the log claims too many {what}",
            expected=f"at most {most:,}",
            got=f"{count:,}",
            hint="split the log, or export only the columns that are needed",
        )


def check_values(source: str, rows: int, columns: int) -> None:
    """Raise `DataError` where a table is wider or larger than what is read at once."""
    check_count(source, "columns", columns, MAX_COLUMNS)
    check_count(source, f"numbers ({rows:,} rows × {columns} columns)", rows * columns, MAX_VALUES)
