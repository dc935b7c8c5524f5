"""Atomic writing of files, and JSON headers with a format and a version.

Temporary files are hidden, locked while the process that writes them runs, and deleted after a crash. They
are named `.forcegp-new-<12 hex digits>-<name of the target>`. The lock (flock) is released when the process
ends. Without flock (on Windows and some network file systems), such files remain after a crash.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import math
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from forcegp.errors import DestinationError, ForceGPError
from forcegp.limits import HEADER_BYTES, HEADER_DEPTH

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

H = TypeVar("H", bound="Header")
M = TypeVar("M", bound=BaseModel)


LONGEST = 200
"""Maximum number of bytes of the target's name in a temporary name; file systems allow 255 bytes in total."""
NEW = ".forcegp-new-"
"""Prefix of temporary names."""


def _short(target: Path) -> str:
    """Return the name of a target, or a digest if the name is long; some writers need its suffix."""
    name = os.fsencode(target.name)
    if len(name) <= LONGEST:
        return target.name
    ending = target.suffix if len(os.fsencode(target.suffix)) <= LONGEST // 2 else ""
    return hashlib.sha256(name).hexdigest() + ending


class Temporary:
    """An empty temporary file or folder next to an existing target, locked until `close`."""

    def __init__(self, target: Path, *, folder: bool, mode: int) -> None:
        while True:
            self.path = target.with_name(f"{NEW}{secrets.token_hex(6)}-{_short(target)}")
            if folder:
                self.path.mkdir(mode=mode)
            else:
                os.close(os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode))
            locked, self._descriptor = _lock(self.path)
            # If a sweep has deleted it between the two steps, create another.
            if locked:
                return

    def close(self) -> None:
        """Release the lock, and remove any remaining files."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
        discard(self.path)


def sweep(target: Path) -> None:
    """Delete temporary files left by processes that crashed while writing a target."""
    form = re.compile(re.escape(NEW) + "[0-9a-f]{12}-" + re.escape(_short(target)))
    try:
        matches = [path for path in target.parent.iterdir() if form.fullmatch(path.name)]
    except OSError:
        return
    for path in matches if fcntl is not None else []:
        locked, descriptor = _lock(path)
        if descriptor is not None:
            if locked:
                discard(path)
            os.close(descriptor)


def discard(path: Path) -> None:
    """Remove a file or folder, ignoring any error."""
    try:
        if stat.S_ISDIR(path.lstat().st_mode):
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    except OSError:
        return


def _lock(path: Path) -> tuple[bool, int | None]:
    """Lock a path. Return whether it still exists and is locked (or needs no lock), and its descriptor."""
    if fcntl is None:
        return True, None
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False, None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(descriptor), path.lstat()), descriptor
    except OSError as error:
        os.close(descriptor)
        # Any other error means that the file system does not support flock.
        return not isinstance(error, BlockingIOError | FileNotFoundError), None


@contextmanager
def writable(target: Path) -> Iterator[None]:
    """Convert operating system errors in a block that writes to `target` to `DestinationError`."""
    try:
        yield
    except DestinationError:
        raise
    except OSError as cause:
        text, hint = f"{target}: cannot be written", "choose an existing, writable location with free space"
        raise DestinationError(text, got=cause.strerror or str(cause), hint=hint) from cause


def check_kind(target: Path, *, folder: bool) -> None:
    """Check that a target, if it exists, is a folder (if `folder` is true) or a regular file (otherwise).

    The path is inspected only once, since another process could change it between `exists` and `is_dir`.
    """
    if "\0" in str(target):
        raise DestinationError("a path contains a null byte", got=repr(str(target)))
    try:
        mode = os.stat(target).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    if folder and not stat.S_ISDIR(mode):
        raise DestinationError(f"{target} is a file, but a folder is to be written there")
    if not folder and not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
        raise DestinationError(f"{target} is {kind}, but a file is to be written there")


def _sync(path: Path) -> None:
    """Flush a file or folder to disk, so that it is never renamed before its data are written."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _temporary(target: Path, *, folder: bool, mode: int) -> Iterator[Path]:
    """Yield a temporary file or folder for a target; delete it after the block unless it has been moved."""
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
    """Yield a temporary path that replaces `path` if the block ends without an error.

    Temporary files that crashed processes left for the same target are deleted.

    Args:
        path: the file to write; missing parent folders are created.
        mode: permissions of the new file before the umask is applied.

    Yields:
        The temporary path. Readers of `path` see either the old file or the complete new file.

    Raises:
        DestinationError: the path cannot be written, or is a folder, a pipe or a device.

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
        with suppress(OSError):  # not supported on every system
            _sync(target.parent)


@contextmanager
def written_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces the target folder if the block ends without an error.

    The two folders are exchanged in one step, so that a reader sees either the old files or the new ones, and
    the old folder is deleted. Systems other than Linux, and some network file systems, cannot exchange
    folders: a crash between the two steps that they need leaves no folder. Symbolic links are followed.

    Yields:
        The temporary folder.

    Raises:
        DestinationError: the path cannot be written, is a file, or contains the current folder.

    Example:
        >>> import os, tempfile
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     with written_folder(f"{parent}/run") as temporary:
        ...         _ = (temporary / "a.txt").write_text("one")
        ...     os.listdir(f"{parent}/run")
        ['a.txt']
    """
    check_not_current(Path(path))
    target = Path(path).resolve()
    with _temporary(target, folder=True, mode=0o777) as temporary:
        with writable(target):
            yield temporary
            for file in (*temporary.rglob("*"), temporary):
                _sync(file)
            with suppress(FileNotFoundError):
                shutil.copymode(target, temporary)
            _replace_folder(temporary, target)
        with suppress(OSError):
            _sync(target.parent)


