"""One file per log format; `read` picks the reader by content, never by running what the file holds."""

from forcegp.logs.readers.detect import FORMATS, read

__all__ = ["FORMATS", "read"]
