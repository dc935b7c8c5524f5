"""Initial values, bounds and weak priors of the hyperparameters.

Inputs are standardized, so a length-scale of the order of the square root of their number relates
typical samples. A prior around that start, log-normal with another width on either side, keeps the
length-scales of inputs that do not matter from drifting to infinity (four e-folds), and asks for evidence
before a force varies on a scale so short that it can follow the noise (one e-fold). The scale of a force
starts at the root mean square of the force that explains the training residuals by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forcegp.forces.priors.base import ForcePrior
from forcegp.gp.kernels import Parameters
from forcegp.gp.structured_covariance import Block

LOG_LENGTHSCALE_BOUNDS = (math.log(0.03), math.log(3e4))
LOG_STD_BOUNDS = (math.log(1e-6), math.log(1e6))
LOG_NOISE_BOUNDS = (math.log(1e-6), math.log(1e4))
WIDTH = {"log_lengthscale": (1.0, 4.0), "log_noise_std": (5.0, 5.0)}
"""Standard deviations of the log-normal priors below and above the start, in e-folds; 3 where not named."""


def initial_hyperparameters(priors: Sequence[ForcePrior], blocks: Sequence[Block]) -> dict[str, Tensor]:
    """Where learning starts, by `<prior>.<name>`."""
    params: dict[str, Tensor] = {}
    like = blocks[0].target
    for p, prior in enumerate(priors):
        if prior.prefix != prior.name:
            continue  # The hyperparameters are those of another prior.
        widths = {name: x.shape[-1] for name, x in blocks[0].features[p].items()}
        scale = _force_scale(p, blocks)
        initial = prior.kernel.initial(len(scale), widths, scale.log().cpu().double())
        params |= {f"{prior.name}.{name}": value.to(like) for name, value in initial.items()}
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
    kinds = {"log_lengthscale": LOG_LENGTHSCALE_BOUNDS, "log_noise_std": LOG_NOISE_BOUNDS}
    return {key: kinds.get(key.rsplit(".", 1)[-1], LOG_STD_BOUNDS) for key in params}


def negative_log_prior(params: Parameters, start: Mapping[str, Tensor]) -> Tensor:
    """Σ ½ ((θ − θ_start)/width)², the weak prior on log-hyperparameters up to a constant."""
    terms = []
    for key, value in params.items():
        below, above = WIDTH.get(key.rsplit(".", 1)[-1], (3.0, 3.0))
        apart = value - start[key]
        terms.append((0.5 * (apart / torch.where(apart < 0.0, below, above)) ** 2).sum())
    return torch.stack(terms).sum()
