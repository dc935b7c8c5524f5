"""Measurements as rows with unit white noise, with the directions fixed by the constraint projected out. If
q̈ is measured in contact, A q̈ = b fixes the part of q̈ in the range of Aᵀ: it is prior mean plus white
noise. With an orthonormal basis U of the null space of A (after scaling by the noise), Uᵀ q̈ carries the
whole Gaussian process in nq − rank A rows per sample, and the likelihood splits exactly into the two parts.

Noise of the motor torque is white noise on the joint force. It affects a sample's rows through the same
operator as the force, so they have the covariance I + N Nᵀ with N = B Σ_τ½, whose Cholesky factor whitens
them sample by sample. Noise of the state affects them, to first order, through the Jacobian of the measured
quantity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, Equations
from forcegp.forces.measurements import Measurement
from forcegp.forces.noise import SampleNoise
from forcegp.forces.posterior import ForceProcess
from forcegp.forces.quantities import affine_map
from forcegp.gp.features import Block, Features


@dataclass(frozen=True, eq=False)
class WhitenedRows:
    """The rows of all measurements, and the part of the likelihood independent of the latent forces.

    Attributes:
        blocks: rows that the latent forces explain.
        rest: computes the negative log likelihood of everything else; not needed for an update.
    """

    blocks: list[Block]
    rest: Callable[[], Tensor]

    @cached_property
    def constant(self) -> Tensor:
        """Negative log likelihood of the rest, with the normalisation of the noise `()`."""
        return self.rest()

    def tempered(self, power: float) -> WhitenedRows:
        """The rows of the likelihood to a power κ: noise variances over κ, normalisations times κ.

        With noise correlated over τ samples, n samples carry the evidence of n/τ; κ = 1/τ accounts for it.
        """
        if power == 1.0:
            return self
        # Noise Σ/κ: √κ W, √κ y
        root = math.sqrt(power)
        blocks = [
            Block(b.features, tuple(root * W for W in b.operators), root * b.target) for b in self.blocks
        ]
        return WhitenedRows(blocks, lambda: power * self.constant)


class _NullSpaceBasis(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, A: Tensor, rank: int) -> Tensor:
        # A = X Λ Vᵀ; the last columns of V span the null space of A
        X, values, Vh = torch.linalg.svd(A, full_matrices=True)
        ctx.save_for_backward(X[..., :rank], values[..., :rank], Vh)
        return Vh[..., rank:, :].mT

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None]:
        X, values, Vh = ctx.saved_tensors
        rank = values.shape[-1]
        # A⁺ = V Λ⁻¹ Xᵀ, without a tolerance, as the rank is given
        pinv = (Vh[..., :rank, :].mT / values[..., None, :]) @ X.mT
        # dU = −A⁺ dA U, so ∂F/∂A = −A⁺ᵀ ∂F/∂U Uᵀ
        return -(pinv.mT @ grad[0]) @ Vh[..., rank:, :], None


def null_space_basis(A: Tensor, rank: int) -> Tensor:
    """Orthonormal basis U of the null space of matrices of equal rank, A U = 0, UᵀU = I.

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


def _independent(A: Tensor, rank: int) -> tuple[Tensor, Tensor | None]:
    """As many rows as the rank that the equations of motion count, and the combinations C that they are of
    those of A; `None` for all of them.

    With another rank, A⁺ would magnify the contradictions of nearly redundant rows. Fixed combinations of
    rows have the solutions, and so the derivative, of all rows that are consistent.
    """
    if rank == A.shape[-2]:
        return A, None
    C = torch.linalg.svd(A.detach(), full_matrices=False).U[..., :rank].mT
    return C @ A, C


def _by_rank(rank: Tensor) -> list[tuple[int, Tensor | slice]]:
    """The samples of each rank; one slice of all of them where they share it, of which no copy is made."""
    if not len(rank):
        return []
    low, high = (int(value) for value in rank.aminmax())
    if low == high:
        return [(low, slice(None))]
    groups = ((value, (rank == value).nonzero()[:, 0]) for value in range(low, high + 1))
    return [(value, index) for value, index in groups if len(index)]


