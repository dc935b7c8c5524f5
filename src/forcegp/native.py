"""Compilation of C++ source text to shared libraries, which are cached on disk.

Compiled kernels are stored in a folder that only its owner can write to, and are checked before they run.
Kernels are named `<key>-<SHA-256 of the file>.so`. The key identifies the source, and the digest verifies
that the file is complete. The folder (0700) and its files (0600) are private regardless of the umask.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import os
import platform
import shutil
import stat
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path

from forcegp.errors import MissingDependencyError
from forcegp.files import Temporary, atomic_file, discard, sweep

FLAGS = ["-std=c++17", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-w", "-shared", "-fPIC"]
LIBRARY = "kernel.so"
ACL = "system.posix_acl_access"
"""Extended attribute with the access control list of a file or folder."""
BASE_ENTRIES = (0x01, 0x04, 0x20)
"""Tags of the entries for the owner, the group and all others (ACL_USER_OBJ, ACL_GROUP_OBJ, ACL_OTHER)."""
PROC = Path("/proc/self/fd")
"""Folder in which Linux lists open files and folders by descriptor."""


def find_compiler() -> str:
    """Return the path of a C++ compiler (`$CXX` or on the PATH), or raise `MissingDependencyError`."""
    wanted = [os.environ["CXX"]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    for name in wanted:
        if path := shutil.which(name):
            return os.path.abspath(path)
    text = "compiled kernels need a C++ compiler and none was found"
    hint = "install one (for example: apt install g++), or set CXX"
    raise MissingDependencyError(text, expected=" or ".join(wanted) + " on the PATH", hint=hint)


def _machine() -> str:
    """Return the processor features that `-march=native` depends on."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return platform.processor() + platform.machine()
    keys = ("model name", "flags", "cpu family", "model\t", "Features", "CPU part")
    return "\n".join(sorted({line for line in text.splitlines() if line.startswith(keys)}))


def load_library(source: str, level: str = "-O2") -> ctypes.CDLL:
    """Load a C++ library, compiling it unless it is cached; raise `MissingDependencyError` on failure."""
    compiler = find_compiler()
    try:
        version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
        place = cache_directory()
    except (OSError, RuntimeError) as cause:
        text = "the C++ compiler or its output folder cannot be used"
        hint = "set CXX to a C++ compiler, and FORCEGP_CACHE to a writable folder"
        raise MissingDependencyError(text, got=str(cause), hint=hint) from cause
    key = hashlib.sha256("\0".join([source, version, _machine(), level, *FLAGS]).encode()).hexdigest()[:32]
    try:
        folder = private_folder(place)
        kept = find(folder, key)
        if kept is not None:
            try:
                return ctypes.CDLL(str(kept))
            except OSError:  # built on a different machine that shares the folder: rebuild it
                discard(kept)
        return ctypes.CDLL(str(store(folder, key, _compiled([compiler, level], source, folder))))
    except OSError as cause:
        text, hint = f"the kernel cannot be written to {place}", "set FORCEGP_CACHE to a writable folder"
        raise MissingDependencyError(text, got=str(cause), hint=hint) from cause


def _compiled(compiler: Sequence[str], source: str, folder: Path) -> bytes:
    """Compile a shared library and return its content, after deleting files left by killed compilers."""
    target = folder / "build"
    sweep(target)
    build = Temporary(target, folder=True, mode=0o700)
    try:
        build.path.chmod(0o700)
        return _built(compiler, source, build.path)
    finally:
        build.close()


def _built(compiler: Sequence[str], source: str, folder: Path) -> bytes:
    """Compile in a private folder, held open in case its path is replaced, and return the output."""
    if not PROC.is_dir():  # this system cannot address a folder by its descriptor
        _run_compiler(compiler, source, folder)
        return (folder / LIBRARY).read_bytes()
    held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        status = os.fstat(held)
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) != 0o700:
            raise OSError(errno.EPERM, "the build folder was replaced", str(folder))
        _run_compiler(compiler, source, PROC / str(held))
        with os.fdopen(os.open(LIBRARY, os.O_RDONLY | os.O_NOFOLLOW, dir_fd=held), "rb") as file:
            return file.read()
    finally:
        os.close(held)


def _run_compiler(compiler: Sequence[str], source: str, folder: Path) -> None:
    command = [*compiler, *FLAGS, "-x", "c++", "-", "-o", LIBRARY, "-pthread"]
    done = subprocess.run(command, input=source, capture_output=True, text=True, check=False, cwd=folder)
    if done.returncode != 0:
        text = f"the C++ compiler {compiler[0]} could not build the kernel"
        hint = "set CXX to a recent GCC or Clang"
        raise MissingDependencyError(text, got=done.stderr.strip()[-2000:], hint=hint)


def cache_directory() -> Path:
    """Return the folder for compiled kernels: `$FORCEGP_CACHE`, or `forcegp` in the user's cache folder."""
    chosen = os.environ.get("FORCEGP_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "forcegp"


def private_folder(folder: Path) -> Path:
    """Return a private folder; raise `MissingDependencyError` if other users can replace it."""
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
        # In a folder with the sticky bit, such as /tmp, users cannot replace files of other users.
        sticky = place != folder and bool(status.st_mode & stat.S_ISVTX)
        shared = bool(status.st_mode & stat.S_IWGRP) and not (place != folder and _is_alone_in(status.st_gid))
        if (shared or status.st_mode & stat.S_IWOTH) and not sticky:
            raise _untrusted(folder, place, f"permissions {stat.S_IMODE(status.st_mode):04o}")
        if not sticky and _has_acl(place):
            raise _untrusted(folder, place, "an access control list with entries for further users or groups")


def _has_acl(place: Path) -> bool:
    """Return whether a path has an ACL (Linux) with entries beside those of its owner, group and others.

    The group bits of its mode are then those of the mask, which applies to all further entries.
    """
    if not hasattr(os, "getxattr"):
        return False
    try:
        acl = os.getxattr(place, ACL)
    except OSError:  # no ACL, or a file system without them
        return False
    # A version of four bytes precedes entries of eight bytes: tag, permissions and number of a user or group.
    return any(tag not in BASE_ENTRIES for tag, _, _ in struct.iter_unpack("<HHI", acl[4:]))


def _is_alone_in(group: int) -> bool:
    """Return whether the group's members listed by the system are only the user and root."""
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
        f"compiled kernels are not stored in {folder}, since other users could place code there",
        expected=f"{place} owned by you and not writable by others",
        got=got,
        hint="set FORCEGP_CACHE to a private folder, or call chmod 700 (and setfacl -b) on it",
    )


def find(folder: Path, key: str) -> Path | None:
    """Return a trusted kernel with the given key, if any, and delete untrusted kernels with this key."""
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
        shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if os.name == "posix" and (status.st_uid != os.geteuid() or shared):
            return False
        return path.stem.partition("-")[2] == hashlib.sha256(file.read()).hexdigest()


def store(folder: Path, key: str, content: bytes) -> Path:
    """Write a kernel and return its path. Raise `OSError` if it cannot be written."""
    library = folder / f"{key}-{hashlib.sha256(content).hexdigest()}.so"
    with atomic_file(library, mode=0o600) as temporary:
        temporary.chmod(0o600)
        temporary.write_bytes(content)
    return library
