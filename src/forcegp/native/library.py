"""From C++ source text to a shared library: the system's compiler, and a cache on disk."""

from __future__ import annotations

import ctypes
import errno
import hashlib
import os
import platform
import shutil
import stat
import subprocess
from collections.abc import Sequence
from pathlib import Path

from forcegp.errors import MissingDependencyError
from forcegp.native import cache
from forcegp.temporary import Temporary, discard, sweep

FLAGS = (
    "-std=c++17",
    "-march=native",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-w",
    "-shared",
    "-fPIC",
)


LIBRARY = "kernel.so"
PROC = Path("/proc/self/fd")
"""Names of open files and folders by their descriptors, on Linux."""


def find_compiler() -> str:
    """Path of the C++ compiler: `$CXX`, or the first of c++, g++ and clang++ on the PATH.

    Raises:
        MissingDependencyError: there is none.
    """
    wanted = [os.environ["CXX"]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    for name in wanted:
        if path := shutil.which(name):
            return os.path.abspath(path)
    raise MissingDependencyError(
        "compiled kernels need a C++ compiler and none was found",
        expected=" or ".join(wanted) + " on the PATH",
        hint="install one (for example: apt install g++), or set CXX",
    )


def _machine() -> str:
    """What `-march=native` depends on."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return platform.processor() + platform.machine()
    keys = ("model name", "flags", "cpu family", "model\t", "Features", "CPU part")
    return "\n".join(sorted({line for line in text.splitlines() if line.startswith(keys)}))


def load_library(source: str, level: str = "-O2") -> ctypes.CDLL:
    """The shared library of a C++ source text, compiled unless the cache has it.

    Args:
        source: the text, with functions declared `extern "C"`.
        level: of optimisation.

    Raises:
        MissingDependencyError: there is no compiler, it failed, or the cache cannot be written or trusted.
    """
    compiler = find_compiler()
    try:
        version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
        place = cache.cache_directory()
    except (OSError, RuntimeError) as cause:
        raise MissingDependencyError(
            "the C++ compiler or the folder of its results cannot be used",
            got=str(cause),
            hint="set CXX to a C++ compiler, and FORCEGP_CACHE to a folder that can be written",
        ) from cause
    key = hashlib.sha256("\0".join([source, version, _machine(), level, *FLAGS]).encode()).hexdigest()[:32]
    try:
        folder = cache.private_folder(place)
        kept = cache.find(folder, key)
        if kept is not None:
            try:
                return ctypes.CDLL(str(kept))
            except OSError:  # of another machine that shares the folder: build it anew
                discard(kept)
        return ctypes.CDLL(str(cache.store(folder, key, _compiled([compiler, level], source, folder))))
    except OSError as cause:
        raise MissingDependencyError(
            f"the kernel cannot be written to {place}",
            got=str(cause),
            hint="set FORCEGP_CACHE to a folder that can be written",
        ) from cause


def _compiled(compiler: Sequence[str], source: str, folder: Path) -> bytes:
    """The content of the shared library; what a killed compiler left in the folder is removed."""
    target = folder / "build"
    sweep(target)
    build = Temporary(target, folder=True, mode=0o700)
    try:
        build.path.chmod(0o700)
        return _built(compiler, source, build.path)
    finally:
        build.close()


def _built(compiler: Sequence[str], source: str, folder: Path) -> bytes:
    """What the compiler writes into a private folder, which is held open: its name may change hands."""
    if not PROC.is_dir():  # no folder has a name by its descriptor here
        _run_compiler(compiler, source, folder)
        return (folder / LIBRARY).read_bytes()
    held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        status = os.fstat(held)
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) != 0o700:
            raise OSError(errno.EPERM, "another folder was put in the place of the build folder", str(folder))
        _run_compiler(compiler, source, PROC / str(held))
        with os.fdopen(os.open(LIBRARY, os.O_RDONLY | os.O_NOFOLLOW, dir_fd=held), "rb") as file:
            return file.read()
    finally:
        os.close(held)


def _run_compiler(compiler: Sequence[str], source: str, folder: Path) -> None:
    command = [*compiler, *FLAGS, "-x", "c++", "-", "-o", LIBRARY, "-pthread"]
    done = subprocess.run(command, input=source, capture_output=True, text=True, check=False, cwd=folder)
    if done.returncode != 0:
        raise MissingDependencyError(
            f"the C++ compiler {compiler[0]} could not build the kernel",
            got=done.stderr.strip()[-2000:],
            hint="set CXX to a recent GCC or Clang",
        )
