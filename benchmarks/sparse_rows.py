"""Synthetic whitened rows, seven per sample, with the default kernel of a structured GP of a seven-joint arm.

They are made chunk by chunk, so that memory is that of the sums.
"""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.forces.priors.sets import REMAINING
from forcegp.gp.basis import LatentBasis, latent_basis
from forcegp.gp.features import Block
from forcegp.gp.inducing import select_inducing
from forcegp.gp.kernels import Kernel
from forcegp.gp.sparse import SparsePosterior
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
