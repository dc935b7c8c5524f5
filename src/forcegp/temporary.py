"""Files and folders under construction: hidden, locked while their writer lives, deleted once it is dead.

A name is `.forcegp-new-<12 hex digits>-<name of the target>`. Its writer holds a lock (flock) on it, which
ends with the process. Without flock (Windows, some network file systems) such files stay unread.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import stat
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LONGEST = 200
"""Bytes of a target's name that its hidden names repeat; file systems allow 255 in all."""
NEW = ".forcegp-new-"
"""Prefix of what is under construction."""


def _short(target: Path) -> str:
    """The name of a target, or for a long one a digest with the same ending, which some writers go by."""
    name = os.fsencode(target.name)
    if len(name) <= LONGEST:
        return target.name
    ending = target.suffix if len(os.fsencode(target.suffix)) <= LONGEST // 2 else ""
    return hashlib.sha256(name).hexdigest() + ending


class Temporary:
    """An empty file or folder under construction beside an existing target, locked until `close`."""

    def __init__(self, target: Path, *, folder: bool, mode: int) -> None:
        while True:
            self.path = target.with_name(f"{NEW}{secrets.token_hex(6)}-{_short(target)}")
            if folder:
                self.path.mkdir(mode=mode)
            else:
                os.close(os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode))
            locked, self._descriptor = _lock(self.path)
            # A sweep between the two steps has taken it for litter: make another.
            if locked:
                return

    def close(self) -> None:
        """Release the lock, and remove what is still there."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
        discard(self.path)


def sweep(target: Path) -> None:
    """Delete temporary files of crashed writers of a target."""
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
    """Remove a file or folder, as far as it can be removed."""
    try:
        if stat.S_ISDIR(path.lstat().st_mode):
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    except OSError:
        return


def _lock(path: Path) -> tuple[bool, int | None]:
    """Whether we hold the lock of a path that still exists (or need none), and the descriptor."""
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
        # Any other error: no flock on this file system.
        return not isinstance(error, BlockingIOError | FileNotFoundError), None
