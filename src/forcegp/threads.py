"""How many threads compute: one for small tensors, and for SciPy as many as PyTorch has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import RLock

import torch
from threadpoolctl import ThreadpoolController


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread within the block, for the calling thread alone.

    Handing a seven-by-seven matrix to a second thread costs more than the work on it, and many times
    more where the processor is shared. OpenMP keeps the number per thread; `torch.set_num_threads` would
    change it for threads that start meanwhile too, and for good.
    """
    if torch.get_num_threads() == 1:
        yield
        return
    with _openmp().limit(limits=1):
        yield


@contextmanager
def threads_of_pytorch() -> Iterator[None]:
    """SciPy's and NumPy's BLAS on as many threads as PyTorch within the block.

    OpenBLAS keeps threads of its own, one per processor, that spin while they wait. With two processes on two
    processors, each told to take one thread, a Cholesky inverse took twelve times as long as alone. OpenBLAS
    keeps the number per process, so blocks of several threads take turns.
    """
    threads = torch.get_num_threads()
    with _TURN:
        if all(library.num_threads == threads for library in _openblas().lib_controllers):
            yield
            return
        with _openblas().limit(limits=threads):
            yield


_TURN = RLock()


@cache
def _openblas() -> ThreadpoolController:
    """The BLAS libraries of NumPy and SciPy."""
    return ThreadpoolController().select(internal_api="openblas")


@cache
def _openmp() -> ThreadpoolController:
    """The OpenMP libraries of the process; found once, which takes milliseconds."""
    torch.get_num_threads()
    return ThreadpoolController().select(user_api="openmp")
