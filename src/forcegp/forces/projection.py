"""Measurements as rows with unit white noise, with the directions that the constraint fixes projected out.

Where q̈ is measured in contact, A q̈ = b fixes the part of q̈ in the range of Aᵀ: it is prior mean plus white
noise. With an orthonormal basis U of the null space of A (after scaling by the noise), Uᵀ q̈ carries the
whole Gaussian process in nq − rank A rows per sample, and the likelihood splits exactly into the two parts.

Noise of the motor torque is white noise on the joint force. It reaches a sample's rows through the same
operator as the force, so they have the covariance I + N Nᵀ with N = B Σ_τ½, whose Cholesky factor whitens
them sample by sample. Noise of the state reaches them, to first order, through the Jacobian of the measured
quantity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, coupled
from forcegp.forces.measurements import Measurement
from forcegp.forces.priors.base import ForceMean, ForcePrior, prior_rows
from forcegp.forces.quantities import AffineMap, States, affine_map
from forcegp.forces.state_noise import state_jacobian
from forcegp.gp.features import Features, Standardization
from forcegp.gp.structured_covariance import Block

ForceNoise = Callable[[States], Tensor]
"""Variance of the white noise on the joint force at states, `(n, nq)`."""


@dataclass(frozen=True)
class WhitenedRows:
    """The rows of all measurements, and the part of the likelihood that no latent force changes.

    Attributes:
        blocks: rows that the latent forces explain.
        constant: negative log likelihood of the rest, with the normalisation of the noise.
    """

    blocks: list[Block]
    constant: Tensor

    def tempered(self, power: float) -> WhitenedRows:
        """The rows of the likelihood to a power κ: noise variances over κ, normalisations times κ.

        Noise that is correlated over τ samples makes n of them worth n/τ; κ = 1/τ accounts for it.
        """
        if power == 1.0:
            return self
        root = math.sqrt(power)
        blocks = [
            Block(b.features, tuple(root * W for W in b.operators), root * b.target) for b in self.blocks
        ]
        return WhitenedRows(blocks, power * self.constant)


class _NullSpaceBasis(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, A: Tensor, rank: int) -> Tensor:
        left, values, Vh = torch.linalg.svd(A, full_matrices=True)
        U = Vh.mT[..., :, rank:].contiguous()
        # The rank is given, so the pseudo-inverse needs no tolerance of its own.
        pinv = (Vh.mT[..., :, :rank] / values[..., None, :rank]) @ left[..., :, :rank].mT
        ctx.save_for_backward(pinv, U)
        return U

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None]:
        pinv, U = ctx.saved_tensors
        return -(pinv.mT @ grad[0]) @ U.mT, None


def null_space_basis(A: Tensor, rank: int) -> Tensor:
    """Orthonormal basis U of the null space of matrices that share a rank, A U = 0, UᵀU = I.

    The basis is defined up to a rotation U R, so only functions that do not depend on R have a
    derivative; for these dU = −A⁺ dA U.

    Args:
        A: `(*batch, m, n)`.
        rank: the rank of every matrix of the batch.

    Returns:
        `(*batch, n, n − rank)`.
    """
    if A.shape[-2] == 0 or rank == 0:
        eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
        return eye.expand(*A.shape[:-2], *eye.shape)
    return _NullSpaceBasis.apply(A, rank)  # pyright: ignore[reportReturnType]


def _split(A: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """Null-space basis of A, and A⁺, both with the rank that the equations of motion count.

    With another rank, A⁺ would magnify the contradictions of nearly redundant rows.
    """
    if rank == A.shape[-2]:
        return null_space_basis(A, rank), torch.linalg.pinv(A)
    # Fixed combinations of rows have the solutions, and so the derivative, of all rows that are consistent.
    W = torch.linalg.svd(A.detach(), full_matrices=False).U[..., :rank]
    rows = W.mT @ A
    return null_space_basis(rows, rank), torch.linalg.pinv(rows) @ W.mT


@dataclass(frozen=True)
class _Rows:
    """Samples with a common number of rows: residual `(n, r)`, operators `(n, r, ·)`, and the factor N of
    the noise `(n, r, k)`, whose covariance is 1 + N Nᵀ; `None` for white noise alone."""

    features: tuple[Features, ...]
    operators: tuple[Tensor, ...]
    residual: Tensor
    noise: Tensor | None

    def of(self, own: Tensor, U: Tensor) -> _Rows:
        """Uᵀ times the rows of some samples."""
        return _Rows(
            tuple({name: x[own] for name, x in f.items()} for f in self.features),
            tuple(U.mT @ W[own] for W in self.operators),
            (U.mT @ self.residual[own][..., None])[..., 0],
            None if self.noise is None else U.mT @ self.noise[own],
        )

    def whitened(self) -> tuple[Block, Tensor]:
        """The rows divided by the factor of I + N Nᵀ, and the log determinant of the factors."""
        if self.noise is None:
            return Block(self.features, self.operators, self.residual), self.residual.new_zeros(())
        # QR of (1, N)ᵀ instead of Cholesky of 1 + N Nᵀ: noise of 0.05 N m at a wrist of 10⁻³ kg m² is
        # 50 rad/s², and squares of such ratios lose all digits.
        N = self.noise
        eye = torch.eye(N.shape[1], dtype=N.dtype, device=N.device).expand(len(N), -1, -1)
        C = torch.linalg.qr(torch.cat([eye, N.mT], dim=1)).R.mT
        operators = tuple(torch.linalg.solve_triangular(C, W, upper=False) for W in self.operators)
        residual = torch.linalg.solve_triangular(C, self.residual[..., None], upper=False)[..., 0]
        log_determinant = C.diagonal(dim1=-2, dim2=-1).abs().log().sum()
        return Block(self.features, operators, residual), log_determinant


def whiten(
    system: ConstrainedSystem,
    priors: Sequence[ForcePrior],
    scales: Sequence[Standardization],
    mean: ForceMean,
    measurement: Measurement,
    noise_std: Tensor,
    force_noise: ForceNoise | None = None,
    offsets: Mapping[str, Tensor] | None = None,
    coulomb: Sequence[CoulombFriction] = (),
    state_std: Tensor | None = None,
    weight: Tensor | None = None,
) -> WhitenedRows:
    """Rows of one measurement with unit white noise, without noise-free directions.

    Args:
        system: robot and contacts.
        priors, scales: the force priors and the standardization of their inputs.
        mean: prior mean of Q.
        measurement: what was measured.
        noise_std: `(d,)` or `(n, d)` standard deviation of each component.
        force_noise: variance of the white noise on the joint force.
        offsets: prior means of latent forces `(components,)`, by prior; zero where not named.
        coulomb: friction of contacts that is proportional to the multiplier.
        state_std: `(2 nq,)` standard deviation of the noise of q and q̇.
        weight: `(n,)` of each sample, which the variance of all its noise is divided by.
    """
    at = measurement.at(system)
    z = affine_map(system, at, measurement.quantity)
    if coulomb:
        z = coupled(system, at, z, coulomb)
    # Noise of the state reaches the directions that the constraint fixes too, so their rows tell of it.
    has_fixed = measurement.quantity == "qdd" and system.m > 0 and state_std is None
    rank = at.eom.rank if has_fixed else None
    std = noise_std.expand_as(measurement.values)
    rows = prior_rows(priors, scales, mean, system, at, z)
    expected = rows.target
    for prior, W in zip(priors, rows.operators, strict=True):
        if offsets and prior.name in offsets:
            expected = expected + W @ offsets[prior.name]
    everything = _Rows(
        rows.features,
        tuple(W / std[..., None] for W in rows.operators),
        (measurement.values - expected) / std,
        _noise_factor(system, at, measurement, z, force_noise, state_std, std),
    )
    constant = std.log().sum()
    if weight is not None:
        constant = constant - 0.5 * std.shape[-1] * weight.log().sum()
    if rank is None:
        block, log_det = everything.whitened()
        return WhitenedRows([_weighted(block, weight)], constant + log_det)
    A = at.eom.A * std[:, None, :]
    violated = (at.eom.A @ measurement.values[..., None])[..., 0] - at.eom.b
    blocks = []
    for value in rank.unique().tolist():
        own = (rank == value).nonzero()[:, 0]
        U, pinv = _split(A[own], value)
        block, log_det = everything.of(own, U).whitened()
        squares = ((pinv @ violated[own][..., None]) ** 2)[..., 0].sum(-1)
        fixed = 0.5 * (squares if weight is None else weight[own] * squares).sum()
        constant = constant + fixed + log_det + 0.5 * value * len(own) * math.log(2 * math.pi)
        blocks.append(_weighted(block, None if weight is None else weight[own]))
    return WhitenedRows(blocks, constant)


def _weighted(block: Block, weight: Tensor | None) -> Block:
    """The rows of samples with noise of less or more than unit variance, in units of it."""
    if weight is None:
        return block
    root = weight.sqrt()
    operators = tuple(root[:, None, None] * W for W in block.operators)
    return Block(block.features, operators, root[:, None] * block.target)


def _noise_factor(
    system: ConstrainedSystem,
    at: States,
    measurement: Measurement,
    z: AffineMap,
    force_noise: ForceNoise | None,
    state_std: Tensor | None,
    std: Tensor,
) -> Tensor | None:
    """N `(n, d, k)` of noise beside that of the sensor, in units of the latter; `None` for none."""
    parts = []
    if force_noise is not None:
        parts.append(z.B_Q * force_noise(at).sqrt()[:, None, :])
    if state_std is not None and (G := state_jacobian(system, measurement)) is not None:
        parts.append(G * state_std)
    return torch.cat(parts, dim=-1) / std[..., None] if parts else None


def combine(rows: Sequence[WhitenedRows]) -> WhitenedRows:
    """The rows of several measurements together."""
    constant = torch.stack([r.constant for r in rows]).sum()
    return WhitenedRows([block for r in rows for block in r.blocks], constant)
