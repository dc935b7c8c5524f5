"""Guards for readers, which check the declared size of a file before it is read, and convert errors.

A small compressed file may declare more content than fits into memory. The limits are defined in
`forcegp.limits`.
"""

from __future__ import annotations

import bz2
import io
import math
import re
import sqlite3
import zlib
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forcegp import limits
from forcegp.errors import DataError, ForceGPError, optional_module


def check_count(source: str, what: str, count: int, most: int) -> None:
    """Raise `DataError` if a log declares more than `most` items. `what` names the items in the plural.

    >>> check_count("run.csv", "columns", 12, limits.COLUMNS)
    """
    if count > most:
        text = f"{source}: the log declares too many {what}"
        hint = "split the log, or export only the columns that are needed"
        raise DataError(text, expected=f"at most {most:,}", got=f"{count:,}", hint=hint)


def check_expansion(source: str, size: int, file: int, free: int | None = None) -> None:
    """Raise `DataError` if the declared `size` of the content far exceeds `file`, the size of the file."""
    allowed = allowed_bytes(file, free)
    if size > allowed:
        text = f"{source}: the declared size of the file exceeds the limit"
        expected = f"at most {allowed:,} bytes in a file of this size"
        raise DataError(text, expected=expected, got=f"{size:,}", hint="split the log into several files")


def allowed_bytes(file: int, free: int | None = None) -> int:
    """Return the maximum unpacked size of a file of `file` bytes, which is at least `free` [bytes]."""
    return max(free or limits.FREE_TABLE_BYTES, limits.TABLE_EXPANSION * file)


@dataclass
class Unpacking:
    """Counter of the bytes and records unpacked from a log, with limits that depend on the file size."""

    source: str
    file: int
    size: int = 0
    records: int = 0

    def unpack(self, packed: bytes, compression: str) -> bytes:
        """Unpack part of the log, up to the allowed size."""
        remaining = allowed_bytes(self.file, limits.FREE_BAG_BYTES) - self.size
        content = _opened(packed, compression).read(remaining + 1)
        self.read(len(content))
        return content

    def read(self, size: int) -> None:
        """Count the bytes read from the log, including repeated reads."""
        self.size += size
        check_expansion(self.source, self.size, self.file, limits.FREE_BAG_BYTES)

    def record(self) -> None:
        """Count a record."""
        self.records += 1
        most = max(limits.FREE_MESSAGES, self.file // limits.MESSAGE_PACKED)
        check_count(self.source, "messages for a file of its size", self.records, most)


def _opened(packed: bytes, compression: str) -> Any:
    """Return compressed data as a file object that unpacks them as they are read."""
    stream = io.BytesIO(packed)
    if compression in ("", "none"):
        return stream
    if compression == "bz2":
        return bz2.BZ2File(stream)
    if compression == "lz4":
        return optional_module("lz4.frame", "Unpacking LZ4", "import").LZ4FrameFile(stream)
    if compression == "zstd":
        zstandard = optional_module("zstandard", "Unpacking Zstandard", "import")
        return zstandard.ZstdDecompressor().stream_reader(stream)
    raise DataError("an unknown compression", expected="bz2, lz4 or zstd", got=compression[:40])


def bounded(reader: Any, unpacking: Unpacking) -> Any:
    """Return a subclass of a ROS 1 bag reader that limits the size of unpacked chunks and of the index."""

    class Bounded(reader):
        indexed = 0

        def read_chunk(self) -> Any:
            chunk = super().read_chunk()
            package = chunk.decompressor.__module__.partition(".")[0]
            name = package if package in ("bz2", "lz4") else "none"
            return chunk._replace(decompressor=lambda packed: unpacking.unpack(packed, name))

        def read_index_data(self, *args: Any) -> None:
            start = self.bio.tell()
            super().read_index_data(*args)
            self.indexed += self.bio.tell() - start
            check_count(unpacking.source, "bytes of its index", self.indexed, unpacking.file)

    return Bounded


def check_tables(file: Path) -> None:
    """Check that an SQLite bag has no computed rows and no duplicate topics; accept all other files."""
    if not starts_with(file, b"SQLite format 3"):
        return
    with closing(sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)) as bag:
        for kind, text in bag.execute("SELECT type, sql FROM sqlite_master WHERE sql IS NOT NULL"):
            if kind not in ("table", "index") or re.search(r"\b(virtual|as)\b", text, re.IGNORECASE):
                raise DataError(f"{file}: a table of the bag is computed", got=text[:200])
        topics, numbers = bag.execute("SELECT count(*), count(DISTINCT id) FROM topics").fetchone()
        check_count(str(file), "topics", topics, min(limits.LOG_STREAMS, numbers))


