"""Bounds on the content of files, each checked before the corresponding work.

They accept every robot, log and model known to us, and prevent a file of a few kilobytes from using more than
about 1 GiB of memory or more than a few seconds.
"""

from __future__ import annotations

KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30

HEADER_BYTES = MIB
"""Size of a JSON header."""
HEADER_DEPTH = 64
"""Nesting depth of objects and lists in a header."""

TABLE_BYTES = 8 * GIB
"""Size of a table in memory, in bytes of float64."""
FREE_TABLE_BYTES = 128 * MIB
"""Size of a table allowed for a file of any size, since constant columns compress without limit."""
TABLE_EXPANSION = 64
"""Maximum ratio of the size of a larger table to that of its file."""
COLUMNS = 4096
"""Columns of a log."""
JOINTS = 512
"""Joints of a log or of a saved robot."""
COLUMN_NAME = 1024
"""Characters of a column's name."""
SEGMENT_NUMBER = 2**53
"""Largest number of a trajectory; float64 represents all integers up to it."""

LOG_VALUES = 1 << 28
"""Numbers read from an imported log: 2 GiB of float64."""
FREE_ROWS = 100_000
"""Resampled rows allowed for any log; beyond that, at most `TABLE_EXPANSION` per original row."""
LOG_STREAMS = 1024
"""Topics, groups or arrays of different length in a log."""
LOG_FILES = 20_000
"""Files of a folder that is read as one log."""
LOG_MESSAGES = 20_000_000
"""Messages of a bag."""
LOG_NAME = 200
"""Characters after which a column name is truncated."""
MESSAGE_BYTES = MIB
"""Size of a message in a bag; a joint state takes less than a kilobyte."""
FREE_BAG_BYTES = 16 * MIB
"""Unpacked size allowed for any bag; beyond that, at most `TABLE_EXPANSION` times its file size."""
FREE_MESSAGES, MESSAGE_PACKED = 100_000, 2
"""Messages allowed for any bag, and the minimum file size per message beyond that [bytes]."""
RECORD_BYTES = 256 * MIB
"""Compressed size of a record in an MCAP file."""
LISTING_BYTES = MIB
"""Size of the description of a multi-file bag."""
LINE_BYTES = MIB
"""Length of a line in a text table."""
GROUP_DEPTH = 16
"""Nesting depth of groups or structs in a log."""

SCENE_BYTES = MIB
"""Size of a scene file."""
KEY_PARTS = 16
"""Parts of a dotted key of a scene."""
SCENE_KEYS = 2000
"""Keys and tables of a scene."""

MODEL_BYTES = 16 * GIB
"""Size of the tensors of a saved model."""
TENSORS = 10_000
"""Tensors of a saved model or checkpoint."""
CHECKPOINT_BYTES = GIB
"""Size of a checkpoint: the learned tensors, without the data."""
CHECKPOINT_VALUE = 1e12
"""Largest value in a checkpoint; hyperparameters are logarithms, analytical parameters in SI units."""

LOGGED_VALUE = 1e100
"""Largest number in a log or a state; its fourth power is finite."""

NAMES_COMPARED = 500
"""Maximum number of names that a misspelt one is compared with."""
NAME_COMPARED = 100
"""Maximum length of a name in this comparison."""
