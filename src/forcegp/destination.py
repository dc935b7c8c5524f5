"""Early checks that a result can be written, and a fallback path if writing fails nevertheless."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from forcegp.errors import DestinationError, ForceGPError
from forcegp.files import check_kind, writable, written_folder

PROBE_BYTES = 1 << 16
"""Number of bytes that are written and then deleted to test for free space and quotas."""


def check_destination(path: str | Path, *, folder: bool = False, own_files: Iterable[str] = ()) -> None:
    """Check, before a long computation, that a file or folder can be written.

    The check leaves no files behind. A folder may replace an empty folder, or one whose files all match the
    patterns `own_files`. If no patterns are given, it may replace any folder.

    Raises:
        DestinationError: a file would replace a folder or vice versa, the folder contains other files, the
            path cannot be written, or the disk is full.
    """
    target = Path(path)
    with writable(target):
        check_kind(target, folder=folder)
        if folder and target.is_dir():
            _check_replaceable(target, tuple(own_files))
        parent = next(parent for parent in target.absolute().parents if parent.exists())
        with tempfile.NamedTemporaryFile(prefix=".forcegp-probe-", dir=parent) as file:
            file.write(b"\0" * PROBE_BYTES)
            file.flush()
            os.fsync(file.fileno())


def write_or_keep(write: Callable[[Path], object], path: str | Path) -> None:
    """Call `write(path)`. If this fails, write to a different path and name it in a `DestinationError`."""
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
    text = f"{target}: the result could not be written"
    hint = f"it was saved to {kept}; move it to its destination"
    raise DestinationError(text, got=reason, hint=hint) from cause


def folder_or_keep(fill: Callable[[Path], object], path: str | Path) -> None:
    """Call `fill(folder)` to write the files of a folder. If this fails, proceed as `write_or_keep` does."""

    def write(target: Path) -> None:
        with written_folder(target) as temporary:
            fill(temporary)

    write_or_keep(write, path)


def _kept(write: Callable[[Path], object], name: str) -> Path | None:
    """Write the result to a private location and return its path, or `None` if this fails as well."""
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
            f"{folder} contains other files, which would be lost",
            expected="a folder that is new, empty, or contains only " + ", ".join(own_files),
            got=", ".join(foreign[:5]),
            hint="choose another folder, or move these files",
        )
