"""From source text to a callable kernel: the system's C++ compiler and a cache on disk, or NVRTC."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from forcegp.compiled import cache
from forcegp.compiled.source import CUDA_THREADS
from forcegp.errors import MissingDependencyError
from forcegp.temporary import Temporary, discard, sweep

Kernel = Callable[[Sequence[Tensor], Tensor], None]
"""Reads contiguous arrays `(B, nq)` and fills the contiguous result `(B, …)`."""

FLAGS = (
    "-std=c++17",
    "-O2",
    "-march=native",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-w",
    "-shared",
    "-fPIC",
)
SAMPLES_PER_THREAD = 512
"""A thread is started for no fewer samples than take longer than starting it."""


def find_compiler() -> str:
    """Path of the C++ compiler: `$CXX`, or the first of c++, g++ and clang++ on the PATH.

    Raises:
        MissingDependencyError: there is none.
    """
    wanted = [os.environ["CXX"]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    for name in wanted:
        if found := shutil.which(name):
            return found
    raise MissingDependencyError(
        "the compiled dynamics need a C++ compiler and none was found",
        expected=" or ".join(wanted) + " on the PATH",
        hint="install one (for example: apt install g++), set CXX, or use forcegp.dynamics, which needs none",
    )


def _machine() -> str:
    """What `-march=native` depends on."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return platform.processor() + platform.machine()
    keys = ("model name", "flags", "cpu family", "model\t", "Features", "CPU part")
    return "\n".join(sorted({line for line in text.splitlines() if line.startswith(keys)}))


def _load(text: str) -> ctypes.CDLL:
    """The shared library of a source text, compiled unless the cache has it.

    Raises:
        MissingDependencyError: no compiler, it failed, or the cache cannot be written or trusted.
    """
    compiler = find_compiler()
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    key = hashlib.sha256("\0".join([text, version, _machine(), *FLAGS]).encode()).hexdigest()[:32]
    place = cache.cache_directory()
    try:
        folder = cache.private_folder(place)
        kept = cache.find(folder, key)
        if kept is not None:
            try:
                return ctypes.CDLL(str(kept))
            except OSError:  # of another machine that shares the folder: build it anew
                discard(kept)
        return ctypes.CDLL(str(cache.store(folder, key, _compiled(compiler, text, folder))))
    except OSError as cause:
        raise MissingDependencyError(
            f"the kernel cannot be written to {place}",
            got=str(cause),
            hint="set FORCEGP_CACHE to a folder that can be written",
        ) from cause


def _compiled(compiler: str, text: str, folder: Path) -> bytes:
    """The content of the shared library; what a killed compiler left in the folder is removed."""
    target = folder / "build"
    sweep(target)
    build = Temporary(target, folder=True, mode=0o700)
    try:
        build.path.chmod(0o700)
        library = build.path / "kernel.so"
        _run_compiler(compiler, text, library)
        return library.read_bytes()
    finally:
        build.close()


def _run_compiler(compiler: str, text: str, library: Path) -> None:
    command = [compiler, *FLAGS, "-x", "c++", "-", "-o", str(library), "-pthread"]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise MissingDependencyError(
            f"the C++ compiler {compiler} could not build the kernel",
            got=done.stderr.strip()[-2000:],
            hint="set CXX to a recent GCC or Clang, or use forcegp.dynamics, which needs no compiler",
        )


def cpu_kernel(text: str) -> Kernel:
    """The kernel of a `cpu_source`, run on as many threads as `torch.get_num_threads()`."""
    function = _load(text).kernel
    function.restype = None
    function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long, ctypes.c_long]

    def run(arrays: Sequence[Tensor], out: Tensor) -> None:
        batch = out.shape[0]
        threads = max(1, min(torch.get_num_threads(), batch // SAMPLES_PER_THREAD))
        pointers = (ctypes.c_void_p * len(arrays))(*[x.data_ptr() for x in arrays])
        function(pointers, out.data_ptr(), batch, threads)

    return run


def cuda_kernel(text: str) -> Kernel:
    """The kernel of a `cuda_source`, compiled by NVRTC.

    Raises:
        MissingDependencyError: this PyTorch cannot compile a CUDA kernel at run time.
    """
    compile_kernel = getattr(torch.cuda, "_compile_kernel", None)
    if compile_kernel is None or not torch.cuda.is_available():
        raise MissingDependencyError(
            "the compiled dynamics cannot be built for CUDA here",
            expected="a CUDA device and PyTorch 2.9 or newer",
            got=f"PyTorch {torch.__version__}",
            hint="use forcegp.dynamics, which runs on CUDA as it is",
        )
    function = compile_kernel(text, "kernel")

    def run(arrays: Sequence[Tensor], out: Tensor) -> None:
        batch = out.shape[0]
        blocks = (batch + CUDA_THREADS - 1) // CUDA_THREADS
        with torch.cuda.device(out.device):
            function(grid=(blocks, 1, 1), block=(CUDA_THREADS, 1, 1), args=[*arrays, out, batch])

    return run