@dataclass(frozen=True)
class _Rows:
    """Samples with a common number of rows.

    Attributes:
        features: kernel inputs of each prior.
        widths: number of columns of each operator.
        rows: the operators, the residual, and the factor N of the noise, side by side `(n, r, ·)`; the noise
            of the rows has the covariance 1 + N Nᵀ.
    """

    features: tuple[Features, ...]
    widths: tuple[int, ...]
    rows: Tensor

    def of(self, index: Tensor | slice, U: Tensor) -> _Rows:
        """Uᵀ times the rows of some samples, or of all of them where `own` is a slice."""
        if isinstance(index, slice):
            return _Rows(self.features, self.widths, U.mT @ self.rows)
        features = tuple({name: x[index] for name, x in f.items()} for f in self.features)
        return _Rows(features, self.widths, U.mT @ self.rows[index])

    def whitened(self, weight: Tensor | None) -> tuple[Block, Tensor]:
        """The rows divided by the factor of I + N Nᵀ, and the log determinant of the factors.

        Weighted samples have another noise variance.
        """
        signal = sum(self.widths) + 1
        rows, N = self.rows.tensor_split([signal], dim=-1)
        log_determinant = rows.new_zeros(())
        if N.shape[-1]:
            # I + N Nᵀ = C Cᵀ, by QR of (I, N)ᵀ instead of Cholesky: noise of 0.05 N m at a wrist of
            # 10⁻³ kg m² is 50 rad/s², and squares of such ratios lose all digits.
            eye = torch.eye(N.shape[1], dtype=N.dtype, device=N.device).expand(len(N), -1, -1)
            C = torch.linalg.qr(torch.cat([eye, N.mT], dim=1)).R.mT
            # C⁻¹ (W, y), ½ log|I + N Nᵀ| = Σ log |C_ii|
            rows = torch.linalg.solve_triangular(C, rows, upper=False)
            log_determinant = C.diagonal(dim1=-2, dim2=-1).abs().log().sum()
        if weight is not None:
            # Noise Σ/w: √w (W, y)
            rows = weight.sqrt()[:, None, None] * rows
        *operators, residual = rows.split([*self.widths, 1], dim=-1)
        return Block(self.features, tuple(operators), residual[..., 0]), log_determinant


def whiten(
    system: ConstrainedSystem, process: ForceProcess, measurement: Measurement, noise: SampleNoise
) -> WhitenedRows:
    """Rows of one measurement with unit white noise, without noise-free directions."""
    # z = B_Q Q + B_z Q_z + o (eqs. 19 and 20)
    at, std = measurement.at(system), noise.std.expand_as(measurement.values)
    z = process.coupled(system, at, affine_map(system, at, measurement.quantity))
    # W = B E and E[z] = o + B m, with the prior means of latent forces (eqs. 12 and 15)
    rows = process.rows(system, at, z)
    expected = rows.target
    for p, value in process.pinned.items():
        expected = expected - rows.operators[p] @ value
    # (W, y − E[z], N)/σ
    everything = _Rows(
        rows.features,
        tuple(W.shape[-1] for W in rows.operators),
        torch.cat(
            [*rows.operators, (measurement.values - expected)[..., None], *noise.factors(at, z)], dim=-1
        )
        / std[..., None],
    )
    # Noise of the state reaches the directions that the constraint fixes too, so their rows contain it.
    if measurement.quantity == "qdd" and system.m > 0 and noise.state is None:
        return _without_fixed(everything, at.eom, measurement.values, std, noise.weight)
    block, log_determinant = everything.whitened(noise.weight)
    return WhitenedRows([block], lambda: log_determinant + _log_scale(std, noise.weight))


def _without_fixed(
    everything: _Rows, eom: Equations, values: Tensor, std: Tensor, weight: Tensor | None
) -> WhitenedRows:
    """The rows of q̈ along the null space of A; the directions that A q̈ = b fixes go into the constant."""
    # (A σ) U = 0, rows Uᵀ (W, y, N)
    A, b = eom.A, eom.b
    scaled, groups, blocks, log_determinants = A * std[:, None, :], _by_rank(eom.rank), [], []
    for rank, index in groups:
        U = null_space_basis(_independent(scaled[index], rank)[0], rank)
        block, log_determinant = everything.of(index, U).whitened(None if weight is None else weight[index])
        blocks.append(block)
        log_determinants.append(log_determinant)

    def constant() -> Tensor:
        # What this function keeps alive is small beside the equations of motion.
        violated = (A @ values[..., None])[..., 0] - b
        weights = torch.ones_like(violated[:, 0]) if weight is None else weight
        fixed = [_fixed(scaled[index], rank, violated[index], weights[index]) for rank, index in groups]
        return sum([*log_determinants, *fixed], start=_log_scale(std, weight))

    return WhitenedRows(blocks, constant)


def _log_scale(std: Tensor, weight: Tensor | None) -> Tensor:
    """Logarithm of all standard deviations together, of weighted samples `()`."""
    total = std.log().sum()
    return total if weight is None else total - 0.5 * std.shape[-1] * weight.log().sum()


def _fixed(A: Tensor, rank: int, violated: Tensor, weight: Tensor) -> Tensor:
    """Negative log likelihood of the directions that the constraint fixes `()`, where A q̈ − b is
    violated."""
    # ½ w |(A σ)⁺ (A q̈ − b)|² + ½ rank A log 2π
    rows, C = _independent(A, rank)
    pinv = torch.linalg.pinv(rows) if C is None else torch.linalg.pinv(rows) @ C
    squares = ((pinv @ violated[..., None]) ** 2)[..., 0].sum(-1)
    return 0.5 * (weight * squares).sum() + 0.5 * rank * len(A) * math.log(2 * math.pi)


def combine(rows: Sequence[WhitenedRows]) -> WhitenedRows:
    """The rows of several measurements together."""
    blocks = [block for r in rows for block in r.blocks]
    return WhitenedRows(blocks, lambda: torch.stack([r.constant for r in rows]).sum())
