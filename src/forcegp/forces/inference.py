"""Conditioning forces on data: exactly, or sparsely through the features and inducing points of their
priors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forcegp.errors import UnknownNameError
from forcegp.forces.learn import Problem, kernel_parameters
from forcegp.forces.posterior import ForcePosterior, LatentPosterior
from forcegp.forces.priors.base import ForcePrior
from forcegp.gp.bound import bound_of
from forcegp.gp.capacity import require_exact_fits
from forcegp.gp.decomposition import split
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.inducing import candidates, select_inducing
from forcegp.gp.kernels import Parameters
from forcegp.gp.sparse import SparsePosterior, condition_sparse
from forcegp.gp.structured_covariance import Block

METHODS = ("auto", "exact", "sparse")
EXACT_SAMPLES = 1000
"""Samples up to which inference is exact by default."""


def check_method(inference: str) -> str:
    """The name of a method of inference.

    Raises:
        UnknownNameError: no such method.
    """
    if inference not in METHODS:
        raise UnknownNameError("inference", inference, METHODS)
    return inference


def is_finite(priors: Sequence[ForcePrior]) -> bool:
    """Whether all priors are a finite number of features, so that sparse inference is exact."""
    return all(split(prior.kernel).rest is None for prior in priors)


def is_sparse(inference: str, priors: Sequence[ForcePrior], samples: int) -> bool:
    """Whether inference is sparse: on request, for finite priors, and beyond `EXACT_SAMPLES`."""
    return inference == "sparse" or (inference == "auto" and (is_finite(priors) or samples > EXACT_SAMPLES))


@torch.no_grad()
def with_inducing(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> Problem:
    """The problem with inducing points chosen from its data by conditional variance."""
    rows = problem.rows(hyperparameters)
    chosen = select_inducing(
        problem.priors,
        kernel_parameters(hyperparameters),
        candidates(rows.blocks, sum(len(block.target) for block in rows.blocks)),
        rows=sum(block.rows for block in rows.blocks),
    )
    return dataclasses.replace(problem, inducing=tuple(selection.points for selection in chosen))


def without_inducing(problem: Problem) -> Problem:
    """The problem for priors that are finite features, which need no inducing points."""
    block = problem.fixed_rows.blocks[0]
    empty = tuple({name: x[:0] for name, x in features.items()} for features in block.features)
    return dataclasses.replace(problem, inducing=empty)


@torch.no_grad()
def force_posterior(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> ForcePosterior:
    """Forces conditioned on the data of a problem.

    Raises:
        NumericalError: the covariance of the data is not positive definite.
    """
    scales, params = problem.training.scales, kernel_parameters(hyperparameters)
    latent = _conditioned(problem, params, problem.rows(hyperparameters).blocks)
    coulomb = problem.coulomb(hyperparameters)
    if not problem.pinned:
        return ForcePosterior(problem.priors, scales, problem.mean, latent, problem.offsets, coulomb=coulomb)
    known = problem.of_means().rows(hyperparameters).blocks
    central = _conditioned(problem, params, problem.silenced(known))
    return ForcePosterior(problem.priors, scales, problem.mean, latent, problem.offsets, central, coulomb)


def _conditioned(problem: Problem, params: Parameters, blocks: list[Block]) -> LatentPosterior:
    if problem.inducing is None:
        require_exact_fits(blocks, learning=False)
        return ExactPosterior.of(problem.priors, params, blocks)
    return condition_sparse(problem.priors, params, blocks, problem.inducing)


def log_likelihood(posterior: ForcePosterior) -> float:
    """log p(y) of the rows without their constant, or its lower bound."""
    latent = posterior.latent
    if isinstance(latent, ExactPosterior):
        return float(latent.log_likelihood())
    assert isinstance(latent, SparsePosterior)
    return -float(bound_of(latent.sums, latent))


def jitter_of(posterior: ForcePosterior) -> float:
    """Added to the diagonal to factorise, relative to unit noise."""
    latent = posterior.latent
    return latent.conditioned.jitter if isinstance(latent, ExactPosterior) else getattr(latent, "jitter", 0.0)
