"""Where L-BFGS starts: initial hyperparameters, their bounds and weak priors, warm starts and restarts.

Inputs are standardized, so a length-scale of about the square root of their number relates typical samples. A
log-normal prior around this start, with a different width on either side, keeps the length-scales of
irrelevant inputs from drifting to infinity (four e-folds above), and asks for evidence before a force varies
on a scale so short that it could follow the noise (one e-fold below). The standard deviation of a force
starts at the root mean square of the force that explains the training residuals by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.forces.priors.base import RESERVED, ForcePrior
from forcegp.gp.kernels import Parameters
from forcegp.gp.structured_covariance import Block

LOG_LENGTHSCALE_BOUNDS = (math.log(0.03), math.log(3e4))
LOG_STD_BOUNDS = (math.log(1e-6), math.log(1e6))
LOG_NOISE_BOUNDS = (math.log(1e-6), math.log(1e4))
LOG_COEFFICIENT_BOUNDS = (math.log(1e-3), math.log(2.0))
LOG_SPEED_BOUNDS = (math.log(1e-3), math.log(1.0))
LOG_SMOOTHING_BOUNDS = (math.log(1e-4), math.log(0.1))
WIDTH = {
    "log_coefficient": (2.0, 1.0),
    "log_smoothing": (2.0, 1.0),
    "log_speed": (1.0, 1.0),
    "log_lengthscale": (1.0, 4.0),
    "log_noise_std": (5.0, 5.0),
    "log_scale": (1.0, 1.0),
    "log_offset": (1.0, 1.0),
}
"""Standard deviations of the log-normal priors below and above the start, in e-folds; 3 where not named."""
OWN = tuple(name + "." for name in RESERVED)
"""Prefixes of what is learned besides the hyperparameters of the priors."""


def initial_hyperparameters(priors: Sequence[ForcePrior], blocks: Sequence[Block]) -> dict[str, Tensor]:
    """Initial log-hyperparameters, by `<prior>.<name>`."""
    params: dict[str, Tensor] = {}
    for p, prior in enumerate(priors):
        if prior.prefix != prior.name:
            continue  # It shares the hyperparameters of another prior.
        widths = {name: x.shape[-1] for name, x in blocks[0].features[p].items()}
        scale = _force_scale(p, blocks)
        initial = prior.kernel.initial(len(scale), widths, scale.log().cpu().double())
        params |= {f"{prior.name}.{name}": value.to(scale.device) for name, value in initial.items()}
    return params


def _force_scale(p: int, blocks: Sequence[Block]) -> Tensor:
    """Root mean square of the least-squares force of prior p, `(components,)`."""
    total, count = torch.zeros_like(blocks[0].operators[p][0, 0]), 0
    for block in blocks:
        force = (torch.linalg.pinv(block.operators[p], rtol=1e-6) @ block.target[..., None])[..., 0]
        total, count = total + (force**2).sum(0), count + len(force)
    return (total / max(count, 1)).sqrt().clamp(1e-3, 1e4)


def bounds_of(params: Parameters) -> dict[str, tuple[float, float]]:
    """Box of each hyperparameter, for the optimiser."""
    kinds = {
        "log_lengthscale": LOG_LENGTHSCALE_BOUNDS,
        "log_noise_std": LOG_NOISE_BOUNDS,
        "log_coefficient": LOG_COEFFICIENT_BOUNDS,
        "log_smoothing": LOG_SMOOTHING_BOUNDS,
        "log_speed": LOG_SPEED_BOUNDS,
    }
    return {key: kinds.get(key.rsplit(".", 1)[-1], LOG_STD_BOUNDS) for key in params}


def negative_log_prior(params: Parameters, start: Mapping[str, Tensor]) -> Tensor | float:
    """Σ ½ ((θ − θ_start)/width)², the weak prior on log-hyperparameters up to a constant."""
    total: Tensor | float = 0.0
    for key, value in params.items():
        below, above = WIDTH.get(key.rsplit(".", 1)[-1], (3.0, 3.0))
        apart = value - start[key]
        total = total + (0.5 * (apart / torch.where(apart < 0.0, below, above)) ** 2).sum()
    return total


def given_start(given: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Given values of what is learned, checked against the default start.

    Raises:
        ModelError: a value is missing, or has another shape.
    """
    for key, value in start.items():
        got = given[key].shape if key in given else None
        if got != value.shape:
            raise ModelError(
                f"incompatible initial hyperparameters: {key}",
                expected=tuple(value.shape),
                got="none" if got is None else tuple(got),
                hint="take those of a model with the same priors",
            )
    return {key: given[key].detach().to(value) for key, value in start.items()}


def random_starts(start: Mapping[str, Tensor], restarts: int, seed: int) -> Iterator[dict[str, Tensor]]:
    """The start, then as many random ones around its hyperparameters as there are restarts."""
    generator = torch.Generator().manual_seed(seed)
    yield dict(start)
    for _ in range(restarts):
        yield {
            key: value
            if key.startswith(OWN)
            else value + torch.randn(value.shape, dtype=torch.float64, generator=generator).to(value)
            for key, value in start.items()
        }


def warm_start_sizes(samples: int, first: int | None) -> list[int]:
    """Numbers of samples to learn on first, each twice the one before, up to half of all."""
    sizes: list[int] = []
    size = first
    while size is not None and samples > 2 * size:
        sizes.append(size)
        size *= 2
    return sizes
