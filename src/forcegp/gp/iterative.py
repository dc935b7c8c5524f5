"""Exact inference without the covariance matrix: products in blocks and preconditioned conjugate gradients.

(K + I) α = y is solved with the sparse model as preconditioner, ΦΦᵀ + D with D = I + W(k − VᵀV)Wᵀ block by
block, to check a sparse posterior against the exact one where no factorisation fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError
from forcegp.gp.basis import LatentBasis
from forcegp.gp.factor import cholesky
from forcegp.gp.kernels import Parameters, sub
from forcegp.gp.likelihood import target_of
from forcegp.gp.structured_covariance import Block, Process, cross_gram, offsets
from forcegp.gp.sums import Sums, add_rows

CHUNK_SAMPLES = 256
"""Samples between which and all others the covariance is held at a time."""


@dataclass(frozen=True)
class Solution:
    """An approximate solution of (K + I) x = y.

    Attributes:
        x: `(rows, columns)`.
        residual: y − (K + I) x `(rows, columns)`.
        iterations: how many products with K it took.
        history: largest ‖residual‖/‖y‖ after each.
    """

    x: Tensor
    residual: Tensor
    iterations: int
    history: list[float]


def product(processes: Sequence[Process], params: Parameters, blocks: Sequence[Block], x: Tensor) -> Tensor:
    """(K + I) x for the covariance K of all rows, which is never held.

    Args:
        processes, params, blocks: as given to `gram`.
        x: `(rows, columns)`.
    """
    starts = offsets(blocks)
    result = x.clone()
    for p, prior in enumerate(processes):
        own = sub(params, prior.prefix)
        latent = []
        for g, block in enumerate(blocks):
            rows = x[starts[g] : starts[g + 1]].unflatten(0, tuple(block.target.shape))
            latent.append(torch.einsum("nrk,nrc->knc", block.operators[p], rows))
        towards = [prior.kernel.towards(own, block.features[p]) for block in blocks]
        for g, block in enumerate(blocks):
            for first in range(0, len(block.target), CHUNK_SAMPLES):
                part = slice(first, first + CHUNK_SAMPLES)
                features = {name: f[part] for name, f in block.features[p].items()}
                terms = [k(features) @ z for k, z in zip(towards, latent, strict=True)]
                f = sum(terms[1:], start=terms[0])
                rows = torch.einsum("nrk,knc->nrc", block.operators[p][part], f).flatten(0, 1)
                at = starts[g] + first * block.target.shape[1]
                result[at : at + len(rows)] += rows
    return result


class SparsePreconditioner:
    """(ΦΦᵀ + D)⁻¹ with the rows Φ of the basis and D what each sample's own rows vary beyond it."""

    def __init__(self, basis: LatentBasis, blocks: Sequence[Block]) -> None:
        _, Phi = add_rows(basis, Sums.zero(basis, blocks[0].target), blocks)
        self.shapes = [tuple(block.target.shape) for block in blocks]
        self.factors = []
        for block in blocks:
            _, _, missed = basis.evaluate(block.features)
            W = torch.cat(block.operators, dim=-1)
            eye = torch.eye(W.shape[1], dtype=W.dtype, device=W.device)
            self.factors.append(torch.linalg.cholesky(eye + (W * missed.clamp(min=0.0)[:, None]) @ W.mT))
        self.Phi = self._whitened(Phi)
        A = self.Phi.mT @ self.Phi
        self.L, _ = cholesky(A + torch.eye(len(A), dtype=A.dtype, device=A.device))

    def _by_sample(self, x: Tensor, transpose: bool) -> Tensor:
        parts, first = [], 0
        for shape, L in zip(self.shapes, self.factors, strict=True):
            own = x[first : first + shape[0] * shape[1]].unflatten(0, shape)
            first += shape[0] * shape[1]
            factor = L.mT if transpose else L
            parts.append(torch.linalg.solve_triangular(factor, own, upper=transpose).flatten(0, 1))
        return torch.cat(parts)

    def _whitened(self, x: Tensor) -> Tensor:
        return self._by_sample(x, transpose=False)

    def __call__(self, x: Tensor) -> Tensor:
        """The preconditioner's inverse times x `(rows, columns)`."""
        z = self._whitened(x)
        z = z - self.Phi @ torch.cholesky_solve(self.Phi.mT @ z, self.L)
        return self._by_sample(z, transpose=True)


