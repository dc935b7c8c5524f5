"""Checks of the available memory before large allocations, and control of the number of threads.

Operations on small tensors run on one thread, and SciPy uses as many threads as PyTorch.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import RLock

import torch
from threadpoolctl import ThreadpoolController

from forcegp.errors import MemoryLimitError

LARGE = 0.5
"""Fraction of the free memory above which a warning is issued."""

_CGROUP = Path("/sys/fs/cgroup")
_TURN = RLock()


class MemoryNeedWarning(UserWarning):
    """Warning about a computation that needs more than half of the free memory."""


def free_memory() -> int | None:
    """Return the memory available to this process without swapping [bytes]; `None` if unknown."""
    limits = [value for value in (_available(), _container_memory()) if value is not None]
    return min(limits) if limits else None


def announce_memory(needed: int, what: str, *, certain: int | None = None) -> None:
    """Warn about high memory use, and raise `MemoryLimitError` if there is not enough free memory.

    Call this function before the allocation, with an upper bound `needed` [bytes] and, if that is rough, also
    a lower bound `certain`. `what` is the subject of the message, such as "the covariance of 20,000 points".
    """
    free = free_memory()
    if free is None or needed <= LARGE * free:
        return
    least = needed if certain is None else certain
    if least > free:
        text = f"{what} needs more memory than is free"
        hint = "use less data or a smaller model, or free memory"
        raise MemoryLimitError(text, expected=f"at most {_gib(free)}", got=_gib(least), hint=hint)
    bound = "" if certain is None else "up to "
    sentence = f"{what} needs {bound}{_gib(needed)} of {_gib(free)} of free memory"
    warnings.warn(sentence, MemoryNeedWarning, stacklevel=2)


def _gib(value: int) -> str:
    return f"{value / (1 << 30):.2f} GiB"


def _available() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def _container_memory() -> int | None:
    """Return the memory available within the limit of the control group (version 2, otherwise version 1)."""
    for most, used in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        try:
            return max(0, int((_CGROUP / most).read_text()) - int((_CGROUP / used).read_text()))
        except (OSError, ValueError):  # "max": no limit
            continue
    return None


@contextmanager
def one_thread() -> Iterator[None]:
    """Run PyTorch single-threaded within the block. Only calls from the current thread are affected.

    For small matrices, multithreading costs more time than it saves. OpenMP limits only the calling thread,
    whereas `torch.set_num_threads` would permanently change the setting for all threads.
    """
    if torch.get_num_threads() == 1:
        yield
        return
    with _openmp().limit(limits=1):
        yield


@contextmanager
def threads_of_pytorch() -> Iterator[None]:
    """Run the BLAS libraries of SciPy and NumPy on as many threads as PyTorch within the block.

    OpenBLAS starts one spinning thread per processor, which considerably slows down concurrent processes. Its
    setting applies to the whole process, so blocks in different threads take turns.
    """
    threads = torch.get_num_threads()
    with _TURN:
        if all(library.num_threads == threads for library in _openblas().lib_controllers):
            yield
            return
        with _openblas().limit(limits=threads):
            yield


@cache
def _openblas() -> ThreadpoolController:
    """Return the BLAS libraries of NumPy and SciPy."""
    return ThreadpoolController().select(internal_api="openblas")


@cache
def _openmp() -> ThreadpoolController:
    """Return the OpenMP libraries of the process, cached because the lookup takes milliseconds."""
    torch.get_num_threads()
    return ThreadpoolController().select(user_api="openmp")
