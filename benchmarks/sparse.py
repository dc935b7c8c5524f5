"""Sparse posterior: time and memory against the number of samples, predictions, updates, two processes.

    python benchmarks/sparse.py --json result.json            # 10⁵ and 10⁶ samples, about five minutes
    python benchmarks/sparse.py --samples 20000 50000 --exact 200

The rows are synthetic, seven for each sample, with the default kernel of a structured GP of a seven-joint
arm; they are made chunk by chunk, so that memory is that of the sums. Each measurement runs in a process of
its own, with one thread, so that peak memory is its own; ratios are of one run on one machine.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import platform
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist
from results_page import table, write_section
from torch import Tensor

from forcegp.forces.priors.default import REMAINING
from forcegp.gp.basis import LatentBasis, latent_basis
from forcegp.gp.distributed import reduce_sums, shard
from forcegp.gp.inducing import select_inducing
from forcegp.gp.kernels import Kernel
from forcegp.gp.likelihood import condition, negative_log_likelihood
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.structured_covariance import Block
from forcegp.gp.sums import accumulate

JOINTS, CHUNK = 7, 4096
POINTS = 70
"""Inducing points: about 500 basis functions of seven joints."""
REPEATS = 30


@dataclass(frozen=True)
class Prior:
    """A process of seven components."""

    kernel: Kernel = REMAINING
    prefix: str = "joint"


def stream(first: int, last: int) -> Iterator[Block]:
    """Samples `first` to `last` of an endless log of slowly varying states, chunk by chunk."""
    generator = torch.Generator().manual_seed(0)
    frequency, phase = (torch.rand(2, JOINTS, generator=generator, dtype=torch.float64) for _ in range(2))
    W = 3.0 * torch.randn(64, JOINTS, JOINTS, generator=generator, dtype=torch.float64)
    for begin in range(first, last, CHUNK):
        index = torch.arange(begin, min(begin + CHUNK, last))
        angle = index[:, None, None] * (0.05 * frequency) + 6.28 * phase
        q, qd = 1.4 * torch.sin(angle[:, 0]), 1.4 * torch.cos(angle[:, 1])
        operators = W[index % 64]
        force = torch.sin(q) - 0.5 * qd
        noise = torch.randn(q.shape, generator=generator.manual_seed(begin), dtype=torch.float64)
        target = (operators @ force[..., None])[..., 0] + noise
        yield Block(({"q": q, "qd": qd},), (operators,), target)


def parameters() -> dict[str, Tensor]:
    """The kernel's initial hyperparameters."""
    initial = Prior().kernel.initial(JOINTS, {"q": JOINTS, "qd": JOINTS})
    return {f"joint.{key}": value for key, value in initial.items()}


def basis() -> LatentBasis:
    """Basis functions with `POINTS` inducing points."""
    params = parameters()
    (selection,) = select_inducing([Prior()], params, list(stream(0, CHUNK)), limit=POINTS, share=0.0)
    return latent_basis([Prior()], params, [selection.points], [JOINTS])


def median_ms(function: Callable[[], object], repeats: int = REPEATS) -> dict[str, float]:
    """Median milliseconds of a call, after one that warms up, on the clock and of the processor."""
    function()
    wall, processor = [], []
    for _ in range(repeats):
        began, used = time.perf_counter(), time.process_time()
        function()
        wall.append(time.perf_counter() - began)
        processor.append(time.process_time() - used)
    return {"wall": 1e3 * statistics.median(wall), "processor": 1e3 * statistics.median(processor)}


def peak_mib() -> float:
    """Peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def conditioning(samples: int) -> dict:
    """Seconds and peak memory of conditioning on a stream of samples."""
    functions = basis()
    accumulate(functions, stream(0, CHUNK))
    before, began, used = peak_mib(), time.perf_counter(), time.process_time()
    posterior = SparsePosterior.of(functions, accumulate(functions, stream(0, samples)))
    posterior.weights  # noqa: B018  (computed here, so that the time includes it)
    seconds = time.perf_counter() - began
    return {
        "samples": samples,
        "seconds": seconds,
        "processor_seconds": time.process_time() - used,
        "basis_functions": functions.size,
        "before_mib": before,
        "peak_mib": peak_mib(),
    }


def predictions(samples: int) -> dict:
    """Milliseconds of predictions and updates."""
    functions = basis()
    posterior = SparsePosterior.of(functions, accumulate(functions, stream(0, samples)))
    one, many = next(stream(7, 8)), next(stream(0, 1000))
    return {
        "basis_functions": functions.size,
        "one_mean_ms": median_ms(lambda: posterior.latent_mean(0, one.features[0])),
        "one_mean_and_covariance_ms": median_ms(
            lambda: (posterior.latent_mean(0, one.features[0]), posterior.covariance(one))
        ),
        "thousand_covariances_ms": median_ms(lambda: posterior.covariance(many), 5),
        "update_one_sample_ms": median_ms(lambda: posterior.updated([one])),
    }


def exact(samples: int) -> dict:
    """Seconds of one exact conditioning and of one exact likelihood with gradient, on the same rows."""
    blocks, params = list(stream(0, samples)), parameters()
    began = time.perf_counter()
    condition([Prior()], params, blocks)
    conditioned = time.perf_counter() - began
    leaves = {key: value.clone().requires_grad_() for key, value in params.items()}
    began = time.perf_counter()
    value = negative_log_likelihood([Prior()], leaves, blocks)
    torch.autograd.grad(value, list(leaves.values()))
    return {
        "samples": samples,
        "condition_seconds": conditioned,
        "likelihood_seconds": time.perf_counter() - began,
        "peak_mib": peak_mib(),
    }


def shards(samples: int, rank: int, processes: int, store: str) -> dict:
    """Seconds of the sums over one process's shard and their reduction."""
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=processes)
    functions, own = basis(), shard(samples, rank, processes)
    accumulate(functions, stream(0, CHUNK))
    dist.barrier()
    began, used = time.perf_counter(), time.process_time()
    total = reduce_sums(accumulate(functions, stream(own.start, own.stop)))
    seconds, processor = time.perf_counter() - began, time.process_time() - used
    dist.destroy_process_group()
    return {"seconds": seconds, "processor_seconds": processor, "rows": float(total.rows)}