@torch.no_grad()
def solve(
    processes: Sequence[Process],
    params: Parameters,
    blocks: Sequence[Block],
    basis: LatentBasis,
    right: Tensor | None = None,
    tolerance: float = 1e-8,
    limit: int = 500,
) -> Solution:
    """Solve (K + I) x = y by conjugate gradients with the sparse model as preconditioner.

    Args:
        processes, params, blocks: as given to `gram`.
        basis: of the sparse model.
        right: y `(rows, columns)`; the blocks' targets by default.
        tolerance: largest ‖residual‖/‖y‖ at which to stop.
        limit: most iterations.

    Raises:
        ModelError: the right-hand side does not have the blocks' rows.
        NumericalError: the limit is reached first.
    """
    y = target_of(blocks)[:, None] if right is None else right
    if len(y) != offsets(blocks)[-1]:
        raise ModelError("the right-hand side does not fit", expected=offsets(blocks)[-1], got=len(y))
    x, history = _conjugate_gradients(
        lambda direction: product(processes, params, blocks, direction),
        SparsePreconditioner(basis, blocks),
        y,
        tolerance,
        limit,
    )
    return Solution(x, y - product(processes, params, blocks, x), len(history) + 1, history)


def _conjugate_gradients(
    multiply: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    y: Tensor,
    tolerance: float,
    limit: int,
) -> tuple[Tensor, list[float]]:
    """The solution, and the largest relative residual after each iteration."""
    tiny = torch.finfo(y.dtype).tiny
    scale = y.norm(dim=0).clamp(min=tiny)
    x, residual = torch.zeros_like(y), y.clone()
    direction = precondition(residual)
    rho = (residual * direction).sum(0)
    history: list[float] = []
    while len(history) < limit:
        Kd = multiply(direction)
        step = rho / (direction * Kd).sum(0).clamp(min=tiny)
        x, residual = x + step * direction, residual - step * Kd
        history.append(float((residual.norm(dim=0) / scale).max()))
        if history[-1] <= tolerance:
            return x, history
        z = precondition(residual)
        rho, before = (residual * z).sum(0), rho
        direction = z + (rho / before.clamp(min=tiny)) * direction
    raise NumericalError(
        "conjugate gradients did not converge",
        expected=f"a relative residual of {tolerance:g} within {limit} iterations",
        got=f"{history[-1]:.1e}" if history else "no iterations",
        hint="use more inducing points, a higher limit or a larger tolerance",
    )


@dataclass(frozen=True)
class ExactPrediction:
    """Exact posterior of rows at a few samples, with what the early stop leaves open.

    Attributes:
        mean: `(n, d)`.
        covariance: `(n, d, d)`, too large by at most `excess`.
        excess: bound on what the variances are too large by, ‖residual‖² `(n, d)`.
    """

    mean: Tensor
    covariance: Tensor
    excess: Tensor


@torch.no_grad()
def predict(
    processes: Sequence[Process],
    params: Parameters,
    blocks: Sequence[Block],
    basis: LatentBasis,
    test: Block,
    tolerance: float = 1e-8,
    limit: int = 500,
) -> ExactPrediction:
    """Exact posterior of rows at samples, by one solve with as many right-hand sides as there are rows.

    With x ≈ (K + I)⁻¹k the variance k_** − 2kᵀx + xᵀ(K + I)x exceeds the exact one by rᵀ(K + I)⁻¹r ≤ ‖r‖²,
    where r is the residual, as the rows have unit noise.

    Raises:
        NumericalError: the limit of iterations is reached first.
    """
    cross = cross_gram(processes, params, blocks, [test])
    right = torch.cat([target_of(blocks)[:, None], cross], dim=1)
    solution = solve(processes, params, blocks, basis, right, tolerance, limit)
    alpha, X, R = solution.x[:, 0], solution.x[:, 1:], solution.residual[:, 1:]
    n, d = test.target.shape
    explained = (X.mT @ (cross + R)).unflatten(0, (n, d)).unflatten(2, (n, d))
    own = torch.arange(n, device=X.device)
    prior = sum(
        torch.einsum("nak,kn,nbk->nab", W, prior.kernel.diagonal(sub(params, prior.prefix), f), W)
        for prior, f, W in zip(processes, test.features, test.operators, strict=True)
    )
    covariance = prior - explained[own, :, own]
    mean = (cross.mT @ alpha).unflatten(0, (n, d))
    return ExactPrediction(mean, 0.5 * (covariance + covariance.mT), (R**2).sum(0).unflatten(0, (n, d)))
