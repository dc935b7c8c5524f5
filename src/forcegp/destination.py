"""Whether a result can be written, asked before the work starts; and a second place if writing fails."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from forcegp.errors import DestinationError, ForceGPError
from forcegp.files import check_kind, writable

PROBE_BYTES = 1 << 16
"""Written and removed again to see whether there is room, and whether a quota allows it."""


def check_destination(
    path: str | Path, *, folder: bool = False, own_files: Iterable[str] = (), needed_bytes: int = 0
) -> None:
    """Check that a file or folder can be written, without leaving anything behind.

    Call it before long work; `write_or_keep` is its counterpart afterwards.

    Args:
        path: what will be written.
        folder: whether that is a folder, which may replace an empty one or one of nothing but `own_files`.
        own_files: patterns of the names in such a folder; with none, any folder may be replaced.
        needed_bytes: room that the result takes on the disk [bytes].

    Raises:
        DestinationError: a file is to replace a folder or the reverse, the folder holds other files, or the
            place cannot be written or is full.
    """
    target = Path(path)
    with writable(target):
        check_kind(target, folder=folder)
        if folder and target.is_dir():
            _check_replaceable(target, tuple(own_files))
        _probe(next(parent for parent in target.absolute().parents if parent.exists()), needed_bytes)


def write_or_keep(write: Callable[[Path], object], path: str | Path) -> None:
    """Write a result by `write(path)`; if that fails, write it to another place, which the error names.

    Raises:
        DestinationError: the place cannot be written; the message says where the result is instead.
        ForceGPError: the result cannot be written anywhere, for a reason of its own.
    """
    target = Path(path)
    try:
        write(target)
        return
    except (OSError, ForceGPError) as error:
        cause = error
    kept = _kept(write, target.name)
    if kept is None:
        raise cause
    reason = cause.message if isinstance(cause, ForceGPError) else (cause.strerror or str(cause))
    raise DestinationError(
        f"{target}: the result could not be written there",
        got=reason,
        hint=f"it was kept in {kept}; move it to where it belongs",
    ) from cause


def _kept(write: Callable[[Path], object], name: str) -> Path | None:
    """A private place where the result could be written, or `None`."""
    for parent in (tempfile.gettempdir(), os.getcwd(), str(Path.home())):
        with contextlib.suppress(OSError, ForceGPError):
            place = Path(tempfile.mkdtemp(prefix="forcegp-kept-", dir=parent))
            try:
                write(place / name)
            except (OSError, ForceGPError):
                shutil.rmtree(place, ignore_errors=True)
                raise
            return place / name
    return None


def _check_replaceable(folder: Path, own_files: tuple[str, ...]) -> None:
    names = sorted(entry.name for entry in folder.iterdir())
    foreign = [name for name in names if not any(fnmatchcase(name, pattern) for pattern in own_files)]
    if own_files and foreign:
        raise DestinationError(
            f"{folder} holds other files than a result of this command, which would be lost",
            expected="a folder that is new, empty, or holds nothing but " + ", ".join(own_files),
            got=", ".join(foreign[:5]),
            hint="name another folder, or move these files",
        )


def _probe(parent: Path, needed_bytes: int) -> None:
    with tempfile.NamedTemporaryFile(prefix=".forcegp-probe-", dir=parent) as file:
        file.write(b"\0" * PROBE_BYTES)
        file.flush()
        os.fsync(file.fileno())
    free = shutil.disk_usage(parent).free
    if free < needed_bytes:
        raise DestinationError(
            f"{parent}: not enough room on the disk",
            expected=f"{needed_bytes:,} bytes",
            got=f"{free:,} bytes free",
            hint="make room, or name a place on another disk",
        )
