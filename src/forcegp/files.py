"""Files that are never half written, and JSON headers that say which format and version they are."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from forcegp.errors import DestinationError, ForceGPError
from forcegp.limits import HEADER_BYTES, HEADER_DEPTH
from forcegp.temporary import Temporary, discard, sweep

H = TypeVar("H", bound="Header")
M = TypeVar("M", bound=BaseModel)


@contextmanager
def writable(target: Path) -> Iterator[None]:
    """Errors of the system in the block, which writes to `target`, as `DestinationError`."""
    try:
        yield
    except DestinationError:
        raise
    except OSError as cause:
        raise DestinationError(
            f"{target}: cannot be written",
            got=cause.strerror or str(cause),
            hint="name a place that exists, is not full and can be written",
        ) from cause


def check_kind(target: Path, *, folder: bool) -> None:
    """Check that nothing but a folder, or nothing but a regular file, would be replaced.

    The path is looked at once: between `exists` and `is_dir` another writer can change it.
    """
    if "\0" in str(target):
        raise DestinationError("a path holds a null byte", got=repr(str(target)))
    try:
        mode = os.stat(target).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    if folder and not stat.S_ISDIR(mode):
        raise DestinationError(f"{target} is a file, and a folder is to be written there")
    if not folder and not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
        raise DestinationError(f"{target} is {kind}, and a file is to be written there")


def _sync(path: Path) -> None:
    """Force a file or folder to disk, so that a rename never outruns the data that it names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _temporary(target: Path, *, folder: bool, mode: int) -> Iterator[Path]:
    """Temporary file of a target; gone when the block ends, unless it was moved."""
    with writable(target):
        check_kind(target, folder=folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        sweep(target)
        temporary = Temporary(target, folder=folder, mode=mode)
    try:
        yield temporary.path
    finally:
        temporary.close()


@contextmanager
def atomic_file(path: str | Path, mode: int = 0o666) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends without an error.

    Temporary files of crashed writers of the same file are removed.

    Args:
        path: the file to write; missing parent folders are made.
        mode: permissions of the new file, less the umask.

    Yields:
        Where to write. A reader of `path` sees the old file or the whole new one.

    Raises:
        DestinationError: the place cannot be written, or `path` is a folder, a pipe or a device.

    Example:
        >>> import os, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with atomic_file(f"{folder}/a.txt") as temporary:
        ...         _ = temporary.write_text("whole")
        ...     os.listdir(folder)
        ['a.txt']
    """
    target = Path(path)
    with _temporary(target, folder=False, mode=mode) as temporary:
        with writable(target):
            yield temporary
            _sync(temporary)
            os.replace(temporary, target)
        with suppress(OSError):  # not every system can
            _sync(target.parent)


@contextmanager
def written_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder; its files move into the target folder when the block ends without an error.

    Each file replaces its namesake in one step, in the order in which they were written, so that the last one
    is there only with the others; then what else was in the folder is removed. Symbolic links are followed.

    Yields:
        The folder to write the files to.

    Raises:
        DestinationError: the place cannot be written, or `path` is a file.

    Example:
        >>> import os, tempfile
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     with written_folder(f"{parent}/run") as temporary:
        ...         _ = (temporary / "a.txt").write_text("one")
        ...     os.listdir(f"{parent}/run")
        ['a.txt']
    """
    target = Path(path).resolve() if Path(path).is_symlink() else Path(path)
    with _temporary(target, folder=True, mode=0o777) as temporary:
        with writable(target):
            yield temporary
            written = sorted(temporary.iterdir(), key=lambda file: file.stat().st_mtime_ns)
            target.mkdir(exist_ok=True)
            for file in written:
                _sync(file)
                os.replace(file, target / file.name)
            for old in set(target.iterdir()) - {target / file.name for file in written}:
                discard(old)
        with suppress(OSError):
            _sync(target)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8), whole or not at all."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: object) -> None:
    """Write a value as indented JSON, whole or not at all; NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


class Record(BaseModel):
    """A frozen part of a file: unknown fields and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, from_attributes=True)


class Header(Record):
    """A frozen, versioned JSON header; a subclass names its `FORMAT` and `VERSION` and adds fields.

    Unknown fields are errors, and text of more than `MAX_BYTES` is not read.
    """

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    MAX_BYTES: ClassVar[int] = HEADER_BYTES

    def to_json(self) -> str:
        """The header as JSON text, format and version first."""
        head = {"format": self.FORMAT, "version": self.VERSION}
        return json.dumps(head | self.model_dump(mode="json"), indent=2, allow_nan=False)

    @classmethod
    def from_json(cls: type[H], text: str | bytes, source: str, error: type[ForceGPError]) -> H:
        """Read a header, checking its format, version and fields.

        Raises:
            ForceGPError: of class `error`; the message names the file (`source`) and the field.
        """
        fields = _json_object(text, source, error, cls.MAX_BYTES)
        name, version = fields.pop("format", None), fields.pop("version", None)
        if name != cls.FORMAT:
            raise error(f"{source} is of another format", expected=cls.FORMAT, got=repr(name))
        if version != cls.VERSION:
            raise error(
                f"{source} has a version of the {cls.FORMAT} format that this release cannot read",
                expected=f"version {cls.VERSION}",
                got=f"version {version!r}",
                hint="read it with the release of forcegp that wrote it, or update forcegp",
            )
        return validated(cls, fields, source, error, what="header field")


def validated(
    kind: type[M],
    fields: object,
    source: str,
    error: type[ForceGPError],
    place: tuple[str, ...] = (),
    what: str = "field",
) -> M:
    """What was read as an instance of a pydantic model.

    Args:
        kind: the model.
        fields: what was read.
        source, place, what: the file, the keys that lead to the fields, and their kind, for the message.
        error: the class of error to raise; it names the file and the first wrong field.
    """
    try:
        return kind.model_validate(fields)
    except ValidationError as cause:
        first = cause.errors()[0]
        where = f"{source}: {what} {'.'.join(map(str, (*place, *first['loc'])))!r}"
        if isinstance(reason := first.get("ctx", {}).get("error"), ForceGPError):
            raise error.at(where, reason) from cause
        raise error(f"{where} is not valid", expected=first["msg"], got=first["input"]) from cause


def _json_object(text: str | bytes, source: str, error: type[ForceGPError], most: int) -> dict[str, Any]:
    if len(text) > most:
        raise error(f"{source}: the header is too large", expected=f"at most {most} bytes", got=len(text))
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as cause:
        raise error(f"{source}: the header is not JSON", got=str(cause)) from cause
    if not isinstance(value, dict):
        raise error(f"{source}: the header is not a JSON object", got=type(value).__name__)
    if depth(value) > HEADER_DEPTH:
        raise error(f"{source}: the header is nested too deeply", expected=f"at most {HEADER_DEPTH} levels")
    return value


def depth(value: object) -> int:
    """Largest depth of nested mappings and lists, found without recursion."""
    level, levels = [value], 0
    while level := [part for part in level if isinstance(part, dict | list)]:
        levels += 1
        level = [inner for part in level for inner in (part.values() if isinstance(part, dict) else part)]
    return levels
