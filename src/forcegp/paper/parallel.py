"""Jobs that depend on each other, in several processes.

Each process computes in one thread: the matrices here are too small to share among threads, while the fits
of a reproduction are independent of each other.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Any

import torch

MOST_PROCESSES = 8
"""Default limit on the number of processes: each holds the libraries and a log in memory."""


@dataclass(frozen=True)
class Job:
    """A call that leaves its result in files.

    Attributes:
        name: unique.
        call: a function that other processes can import, called with `arguments`.
        arguments: must pickle.
        after: names of the jobs that must end first.
    """

    name: str
    call: Callable[..., Any]
    arguments: tuple[Any, ...]
    after: Sequence[str] = ()


def available_processors() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_jobs(jobs: Sequence[Job], processes: int) -> Iterator[tuple[str, Any]]:
    """Run jobs in several processes, each as soon as those before it have ended.

    Jobs that are ready start in the order given. When one fails, those that run are waited for and no
    further one starts.

    Args:
        jobs: each after those that it names.
        processes: how many run at the same time.

    Yields:
        Name and result of each job, as it ends.

    Raises:
        Exception: whatever a job raised.
    """
    by_name: Mapping[str, Job] = {job.name: job for job in jobs}
    order = TopologicalSorter({job.name: job.after for job in jobs})
    order.prepare()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, initializer=_begin) as pool:
        running: dict[Future[Any], str] = {}
        try:
            while order.is_active():
                for name in sorted(order.get_ready(), key=list(by_name).index):
                    running[pool.submit(by_name[name].call, *by_name[name].arguments)] = name
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    name = running.pop(future)
                    yield name, future.result()
                    order.done(name)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _begin() -> None:
    """Set up a process: one thread, and an end as soon as the process that started it has ended."""
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        # A killed parent cannot end its pool, and a worker would wait for work forever.
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
