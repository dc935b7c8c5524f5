"""Measurements as rows with unit white noise, the noise-free constraint directions projected out.

Where q̈ is measured in contact, A q̈ = b leaves the part of q̈ in the range of Aᵀ without any unknown
force: it is prior mean plus white noise. With an orthonormal basis U of the null space of A (after
scaling by the noise), Uᵀ q̈ carries the whole Gaussian process, in nq − rank A rows a sample, and the
likelihood splits exactly into the two parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.quantities import AffineMap, affine_map
from forcegp.forces.states import States, states
from forcegp.gp.standardization import Standardization
from forcegp.gp.structured_covariance import Block
from forcegp.linalg import null_space_basis

VANISHING = 1e-12
"""Products of two operators below this fraction of their largest entries are zero in exact arithmetic."""

ForceMean = Callable[[ConstrainedSystem, States], Tensor]
"""Prior mean of the joint force Q at states, `(n, nq)`."""


@dataclass(frozen=True)
class Measurement:
    """Values of one quantity at states.

    Attributes:
        quantity: name, as in `QUANTITIES`.
        q, qd, tau: `(n, nq)` states.
        active: `(n, n_contacts)` bool.
        values: `(n, d)`.
    """

    quantity: str
    q: Tensor
    qd: Tensor
    tau: Tensor
    active: Tensor
    values: Tensor

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """q, q̇, τ, which contacts are closed, and the values."""
        return self.q, self.qd, self.tau, self.active, self.values

    def __getitem__(self, rows: Tensor) -> Measurement:
        """The values at some of the states."""
        return Measurement(self.quantity, *(part[rows] for part in self.tensors))


@dataclass(frozen=True)
class WhitenedRows:
    """The rows of all measurements, and the part of the likelihood that no latent force touches.

    Attributes:
        blocks: rows that the latent forces explain.
        constant: negative log likelihood of the rest, with the noise's normalisation.
    """

    blocks: list[Block]
    constant: Tensor


def prior_operators(
    priors: Sequence[ForcePrior], system: ConstrainedSystem, at: States, z: AffineMap
) -> list[Tensor]:
    """B(x) E(x) of each prior, from its components to the quantity, `(n, d, components)`.

    What is zero but for rounding (H Aᵀ) is made exactly zero, so that it costs nothing.
    """
    operators = []
    for prior in priors:
        B, E = z.B_z if prior.in_contact_only else z.B_Q, prior.operator(system, at)
        W = B @ E
        bound = VANISHING * B.abs().amax() * E.abs().amax() if W.numel() else 0.0
        operators.append(torch.where(W.abs().amax() > bound, W, 0.0) if W.numel() else W)
    return operators


def prior_mean(system: ConstrainedSystem, at: States, z: AffineMap, mean: ForceMean) -> Tensor:
    """o(x) + B(x) m(x), `(n, d)`."""
    return z.o + (z.B_Q @ mean(system, at)[..., None])[..., 0]


def _split(A: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """Null-space basis of A, and A⁺, both with the rank that the equations of motion count.

    Of nearly redundant rows, A⁺ with another rank would magnify what they contradict each other.
    """
    if rank == A.shape[-2]:
        return null_space_basis(A, rank), torch.linalg.pinv(A)
    # Fixed combinations of rows have the solutions, and so the derivative, of all rows that are consistent.
    W = torch.linalg.svd(A.detach(), full_matrices=False).U[..., :rank]
    rows = W.mT @ A
    return null_space_basis(rows, rank), torch.linalg.pinv(rows) @ W.mT


def whiten(
    system: ConstrainedSystem,
    priors: Sequence[ForcePrior],
    scales: Sequence[Standardization],
    mean: ForceMean,
    measurement: Measurement,
    noise_std: Tensor,
) -> WhitenedRows:
    """Rows of one measurement, divided by its noise, without noise-free directions.

    Args:
        system: robot and contacts.
        priors, scales: the force priors and the standardization of their inputs.
        mean: prior mean of Q.
        measurement: what was measured.
        noise_std: `(d,)` standard deviation of each component.
    """
    at = states(system, measurement.q, measurement.qd, measurement.tau, measurement.active)
    z = affine_map(system, at, measurement.quantity)
    residual = (measurement.values - prior_mean(system, at, z, mean)) / noise_std
    operators = [W / noise_std[:, None] for W in prior_operators(priors, system, at, z)]
    features = [scale.apply(prior.features(system, at)) for prior, scale in zip(priors, scales, strict=True)]
    constant = len(residual) * noise_std.log().sum()
    if measurement.quantity != "qdd" or system.m == 0:
        return WhitenedRows([Block(tuple(features), tuple(operators), residual)], constant)
    A = at.eom.A * noise_std
    blocks = []
    rank = at.eom.rank
    for value in rank.unique().tolist():
        own = (rank == value).nonzero()[:, 0]
        U, pinv = _split(A[own], value)
        violated = ((at.eom.A[own] @ measurement.values[own][..., None])[..., 0] - at.eom.b[own])[..., None]
        constant = (
            constant + 0.5 * ((pinv @ violated) ** 2).sum() + 0.5 * value * len(own) * math.log(2 * math.pi)
        )
        blocks.append(
            Block(
                tuple({name: x[own] for name, x in f.items()} for f in features),
                tuple(U.mT @ W[own] for W in operators),
                (U.mT @ residual[own][..., None])[..., 0],
            )
        )
    return WhitenedRows(blocks, constant)


def combine(rows: Sequence[WhitenedRows]) -> WhitenedRows:
    """The rows of several measurements together."""
    constant = torch.stack([r.constant for r in rows]).sum()
    return WhitenedRows([block for r in rows for block in r.blocks], constant)
