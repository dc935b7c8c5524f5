"""Conditioning forces on data: exactly, or sparsely through the features and inducing points of their priors.

Sparse conditioning goes piece by piece: it sums over samples, and the sums determine the posterior.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.learn import Problem, kernel_parameters
from forcegp.forces.measurements import Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ForcePrior
from forcegp.gp.basis import LatentBasis, latent_basis
from forcegp.gp.bound import bound_of
from forcegp.gp.exact import ExactPosterior, require_exact_fits
from forcegp.gp.inducing import CANDIDATES, LIMIT, select_inducing
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import Sums, accumulate, add_over_processes, reduce_sums

PIECE_SAMPLES = 8192
"""Samples whose equations of motion are held at a time."""


@dataclass(frozen=True, eq=False)
class Totals:
    """What sparse conditioning keeps of the pieces that it has seen.

    Attributes:
        sums: over the whitened rows.
        constant: part of the negative log likelihood that no latent force changes `()`.
        samples: number of samples `()`.
        pieces: how many pieces.
    """

    sums: Sums
    constant: Tensor
    samples: Tensor
    pieces: int

    @classmethod
    def zero(cls, problem: Problem, basis: LatentBasis) -> Totals:
        """Of no samples."""
        like = next(iter(basis.params.values()))
        return cls(Sums.zero(basis, like), like.new_zeros(()), like.new_zeros(()), 0)

    def over_processes(self) -> Totals:
        """The totals of all processes of `torch.distributed` added, the same in each of them."""
        constant, samples = add_over_processes(torch.stack([self.constant, self.samples])).unbind()
        return Totals(reduce_sums(self.sums), constant, samples, self.pieces)


def basis_of(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> LatentBasis:
    """The basis functions of a problem with inducing points.

    Raises:
        ModelError: inference is exact.
    """
    if problem.inducing is None:
        raise ModelError("exact inference has no basis functions", hint='use inference="sparse"')
    components = [prior.outputs(problem.system.robot) for prior in problem.priors]
    return latent_basis(problem.priors, kernel_parameters(hyperparameters), problem.inducing, components)


@torch.no_grad()
def total_over(
    problem: Problem,
    hyperparameters: Mapping[str, Tensor],
    basis: LatentBasis,
    pieces: Iterable[Training],
    begin: Totals | None = None,
    after: Callable[[Totals], None] = lambda _: None,
) -> Totals:
    """Sum over pieces of a log, in memory that does not depend on their number.

    Args:
        problem: robot, priors and noise; its own training data are not read.
        hyperparameters: learned and held.
        basis: basis functions.
        pieces: the samples; may be a generator.
        begin: totals of the pieces before.
        after: called after each piece.
    """
    total = begin or Totals.zero(problem, basis)
    for piece in pieces:
        piece_problem = dataclasses.replace(problem, training=piece)
        rows = piece_problem.rows(hyperparameters)
        total = Totals(
            total.sums + accumulate(basis, rows.blocks),
            total.constant + rows.constant,
            total.samples + piece.samples,
            total.pieces + 1,
        )
        after(total)
    return total


def posterior_of(
    problem: Problem, hyperparameters: Mapping[str, Tensor], basis: LatentBasis, total: Totals
) -> ForcePosterior:
    """Forces conditioned on the samples of totals.

    Raises:
        NumericalError: the sums are not finite, or the noise is rounding beside the prior.
    """
    # A = I + Σ V S Vᵀ, w ~ N(A⁻¹v, A⁻¹)
    latent = SparsePosterior.of(basis, total.sums)
    latent.require_resolved()
    return ForcePosterior(problem.process_at(hyperparameters), latent)


EXACT_SAMPLES = 1000
"""Samples up to which inference is exact by default."""


def require_double(system: ConstrainedSystem) -> None:
    """Refuse a robot in single precision, whose covariance matrices are not positive definite after rounding.

    Raises:
        ModelError: the robot is not float64.
    """
    if system.robot.dtype != torch.float64:
        raise ModelError(
            f"Gaussian processes of {system.robot.name!r} need double precision",
            expected=torch.float64,
            got=system.robot.dtype,
            hint="convert the robot and the data, robot.to(dtype=torch.float64)",
        )


def is_finite(priors: Sequence[ForcePrior]) -> bool:
    """Whether all priors are a finite number of features, so that sparse inference is exact."""
    return all(prior.kernel.is_finite for prior in priors)


def is_sparse(inference: str, priors: Sequence[ForcePrior], samples: int) -> bool:
    """Whether inference is sparse: on request, for finite priors, and beyond `EXACT_SAMPLES`.

    Raises:
        ModelError: sparse inference is asked for, and a force is a function of time.
    """
    if any(prior.in_time for prior in priors):
        if inference == "sparse":
            raise ModelError(
                "sparse inference takes samples to be independent, which a function of time couples",
                expected="exact inference",
                got=", ".join(prior.name for prior in priors if prior.in_time),
                hint='use inference="exact" on evenly spaced rows (`forcegp select --method even`)',
            )
        return False
    return inference == "sparse" or (inference == "auto" and (is_finite(priors) or samples > EXACT_SAMPLES))


@torch.no_grad()
def with_inducing(problem: Problem, hyperparameters: Mapping[str, Tensor], limit: int = LIMIT) -> Problem:
    """The problem with inducing points chosen from its data by conditional variance.

    Args:
        problem: with the samples that are conditioned on.
        hyperparameters: of the priors.
        limit: maximum number of inducing points of one prior.
    """
    training = problem.training
    few = dataclasses.replace(problem, training=training.evenly(CANDIDATES))
    blocks = few.rows(hyperparameters).blocks
    chosen = select_inducing(
        problem.priors,
        kernel_parameters(hyperparameters),
        blocks,
        rows=round(sum(block.rows for block in blocks) * training.all_samples / few.training.samples),
        limit=limit,
    )
    return dataclasses.replace(problem, inducing=tuple(selection.points for selection in chosen))


def without_inducing(problem: Problem) -> Problem:
    """The problem for priors that are finite features, which need no inducing points."""
    block = dataclasses.replace(problem, training=problem.training.evenly(1)).fixed_rows.blocks[0]
    empty = tuple({name: x[:0] for name, x in features.items()} for features in block.features)
    return dataclasses.replace(problem, inducing=empty)


def force_posterior(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> ForcePosterior:
    """Forces conditioned on the data of a problem.

    Raises:
        NumericalError: the covariance of the data is not positive definite.
    """
    return forces_and_constant(problem, hyperparameters)[0]


@torch.no_grad()
def forces_and_constant(
    problem: Problem, hyperparameters: Mapping[str, Tensor]
) -> tuple[ForcePosterior, Tensor]:
    """Forces conditioned on the data of a problem, and the part of the likelihood that they do not change.

    Raises:
        ModelError: exact inference does not fit into memory.
        NumericalError: the covariance of the data is not positive definite.
    """
    if problem.inducing is not None:
        basis = basis_of(problem, hyperparameters)
        total = total_over(problem, hyperparameters, basis, problem.training.pieces(PIECE_SAMPLES))
        return posterior_of(problem, hyperparameters, basis, total), total.constant
    params, rows = kernel_parameters(hyperparameters), problem.rows(hyperparameters)
    require_exact_fits(rows.blocks, learning=False)
    # f | y ~ N(k Wᵀ Σ⁻¹ y, k − k Wᵀ Σ⁻¹ W k), Σ = W k Wᵀ + I (eqs. 22 to 24)
    latent = ExactPosterior.of(problem.priors, params, rows.blocks)
    return ForcePosterior(problem.process_at(hyperparameters), latent), rows.constant


def log_likelihood(posterior: ForcePosterior) -> float:
    """log p(y) of the rows without their constant, or its lower bound."""
    latent = posterior.latent
    if isinstance(latent, ExactPosterior):
        return float(latent.log_likelihood())
    assert isinstance(latent, SparsePosterior)
    return -float(bound_of(latent.sums, latent))


def lost_by_inducing(posterior: ForcePosterior) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Which inference a posterior has, and what a sparse one loses by its inducing points.

    Returns:
        The fields of `FitResult`, and a warning where the points miss much of what the data could tell.
    """
    if not isinstance(posterior.latent, SparsePosterior):
        return {"inference": "exact"}, ()
    diagnostics = posterior.latent.diagnostics
    warnings = (
        f"more inducing points would help: {diagnostics.size} basis functions miss a variance of "
        f"{diagnostics.missed:.3g} in units of the noise, where noise leaves {diagnostics.learned:.3g}; "
        "raise inducing_points",
    )
    return {
        "inference": "sparse",
        "basis_functions": diagnostics.size,
        "determined": diagnostics.learned,
        "missed": diagnostics.missed,
        "more_points_would_help": diagnostics.more_points_would_help,
    }, warnings if diagnostics.more_points_would_help else ()
