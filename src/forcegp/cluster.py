"""Work on a Dask cluster, either a new one on this machine or an existing one.

Dask repeats the tasks of workers that are lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from forcegp.errors import optional_module

if TYPE_CHECKING:
    from distributed import Client

WORKER_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), 1)
"""Environment of new workers. By default, Dask also sets `MALLOC_TRIM_THRESHOLD_`. With it, glibc returns
each large array to the system, and sums over samples take 2.5 times as long."""
X = TypeVar("X")
Y = TypeVar("Y")


@contextmanager
def cluster(workers: int = 2, address: str | None = None) -> Iterator[Client]:
    """Connect to a cluster for the duration of a `with` statement.

    Args:
        workers: number of single-threaded workers on this machine.
        address: address of the scheduler of a running cluster, such as `tcp://host:8786`, instead of these.

    Raises:
        MissingDependencyError: Dask is not installed.
    """
    dask = optional_module("distributed", "A cluster", "sweep")
    if address is not None:
        with dask.Client(address) as client:
            yield client
        return
    with (
        optional_module("dask.config", "A cluster", "sweep").set(
            {"distributed.nanny.pre-spawn-environ": WORKER_ENVIRONMENT}
        ),
        dask.LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0") as local,
        dask.Client(local) as client,
    ):
        yield client


def worker_count(client: Client) -> int:
    """Return the number of workers."""
    return max(1, len(client.scheduler_info()["workers"]))


def on_cluster(client: Client, function: Callable[[X], Y], items: Iterable[X]) -> Iterator[Y]:
    """Yield the results of a function for some items, in their order."""
    futures = client.map(function, list(items), pure=False)
    try:
        for future in futures:
            yield future.result()
    finally:
        client.cancel(futures)