def _call(function: Callable[..., dict], arguments: tuple, results: object) -> None:
    torch.set_num_threads(1)
    results.put(function(*arguments))


def alone(function: Callable[..., dict], *calls: tuple) -> list[dict]:
    """Results of calls, each in a process of its own, at the same time."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    processes = [context.Process(target=_call, args=(function, call, results)) for call in calls]
    for process in processes:
        process.start()
    found = [results.get() for _ in processes]
    for process in processes:
        process.join()
    return found


def two_against_one(samples: int) -> dict:
    """How much faster two processes of one thread are than one."""
    seconds, processor = [], []
    for count in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            store = str(Path(folder) / "store")
            found = alone(shards, *((samples, rank, count, store) for rank in range(count)))
        seconds.append(max(result["seconds"] for result in found))
        processor.append(max(result["processor_seconds"] for result in found))
    return {
        "samples": samples,
        "one": seconds[0],
        "two": seconds[1],
        "ratio": seconds[0] / seconds[1],
        "ratio_of_processor_time": processor[0] / processor[1],
    }


def markdown(result: dict) -> str:
    """The section of the page of results."""
    rows = [
        [
            f"{run['samples']:,}",
            f"{run['seconds']:.1f}",
            f"{run['processor_seconds']:.1f}",
            f"{run['peak_mib']:.0f}",
        ]
        for run in result["conditioning"]
    ]
    one, processes = result["predictions"], result["processes"]
    parts = [
        "## Sparse posterior",
        f"Synthetic rows, seven per sample, one thread, float64, {result['machine']}; "
        "`python benchmarks/sparse.py --json FILE --docs docs/benchmarks.md` measures it again.",
        table(["samples", "wall [s]", "processor [s]", "peak memory [MiB]"], rows),
        f"With {one['basis_functions']} basis functions, in ms of processor time: mean of one state "
        f"{one['one_mean_ms']['processor']:.2f}, with covariance "
        f"{one['one_mean_and_covariance_ms']['processor']:.2f}, covariances of 1000 states "
        f"{one['thousand_covariances_ms']['processor']:.0f}, update with one sample "
        f"{one['update_one_sample_ms']['processor']:.2f}. Two processes of one thread are "
        f"{processes['ratio']:.2f} times as fast as one.",
    ]
    if "exact" in result:
        exact = result["exact"]
        parts.append(
            f"Exact inference on {exact['samples']} samples takes {exact['condition_seconds']:.1f} s to "
            f"condition, {exact['likelihood_seconds']:.1f} s for one likelihood with gradient, and "
            f"{exact['peak_mib']:.0f} MiB."
        )
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--exact", type=int, default=1000, help="samples of the exact comparison; 0 for none")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    parser.add_argument("--docs", type=Path, help="write the tables into this Markdown file")
    options = parser.parse_args()
    result: dict = {"machine": platform.processor() or platform.machine(), "threads": 1}

    def note(key: str, value: object) -> None:
        result[key] = value
        print(key, json.dumps(value, indent=2), flush=True)

    note("conditioning", [alone(conditioning, (samples,))[0] for samples in options.samples])
    runs = result["conditioning"]
    if len(runs) > 1:
        rate = [run["processor_seconds"] / run["samples"] for run in runs]
        note("processor_seconds_per_sample_last_to_first", rate[-1] / rate[0])
        note("peak_mib_last_minus_first", runs[-1]["peak_mib"] - runs[0]["peak_mib"])
    note("predictions", alone(predictions, (min(options.samples),))[0])
    note("processes", two_against_one(min(options.samples)))
    if options.exact:
        note("exact", alone(exact, (options.exact,))[0])
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if options.docs is not None:
        write_section(options.docs, "sparse", markdown(result))


if __name__ == "__main__":
    main()
