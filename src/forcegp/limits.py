"""Bounds on the content of files, each checked before the corresponding work.

They admit every robot, log and model that we know of, and prevent a file of a few kilobytes from using more
than about 1 GiB of memory or a few seconds.
"""

from __future__ import annotations

KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30

HEADER_BYTES = MIB
"""A JSON header."""
HEADER_DEPTH = 64
"""Objects and lists inside each other in a header."""

TABLE_BYTES = 8 * GIB
"""A table in memory, in bytes of float64."""
FREE_TABLE_BYTES = 128 * MIB
"""A table in memory, whatever the size of its file: columns that do not change compress without limit."""
TABLE_EXPANSION = 64
"""A larger table has at most so many times the bytes of its file."""
COLUMNS = 4096
"""Columns of a log."""
JOINTS = 512
"""Joints of a log or of a saved robot."""
COLUMN_NAME = 1024
"""Characters of a column's name."""
SEGMENT_NUMBER = 2**53
"""The number of a trajectory: the largest range in which float64 holds every integer."""

LOG_VALUES = 1 << 28
"""Numbers read from the log of another program: 2 GiB of float64."""
FREE_ROWS = 100_000
"""Rows that a log is resampled to, whatever its own; more are at most `TABLE_EXPANSION` for each row."""
LOG_STREAMS = 1024
"""Topics, groups or arrays of different length in a log."""
LOG_FILES = 20_000
"""Files of a folder that is read as one log."""
LOG_MESSAGES = 20_000_000
"""Messages of a bag."""
LOG_NAME = 200
"""Characters of a column's name, beyond which it is cut."""
MESSAGE_BYTES = MIB
"""A message of a bag: a joint state takes less than a kilobyte."""
FREE_BAG_BYTES = 16 * MIB
"""A bag unpacked, whatever the size of its file; beyond that, `TABLE_EXPANSION` times its bytes."""
FREE_MESSAGES, MESSAGE_PACKED = 100_000, 2
"""Messages of a bag whatever its size, and the fewest bytes of the file that one of more takes."""
RECORD_BYTES = 256 * MIB
"""A record of an MCAP file, packed."""
LISTING_BYTES = MIB
"""The description of a bag of several files."""
LINE_BYTES = MIB
"""A line of a text table."""
GROUP_DEPTH = 16
"""Groups or structs inside each other in a log."""

SCENE_BYTES = MIB
"""A scene file."""
KEY_PARTS = 16
"""Parts of a dotted key of a scene."""
SCENE_KEYS = 2000
"""Keys and tables of a scene."""

MODEL_BYTES = 16 * GIB
"""The tensors of a saved model."""
TENSORS = 10_000
"""Tensors of a saved model or checkpoint."""
CHECKPOINT_BYTES = GIB
"""A checkpoint: the tensors that are learned, without the data."""
CHECKPOINT_VALUE = 1e12
"""A value in a checkpoint: hyperparameters are logarithms, and analytical parameters are in SI units."""

LOGGED_VALUE = 1e100
"""A number in a log or a state: its square, and the square of that, are finite."""

NAMES_COMPARED = 500
"""Names that a misspelt one is compared with."""
NAME_COMPARED = 100
"""Characters of a name up to which it is compared."""
