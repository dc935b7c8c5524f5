"""Putting a new folder in the place of an old one, in one step where the system can.

Linux exchanges two names at once (`renameat2` with RENAME_EXCHANGE), and so does macOS (`renamex_np`).
Elsewhere the old folder is moved aside first; if the writer dies there, `recover` moves it back.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import stat
import sys
from pathlib import Path

from forcegp.temporary import ASIDE, discard, hidden_name, left_beside

ATTEMPTS = 100
"""How often placing is tried while other writers place folders of their own."""

_AT_FDCWD, _RENAME_EXCHANGE, _RENAME_SWAP = -100, 2, 2
_UNSUPPORTED = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP}
_OCCUPIED = {errno.ENOTEMPTY, errno.EEXIST, errno.EACCES if os.name == "nt" else errno.EEXIST}


def exchange(a: Path, b: Path) -> bool:
    """Exchange two paths atomically.

    Returns:
        False where the system or the file system cannot; nothing is changed then.

    Raises:
        OSError: one of them does not exist, or may not be moved.
    """
    names = os.fsencode(a), os.fsencode(b)
    ctypes.set_errno(0)
    try:
        if sys.platform.startswith("linux"):
            call = ctypes.CDLL(None, use_errno=True).renameat2
            failed = call(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE)
        elif sys.platform == "darwin":
            failed = ctypes.CDLL(None, use_errno=True).renamex_np(*names, _RENAME_SWAP)
        else:
            return False
    except (OSError, AttributeError):
        return False
    if not failed:
        return True
    code = ctypes.get_errno()
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(a), None, str(b))


def place(folder: Path, target: Path) -> None:
    """Move a folder to a path, in exchange for the folder that may be there, which is removed.

    Of several processes that do this at the same time, the last one's folder stays.

    Raises:
        OSError: it cannot be moved there; the old folder is in its place.
    """
    for _ in range(ATTEMPTS):
        try:
            os.rename(folder, target)
        except OSError as error:
            if error.errno not in _OCCUPIED:
                recover(target)
                raise
        else:
            return _remove_asides(target)
        # The other folder may be gone by now: then the next attempt finds the place free.
        with contextlib.suppress(FileNotFoundError):
            if exchange(folder, target):
                discard(folder)
                return _remove_asides(target)
            os.rename(target, hidden_name(target, ASIDE))
    recover(target)
    raise OSError(errno.EBUSY, "other processes keep writing this folder", str(target))


def recover(target: Path) -> None:
    """Move a folder back that a writer had moved aside when it died, unless another one is in its place."""
    if os.path.lexists(target):
        return
    for aside in left_beside(target, ASIDE):
        with contextlib.suppress(OSError):
            os.rename(aside, target)
            return


def is_other_than_folder(path: Path) -> bool:
    """Whether a path is taken by something that is not a folder.

    The path is looked at once: between `exists` and `is_dir` another writer can move the folder away.
    """
    try:
        return not stat.S_ISDIR(os.stat(path).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


def is_other_than_file(path: Path) -> bool:
    """Whether a path is taken by something that is not a regular file: a folder, a pipe, a device."""
    try:
        return not stat.S_ISREG(os.stat(path).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


def kind_of(path: Path) -> str:
    """What is at a path, in words."""
    return "a folder" if path.is_dir() else "not a regular file"


def _remove_asides(target: Path) -> None:
    for aside in left_beside(target, ASIDE):
        discard(aside)
