"""Measurements as rows with unit white noise, after projecting out the directions fixed by the constraint.

If q̈ is measured in contact, A q̈ = b determines the part of q̈ in the range of Aᵀ up to white noise. Let U
be an orthonormal basis of the null space of A, after scaling by the noise. Then the nq − rank A rows Uᵀ q̈ of
a sample contain the whole Gaussian process, and the likelihood splits exactly into the two parts.

Motor torque noise is white noise on the joint force. It affects the rows of a sample through the same
operator as the force, so the rows have noise of covariance I + N Nᵀ with N = B Σ_τ½, whose Cholesky factor
whitens them. To first order, state noise affects the rows through the Jacobian of the measured quantity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
    """Rows of all measurements, and the part of the likelihood that is independent of the latent forces.

    Attributes:
        blocks: rows that depend on the latent forces.
        rest: function that returns the negative log likelihood of the remainder; updates do not call it.
    """

    blocks: list[Block]
    rest: Callable[[], Tensor]

    @cached_property
    def constant(self) -> Tensor:
        """Negative log likelihood `()` of the remainder, including the normalisation of the noise."""
        return self.rest()

    def tempered(self, power: float) -> WhitenedRows:
        """Return the rows for the likelihood raised to the power κ.

        Noise variances are divided by κ, and normalisations are multiplied by κ. If noise is correlated over
        τ samples, n samples contain as much information as n/τ independent samples, so κ = 1/τ.
        """
        if power == 1.0:
            return self
        # Noise Σ/κ: √κ W, √κ y
        root = math.sqrt(power)
        blocks = [block.mapped(lambda rows: root * rows) for block in self.blocks]
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
    """Return an orthonormal basis U of the null space of matrices of equal rank, A U = 0, UᵀU = I.

    The basis is unique only up to a rotation U R, so only functions that do not depend on R have a
    derivative. For these functions, dU = −A⁺ dA U.

    Args:
        A: `(*batch, m, n)`.
        rank: common rank of the matrices.

    Returns:
        `(*batch, n, n − rank)`.
    """
    if A.shape[-2] == 0 or rank == 0:
        eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
        return eye.expand(*A.shape[:-2], *eye.shape)
    return _NullSpaceBasis.apply(A, rank)  # pyright: ignore[reportReturnType]


def _independent(A: Tensor, rank: int) -> tuple[Tensor, Tensor | None]:
    """Return `rank` independent rows C A, and C; return A and `None` if all rows are independent.

    The rank is that used in the equations of motion. A larger rank would let A⁺ amplify contradictions
    between nearly redundant rows. Fixed combinations of consistent rows have the same solutions as all rows,
    and therefore the same derivatives.
    """
    if rank == A.shape[-2]:
        return A, None
    C = torch.linalg.svd(A.detach(), full_matrices=False).U[..., :rank].mT
    return C @ A, C


def _by_rank(rank: Tensor) -> list[tuple[int, Tensor | slice]]:
    """Return the samples of each rank; a slice if all ranks are equal, since it avoids a copy."""
    if not len(rank):
        return []
    low, high = (int(value) for value in rank.aminmax())
    if low == high:
        return [(low, slice(None))]
    groups = ((value, (rank == value).nonzero()[:, 0]) for value in range(low, high + 1))
    return [(value, index) for value, index in groups if len(index)]


@dataclass(frozen=True)
class _Rows:
    """Samples with the same number of rows.

    Attributes:
        features: kernel inputs of each prior.
        places: place of the operator of each prior among the different operators.
        widths: number of columns of each of these.
        rows: operators, residual, and noise factor N for noise of covariance I + N Nᵀ `(n, r, ·)`.
    """

    features: tuple[Features, ...]
    places: tuple[int, ...]
    widths: tuple[int, ...]
    rows: Tensor

    def of(self, index: Tensor | slice, U: Tensor) -> _Rows:
        """Multiply Uᵀ by the rows of the given samples (of all samples if `index` is a slice)."""
        if isinstance(index, slice):
            return replace(self, rows=U.mT @ self.rows)
        features = tuple({name: x[index] for name, x in f.items()} for f in self.features)
        return replace(self, features=features, rows=U.mT @ self.rows[index])

    def whitened(self, weight: Tensor | None) -> tuple[Block, Tensor]:
        """Divide the rows by the factor of I + N Nᵀ, and return them with the log determinant of the factors.

        The noise variance of a sample is divided by its weight.
        """
        signal = sum(self.widths) + 1
        rows, N = self.rows.tensor_split([signal], dim=-1)
        log_determinant = rows.new_zeros(())
        if N.shape[-1]:
            # I + N Nᵀ = C Cᵀ, by QR of (I, N)ᵀ instead of Cholesky: noise of 0.05 N m at a wrist with an
            # inertia of 10⁻³ kg m² is 50 rad/s², and squaring such ratios loses all digits.
            eye = torch.eye(N.shape[1], dtype=N.dtype, device=N.device).expand(len(N), -1, -1)
            C = torch.linalg.qr(torch.cat([eye, N.mT], dim=1)).R.mT
            # C⁻¹ (W, y), ½ log|I + N Nᵀ| = Σ log |C_ii|
            rows = torch.linalg.solve_triangular(C, rows, upper=False)
            log_determinant = C.diagonal(dim1=-2, dim2=-1).abs().log().sum()
        if weight is not None:
            # Noise Σ/w: √w (W, y)
            rows = weight.sqrt()[:, None, None] * rows
        *operators, residual = rows.split([*self.widths, 1], dim=-1)
        each = tuple(operators[place] for place in self.places)
        return Block(self.features, each, residual[..., 0]), log_determinant


def whiten(
    system: ConstrainedSystem, process: ForceProcess, measurement: Measurement, noise: SampleNoise
) -> WhitenedRows:
    """Return the rows of one measurement with unit white noise, excluding directions fixed by A q̈ = b."""
    # z = B_Q Q + B_z Q_z + o (eqs. 19 and 20)
    at, std = measurement.at(system), noise.std.expand_as(measurement.values)
    z = process.coupled(system, at, affine_map(system, at, measurement.quantity))
    # W = B E and E[z] = o + B m (eqs. 12 and 15)
    rows = process.rows(system, at, z)
    # (W, y − E[z], N)/σ
    operators, places = _different(rows.operators)
    parts = [*operators, (measurement.values - rows.target)[..., None], *noise.factors(at, z)]
    widths = tuple(W.shape[-1] for W in operators)
    everything = _Rows(rows.features, places, widths, torch.cat(parts, dim=-1) / std[..., None])
    # State noise also affects the directions fixed by the constraint, so these are not projected out.
    if measurement.quantity == "qdd" and system.m > 0 and noise.state is None:
        return _without_fixed(everything, at.eom, measurement.values, std, noise.weight)
    block, log_determinant = everything.whitened(noise.weight)
    return WhitenedRows([block], lambda: log_determinant + _log_scale(std, noise.weight))


def _different(operators: Sequence[Tensor]) -> tuple[list[Tensor], tuple[int, ...]]:
    """Return the operators that differ, and the place of each operator among them."""
    different: list[Tensor] = []
    places: list[int] = []
    for W in operators:
        equal = (k for k, other in enumerate(different) if other is W or torch.equal(other, W))
        places.append(next(equal, len(different)))
        if places[-1] == len(different):
            different.append(W)
    return different, tuple(places)


def _without_fixed(
    everything: _Rows, eom: Equations, values: Tensor, std: Tensor, weight: Tensor | None
) -> WhitenedRows:
    """Return the rows of q̈ in the null space of A; directions fixed by A q̈ = b enter the constant."""
    # (A σ) U = 0, rows Uᵀ (W, y, N)
    A, b = eom.A, eom.b
    scaled, groups, blocks, log_determinants = A * std[:, None, :], _by_rank(eom.rank), [], []
    for rank, index in groups:
        U = null_space_basis(_independent(scaled[index], rank)[0], rank)
        block, log_determinant = everything.of(index, U).whitened(None if weight is None else weight[index])
        blocks.append(block)
        log_determinants.append(log_determinant)

    def constant() -> Tensor:
        # The tensors kept alive by this closure are small compared with the equations of motion.
        violated = (A @ values[..., None])[..., 0] - b
        weights = torch.ones_like(violated[:, 0]) if weight is None else weight
        fixed = [_fixed(scaled[index], rank, violated[index], weights[index]) for rank, index in groups]
        return sum([*log_determinants, *fixed], start=_log_scale(std, weight))

    return WhitenedRows(blocks, constant)


def _log_scale(std: Tensor, weight: Tensor | None) -> Tensor:
    """Return the sum `()` of the log standard deviations of all samples, including their weights."""
    total = std.log().sum()
    return total if weight is None else total - 0.5 * std.shape[-1] * weight.log().sum()


def _fixed(A: Tensor, rank: int, violated: Tensor, weight: Tensor) -> Tensor:
    """Return the negative log likelihood `()` of the constraint violation A q̈ − b."""
    # ½ w |(A σ)⁺ (A q̈ − b)|² + ½ rank A log 2π
    rows, C = _independent(A, rank)
    pinv = torch.linalg.pinv(rows) if C is None else torch.linalg.pinv(rows) @ C
    squares = ((pinv @ violated[..., None]) ** 2)[..., 0].sum(-1)
    return 0.5 * (weight * squares).sum() + 0.5 * rank * len(A) * math.log(2 * math.pi)


def combine(rows: Sequence[WhitenedRows]) -> WhitenedRows:
    """Combine the rows of several measurements."""
    blocks = [block for r in rows for block in r.blocks]
    return WhitenedRows(blocks, lambda: torch.stack([r.constant for r in rows]).sum())
