"""Noise that depends on the learned forces: slopes that propagate state noise, and sample weights.

Updates of both alternate with updates of the hyperparameters (`fit.py`).

**Slopes.** The first fit propagates state noise through the equations of motion of the robot file
(`noise.py`), which do not include the unknown forces. For example, a spring of 100 N m/rad converts noise of
1 mrad to 0.1 N m. Following McHutchon and Rasmussen (*Gaussian process training with input noise*, 2011), the
slope of the posterior mean F̄ is computed at each sample, and the hyperparameters are relearned with

    cov(y_i) = Σ_y + G_i Σ_x G_iᵀ,   G_i = ∂(L b + H F̄)/∂(q, q̇) + H ∂F̄/∂(q, q̇),

where the first derivative is taken at fixed F̄. The same applies to multipliers. The posterior mean can be
worse than the robot file, for example far from other samples. New slopes are therefore accepted only if they
increase the evidence of the training data, including the weak priors.

**Weights.** Impacts, dropped packets and gear shocks violate the equations of motion at a few samples, which
would dominate a Gaussian likelihood. With y_i | w_i ~ N(E y_i, Σ_i/w_i) and w_i ~ Γ(ν/2, ν/2), where the d
components of sample i share w_i, the noise has a t distribution with ν degrees of freedom. Given the weights,
all distributions are Gaussian, so inference remains exact. Expectation maximisation alternates learning with

    w_i = (ν + d) / (ν + E[r_iᵀ Σ_i⁻¹ r_i]),

where r_i is the residual under the posterior. Samples with residuals far above the noise receive almost no
weight (Lange, Little and Taylor, *Robust statistical modeling using the t distribution*, 1989).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.forces.noise import learned_slopes
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.problem import Problem, force_posterior
from forcegp.forces.quantities import affine_map
from forcegp.gp.optimise import Learned, Progress
from forcegp.learning.search import Search

STEPS = 5
"""Number of weight updates for given hyperparameters; each requires a posterior."""
CHUNK_STATES = 1024
"""Number of samples for which residuals are computed at a time."""
IGNORED = 0.1
"""Weight below which a sample is considered ignored."""


def with_learned_slopes(
    problem: Problem, search: Search, learned: Learned, progress: Progress | None = None
) -> tuple[Problem, Learned, tuple[str, ...]]:
    """Return the problem with slopes of its learned forces, the resulting hyperparameters, and warnings.

    The problem and the hyperparameters are returned unchanged if the evidence does not increase, or if the
    slopes cannot be computed or used (for example, because a force is not computed with tensors).

    Args:
        problem: problem with exact inference and state noise.
    """
    values = search.values(learned)
    posterior, system = force_posterior(problem, values), problem.system_at(values)
    try:
        training = learned_slopes(problem.training, system, posterior)
        updated = dataclasses.replace(problem, training=training)
        relearned = search.solve(updated, progress, learned.tensors)
    except (NumericalError, RuntimeError) as cause:
        text = "the slopes of the learned forces, which state noise requires, cannot be used"
        return problem, learned, (f"{text}: {str(cause).splitlines()[0]}",)
    return (updated, relearned, ()) if relearned.value < learned.value else (problem, learned, ())


@torch.no_grad()
def weighted(problem: Problem, values: Mapping[str, Tensor], degrees: float) -> Problem:
    """Return the problem with its sample weights updated `STEPS` more times.

    Args:
        degrees: degrees of freedom ν.
    """
    for _ in range(STEPS):
        posterior = force_posterior(problem, values)
        count = len(problem.training.measurements)
        weights = tuple(_weights(problem, posterior, values, i, degrees) for i in range(count))
        training = dataclasses.replace(problem.training, weights=weights)
        problem = dataclasses.replace(problem, training=training)
    return problem


def left_out(problem: Problem) -> int:
    """Return the number of samples with almost no weight."""
    return sum(int((w < IGNORED).sum()) for w in problem.training.weights or ())


def _weights(
    problem: Problem, posterior: ForcePosterior, values: Mapping[str, Tensor], i: int, degrees: float
) -> Tensor:
    """Return the weights `(n,)` of the samples in measurement i."""
    m, system, weights = problem.training.measurements[i], problem.system_at(values), []
    noise = problem.sample_noise(values, system, i)
    for rows in torch.arange(len(m.q), device=m.q.device).split(CHUNK_STATES):
        part = m[rows]
        at = part.at(system)
        z = affine_map(system, at, m.quantity)
        mean, spread = posterior.read(system, at, z)
        # E[r rᵀ] = (y − E z)(y − E z)ᵀ + Cov z, E[rᵀ Σ_i⁻¹ r] = tr Σ_i⁻¹ E[r rᵀ]
        residual = part.values - mean
        square = residual[..., None] * residual[:, None, :] + spread
        L = torch.linalg.cholesky(noise[rows].covariance(at, posterior.process.coupled(system, at, z)))
        distance = torch.cholesky_solve(square, L).diagonal(dim1=-2, dim2=-1).sum(-1)
        # w_i = (ν + d)/(ν + E[rᵀ Σ_i⁻¹ r])
        weights.append((degrees + part.values.shape[-1]) / (degrees + distance))
    return torch.cat(weights)
