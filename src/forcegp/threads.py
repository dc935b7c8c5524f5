"""Work on small tensors, which more threads only slow down."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

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


@cache
def _openmp() -> ThreadpoolController:
    """The OpenMP libraries of the process; found once, which takes milliseconds."""
    torch.get_num_threads()
    return ThreadpoolController().select(user_api="openmp")
