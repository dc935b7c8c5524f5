"""From source text to a callable kernel: C++ on the CPU, NVRTC on a GPU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from forcegp.compiled.source import CUDA_THREADS
from forcegp.errors import MissingDependencyError
from forcegp.native.library import load_library

Kernel = Callable[[Sequence[Tensor], Tensor], None]
"""Reads contiguous arrays `(B, nq)` and fills the contiguous result `(B, …)`."""

SAMPLES_PER_THREAD = 512
"""A thread is started for no fewer samples than take longer than starting it."""


def cpu_kernel(text: str) -> Kernel:
    """The kernel of a `cpu_source`, run on as many threads as `torch.get_num_threads()`."""
    function = load_library(text).kernel
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
