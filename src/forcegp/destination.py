"""Early checks that a result can be written, and a fallback path if writing fails nevertheless."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

from forcegp.errors import DestinationError, ForceGPError
from forcegp.files import Header, check_kind, check_not_current, writable, written_folder

PROBE_BYTES = 1 << 16
"""Number of bytes that are written and then deleted to test for free space and quotas."""


class Manifest(Header):
    """The SHA-256 of every file of a result that is a folder, by file name."""

    FORMAT: ClassVar[str] = "forcegp-folder"
    VERSION: ClassVar[int] = 1

    files: dict[str, str]


MANIFEST = ".forcegp.json"
"""Name of the manifest in a folder."""


def check_destination(path: str | Path, *, folder: bool = False) -> None:
    """Check, before a long computation, that a file can be written, or files in a folder.

    The check leaves no files behind.

    Raises:
        DestinationError: a file would replace a folder or vice versa, the path cannot be written, or the disk
            is full.
    """
    target = Path(path)
    with writable(target):
        check_kind(target, folder=folder)
        parent = next(parent for parent in target.absolute().parents if parent.exists())
        with tempfile.NamedTemporaryFile(prefix=".forcegp-probe-", dir=parent) as file:
            file.write(b"\0" * PROBE_BYTES)
            file.flush()
            os.fsync(file.fileno())


def check_folder(path: str | Path) -> None:
    """Check, before a long computation, that a result can take the place of a folder.

    The folder is new or empty, or contains an unchanged result of `folder_or_keep` and nothing else.

    Raises:
        DestinationError: see `check_destination`; the folder contains other files, or is the current folder.
    """
    target = Path(path)
    check_destination(target, folder=True)
    check_not_current(target)
    _check_replaceable(target)


def check_kept(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Check that no result replaces an input or another result.

    Files are compared by device and inode, so that links, hard links and other spellings are found. A result
    that is a folder replaces everything in it, and an existing file in a folder that is read is an input.

    Raises:
        DestinationError: an input or a result would be overwritten.

    Example:
        >>> check_kept([Path("model.safetensors")], [Path("run.parquet")])
    """
    read = [path for path in inputs if _identity(path)]
    written: list[Path] = []
    for out in outputs:
        for path in read:
            if _identity(out) == _identity(path) or _holds(out, path) or _holds(path, out):
                text = f"{out}: an input of this command would be overwritten"
                raise DestinationError(text, got=path, hint="choose another path for the result")
        for other in written:
            if out.resolve() == other.resolve() or _identity(out) == _identity(other) != ():
                text, hint = f"{other} would be overwritten by another result", "name different paths"
                raise DestinationError(text, got=str(out), hint=hint)
        written.append(out)


def _identity(path: Path) -> tuple[int, ...]:
    """Return the device and inode of an existing file or folder, or nothing."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return ()
    return status.st_dev, status.st_ino


def _holds(folder: Path, path: Path) -> bool:
    """Return whether a folder contains an existing file or folder, or a link to it."""
    if not folder.is_dir() or not _identity(path):
        return False
    inside = path.resolve().is_relative_to(folder.resolve())
    return inside or any(_identity(entry) == _identity(path) for entry in folder.iterdir())


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
    """Call `fill(folder)` to write the files of a folder, and add a manifest; see `write_or_keep`."""

    def write(target: Path) -> None:
        with written_folder(target) as temporary:
            fill(temporary)
            digests = {file.name: _digest(file) or "" for file in temporary.iterdir()}
            (temporary / MANIFEST).write_text(Manifest(files=digests).to_json() + "\n", encoding="utf-8")
            _check_replaceable(target)  # files may have been added during the computation

    write_or_keep(write, path)


def _kept(write: Callable[[Path], object], name: str) -> Path | None:
    """Write the result to a private location and return its path, or `None` if this fails as well."""
    for parent in (tempfile.gettempdir(), os.getcwd(), str(Path.home())):
        with suppress(OSError, ForceGPError):
            place = Path(tempfile.mkdtemp(prefix="forcegp-kept-", dir=parent))
            try:
                write(place / name)
            except (OSError, ForceGPError):
                shutil.rmtree(place, ignore_errors=True)
                raise
            return place / name
    return None


def _check_replaceable(folder: Path) -> None:
    """Raise `DestinationError` if a folder contains files that its manifest does not list as they are."""
    if not folder.is_dir():
        return
    known: dict[str, str] = {}
    with suppress(OSError, DestinationError):
        text = (folder / MANIFEST).read_text(encoding="utf-8", errors="replace")
        known = Manifest.from_json(text, str(folder / MANIFEST), DestinationError).files
    ours = {name for name, digest in known.items() if _digest(folder / name) == digest} | {MANIFEST}
    foreign = sorted({entry.name for entry in folder.iterdir()} - (ours if known else set()))
    if foreign:
        raise DestinationError(
            f"{folder} contains other files, which would be lost",
            expected="a folder that is new or empty, or contains only an unchanged result of this library",
            got=", ".join(foreign[:5]),
            hint="choose another folder, or move these files",
        )


def _digest(file: Path) -> str | None:
    """Return the SHA-256 of a file, or `None` for everything else."""
    if file.is_symlink() or not file.is_file():
        return None
    return hashlib.sha256(file.read_bytes()).hexdigest()