def check_not_current(target: Path) -> None:
    """Check that a folder to be replaced is not the current folder, which programs in it would lose."""
    if Path.cwd().is_relative_to(target.resolve()):
        text, hint = f"{target}: the current folder cannot be replaced", "name a new folder, such as results"
        raise DestinationError(text, expected="a folder that is new or below the current one", hint=hint)


def _replace_folder(new: Path, target: Path) -> None:
    """Move a folder to a target; the old target, if there is one, is deleted or takes the place of `new`."""
    try:
        os.rename(new, target)  # possible if there is no target or, on POSIX systems, if it is empty
        return
    except OSError:
        if not target.is_dir():
            raise
    if not _exchange(new, target):
        old = target.with_name(f"{NEW}{secrets.token_hex(6)}-{_short(target)}")
        os.rename(target, old)
        os.rename(new, target)
        discard(old)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two paths in one step; return whether the system supports this."""
    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if os.name == "posix" else None
    if function is None:
        return False
    current, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    if function(current, os.fsencode(one), current, os.fsencode(other), exchange) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL):
        return False
    raise OSError(code, os.strerror(code), str(other))


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: object) -> None:
    """Write a value atomically as indented JSON. NaN and infinity are rejected."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def finite(value: Any) -> Any:
    """Return JSON-compatible values with `None` in place of numbers that are not finite.

    >>> finite({"a": [1.0, float("nan")]})
    {'a': [1.0, None]}
    """
    if isinstance(value, dict):
        return {name: finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Record(BaseModel):
    """A frozen record in a file; unknown fields and non-finite numbers raise errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, from_attributes=True)


class Header(Record):
    """A frozen, versioned JSON header; subclasses set `FORMAT` and `VERSION` and add fields.

    Unknown fields and text longer than `MAX_BYTES` are rejected.
    """

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    MAX_BYTES: ClassVar[int] = HEADER_BYTES

    def to_json(self) -> str:
        """Return the header as JSON text, starting with the format and the version."""
        head = {"format": self.FORMAT, "version": self.VERSION}
        return json.dumps(head | self.model_dump(mode="json"), indent=2, allow_nan=False)

    @classmethod
    def from_json(cls: type[H], text: str | bytes, source: str, error: type[ForceGPError]) -> H:
        """Read and check a header; if it is invalid, raise an `error` that names `source` and the field."""
        fields = _json_object(text, source, error, cls.MAX_BYTES)
        name, version = fields.pop("format", None), fields.pop("version", None)
        if name != cls.FORMAT:
            raise error(f"{source} has a different format", expected=cls.FORMAT, got=repr(name))
        if version != cls.VERSION:
            message = f"{source} has a version of the {cls.FORMAT} format that this release cannot read"
            hint = "read it with the release of forcegp that wrote it, or update forcegp"
            raise error(message, expected=f"version {cls.VERSION}", got=f"version {version!r}", hint=hint)
        return validated(cls, fields, source, error, what="header field")


def validated(
    kind: type[M],
    fields: object,
    source: str,
    error: type[ForceGPError],
    place: tuple[str, ...] = (),
    what: str = "field",
) -> M:
    """Validate values as a pydantic model; errors name `source`, `place` and the invalid field."""
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
    """Compute the maximum nesting depth of mappings and lists without recursion."""
    level, levels = [value], 0
    while level := [part for part in level if isinstance(part, dict | list)]:
        levels += 1
        level = [inner for part in level for inner in (part.values() if isinstance(part, dict) else part)]
    return levels
