"""Limits on the content of files, checked before the content is processed.

They admit every robot, log and model known to us, but prevent a file of a few kilobytes from using more than
about 1 GiB of memory or a few seconds of computing time.
"""

from __future__ import annotations

KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30

HEADER_BYTES = MIB
"""Maximum size of a JSON header."""
HEADER_DEPTH = 64
"""Maximum nesting depth of objects and lists in a header."""

TABLE_BYTES = 8 * GIB
"""Maximum size of a table in memory, in bytes of float64."""
FREE_TABLE_BYTES = 128 * MIB
"""Table size that is allowed for any file, since constant columns can be compressed without limit."""
TABLE_EXPANSION = 64
"""Maximum ratio of table size to file size for larger tables."""
COLUMNS = 4096
"""Maximum number of columns in a log."""
JOINTS = 512
"""Maximum number of joints in a log or a saved robot."""
COLUMN_NAME = 1024
"""Maximum number of characters of a column name."""
SEGMENT_NUMBER = 2**53
"""Largest trajectory number; float64 represents all integers up to this value."""

LOG_VALUES = 1 << 28
"""Maximum number of values read from an imported log; they take up 2 GiB in float64."""
FREE_ROWS = 100_000
"""Number of resampled rows allowed for any log; beyond it, `TABLE_EXPANSION` per original row are allowed."""
LOG_STREAMS = 1024
"""Maximum number of topics, groups, or arrays of different length in a log."""
LOG_FILES = 20_000
"""Maximum number of files in a folder that is read as one log."""
LOG_MESSAGES = 20_000_000
"""Maximum number of messages in a bag."""
LOG_NAME = 200
"""Number of characters after which a column name is truncated."""
MESSAGE_BYTES = MIB
"""Maximum size of a message in a bag; a joint state takes less than a kilobyte."""
FREE_BAG_BYTES = 16 * MIB
"""Unpacked size allowed for any bag; beyond it, `TABLE_EXPANSION` times the file size is allowed."""
FREE_MESSAGES, MESSAGE_PACKED = 100_000, 2
"""Number of messages allowed for any bag, and minimum file size per message beyond that number [bytes]."""
RECORD_BYTES = 256 * MIB
"""Maximum compressed size of a record in an MCAP file."""
LISTING_BYTES = MIB
"""Maximum size of the description of a multi-file bag."""
LINE_BYTES = MIB
"""Maximum length of a line in a text table."""
GROUP_DEPTH = 16
"""Maximum nesting depth of groups or structs in a log."""

SCENE_BYTES = MIB
"""Maximum size of a scene file."""
KEY_PARTS = 16
"""Maximum number of parts of a dotted key in a scene."""
SCENE_KEYS = 2000
"""Maximum number of keys and tables in a scene."""

MODEL_BYTES = 16 * GIB
"""Maximum size of the tensors of a saved model."""
TENSORS = 10_000
"""Maximum number of tensors in a saved model."""

LOGGED_VALUE = 1e100
"""Largest number in a log or a state; its fourth power is finite."""

NAMES_COMPARED = 500
"""Maximum number of names with which a misspelt one is compared."""
NAME_COMPARED = 100
"""Maximum length of a name in this comparison."""
