"""Compiled kernels on disk, which are code: kept where only their owner writes, and checked before they run.

The name of a kernel is `<key>-<SHA-256 of the file>.so`: the key says what was compiled, and the digest that
the file is whole. The folder is private (0700) and so are the files (0600), whatever the umask.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
from pathlib import Path

from forcegp.errors import MissingDependencyError
from forcegp.files import atomic_file
from forcegp.temporary import discard

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def cache_directory() -> Path:
    """Where compiled kernels are kept: `$FORCEGP_CACHE`, or `forcegp` in the user's cache folder."""
    chosen = os.environ.get("FORCEGP_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "forcegp"


def private_folder(folder: Path) -> Path:
    """The folder, made for its owner alone where it does not exist.

    Raises:
        MissingDependencyError: others own it or can write to it or replace it; names the folder at fault.
        OSError: it cannot be made.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
        folder.chmod(0o700)
    folder = folder.resolve()
    if os.name == "posix":
        _check_owner(folder)
    return folder


def _check_owner(folder: Path) -> None:
    for place in (folder, *folder.parents):
        status = place.stat()
        if status.st_uid not in ((os.geteuid(),) if place == folder else (os.geteuid(), 0)):
            raise _untrusted(folder, place, f"owned by user {status.st_uid}")
        # In a folder with the sticky bit, such as /tmp, nobody replaces what belongs to another.
        sticky = place != folder and bool(status.st_mode & stat.S_ISVTX)
        shared = bool(status.st_mode & stat.S_IWGRP) and not (place != folder and _is_alone_in(status.st_gid))
        if (shared or status.st_mode & stat.S_IWOTH) and not sticky:
            raise _untrusted(folder, place, f"permissions {stat.S_IMODE(status.st_mode):04o}")


def _is_alone_in(group: int) -> bool:
    """Whether nobody but the user and root is in a group, as far as the system lists its members."""
    import grp
    import pwd

    try:
        allowed = {pwd.getpwuid(os.geteuid()).pw_name, "root"}
        members = {*grp.getgrgid(group).gr_mem, *(x.pw_name for x in pwd.getpwall() if x.pw_gid == group)}
    except KeyError:
        return False
    return group == os.getegid() and members <= allowed


def _untrusted(folder: Path, place: Path, got: str) -> MissingDependencyError:
    return MissingDependencyError(
        f"compiled kernels are not kept in {folder}, since others could put code there",
        expected=f"{place} to belong to you, and nobody else to write to it",
        got=got,
        hint="set FORCEGP_CACHE to a folder of your own, or call chmod 700 on it",
    )


def find(folder: Path, key: str) -> Path | None:
    """The kernel of a key, if the folder has one that is whole and the user's own; others are removed."""
    for path in sorted(folder.glob(f"{key}-*.so")):
        if _trusted(path):
            return path
        discard(path)
    return None


def _trusted(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return False
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            return False
        if os.name == "posix" and (status.st_uid != os.geteuid() or status.st_mode & _OTHERS_WRITE):
            return False
        return path.stem.partition("-")[2] == hashlib.sha256(file.read()).hexdigest()


def store(folder: Path, key: str, content: bytes) -> Path:
    """Write a kernel.

    Raises:
        OSError: it cannot be written.
    """
    library = folder / f"{key}-{hashlib.sha256(content).hexdigest()}.so"
    with atomic_file(library, mode=0o600) as temporary:
        temporary.chmod(0o600)
        temporary.write_bytes(content)
    return library