def is_file(path: Path) -> bool:
    """Return whether a file exists; false if its name is invalid."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def starts_with(file: Path, magic: bytes) -> bool:
    """Return whether a file begins with the given bytes."""
    with file.open("rb") as opened:
        return opened.read(len(magic)) == magic


DEFLATE, SHUFFLE, FLETCHER32, LZF = 1, 2, 3, 32000
DEFLATE_RATIO = 1032
"""Maximum number of bytes to which one byte of DEFLATE-compressed data can expand."""


def check_chunks(dataset: Any, file: int) -> None:
    """Check that an h5py data set uses supported compression and that no chunk exceeds its declared size."""
    source, properties = f"{dataset.file.filename}: {dataset.name!r}", dataset.id.get_create_plist()
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    if not filters:
        return
    if len(set(filters)) < len(filters) or not set(filters) <= {DEFLATE, SHUFFLE, FLETCHER32, LZF}:
        hint = "repack it: h5repack -f GZIP=4"
        raise DataError(f"{source} uses unsupported compression filters", got=str(filters)[:200], hint=hint)
    chunk, stored = math.prod(dataset.chunks) * dataset.dtype.itemsize, dataset.id.get_storage_size()
    check_expansion(source, chunk, file)
    check_count(source, "bytes in chunks", stored, file)
    if DEFLATE not in filters or stored * DEFLATE_RATIO <= limits.FREE_TABLE_BYTES:
        return
    for slices in dataset.iter_chunks():
        start = tuple(part.start for part in slices)
        if dataset.id.get_chunk_info_by_coord(start).size:
            skipped, packed = dataset.id.read_direct_chunk(start)
            if not skipped >> filters.index(DEFLATE) & 1:
                content = zlib.decompressobj().decompress(packed, chunk + 1)
                check_count(source, "bytes in a chunk", len(content), chunk)


def within(folder: Path, files: Iterable[Path]) -> list[Path]:
    """Return the files of a folder that is read as one log; raise `DataError` if a link leaves the folder."""
    files, root = list(files), folder.resolve()
    for file in files:
        if not file.resolve().is_relative_to(root):
            text = f"{file}: a link to a path outside {folder} is not followed"
            raise DataError(text, hint="copy the folder with the linked files: cp -rL")
    return files


@contextmanager
def foreign(source: str, kind: str) -> Iterator[None]:
    """Convert any exception that a third-party parser raises for a damaged file to `DataError`."""
    try:
        yield
    except ForceGPError:
        raise
    except (FileNotFoundError, PermissionError) as cause:
        what = "no such file" if isinstance(cause, FileNotFoundError) else "no permission to read the file"
        raise DataError(f"{source}: {what}", got=str(cause)) from cause
    except (Exception, RecursionError, MemoryError) as cause:
        raise damaged(source, kind, cause) from cause


def damaged(source: str, kind: str, cause: BaseException) -> DataError:
    """Return the error for a file that cannot be parsed."""
    lines = str(cause).splitlines()
    text = f"{source}: the file is damaged, truncated or not {kind}"
    hint = "create it again from its source; the usual cause is an interrupted copy"
    return DataError(text, got=lines[0][:300] if lines else type(cause).__name__, hint=hint)
