"""Sparse conditioning piece by piece: the sums over samples, and the posterior that they give."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.forces.learn import Problem, kernel_parameters
from forcegp.forces.measurements import Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.gp.basis import LatentBasis, latent_basis
from forcegp.gp.distributed import add_over_processes, reduce_sums
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import Sums, accumulate

PIECE_SAMPLES = 8192
"""Samples whose equations of motion are held at a time."""


@dataclass(frozen=True, eq=False)
class Totals:
    """What sparse conditioning keeps of the pieces that it has seen.

    Attributes:
        sums: over the whitened rows.
        central: the same where forces that the robot contains are known to be zero; `None` without any.
        constant: part of the negative log likelihood that no latent force changes `()`.
        samples: number of samples `()`.
        pieces: how many pieces.
    """

    sums: Sums
    central: Sums | None
    constant: Tensor
    samples: Tensor
    pieces: int

    @classmethod
    def zero(cls, problem: Problem, basis: LatentBasis) -> Totals:
        """Of no samples."""
        like = next(iter(basis.params.values()))
        central = Sums.zero(basis, like) if problem.pinned else None
        return cls(Sums.zero(basis, like), central, like.new_zeros(()), like.new_zeros(()), 0)

    def over_processes(self) -> Totals:
        """The totals of all processes of `torch.distributed` added, the same in each of them."""
        central = None if self.central is None else reduce_sums(self.central)
        constant, samples = add_over_processes(torch.stack([self.constant, self.samples])).unbind()
        return Totals(reduce_sums(self.sums), central, constant, samples, self.pieces)


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
        own = dataclasses.replace(problem, training=piece)
        rows, central = own.rows(hyperparameters), total.central
        if central is not None:
            known = own.silenced(own.of_means().rows(hyperparameters).blocks)
            central = central + accumulate(basis, known)
        total = Totals(
            total.sums + accumulate(basis, rows.blocks),
            central,
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
    latent = SparsePosterior.of(basis, total.sums)
    latent.require_resolved()
    central = None if total.central is None else SparsePosterior.of(basis, total.central)
    scales, coulomb = problem.training.scales, problem.coulomb(hyperparameters)
    priors = problem.priors_at(hyperparameters)
    return ForcePosterior(priors, scales, problem.mean, latent, central, coulomb)
