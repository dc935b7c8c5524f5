"""The covariance of whitened rows (eq. 10) and their likelihood, with closed-form gradients.

A block contains `n` samples with `r` rows each. The covariance between the rows of two samples is Σ_k
W[i,:,k] k_k(x_i, x_j) W[j,:,k]ᵀ, summed over the components k of every prior. This is the block-wise form of
H k_Q Hᵀ (eq. 32, figure 1) for any operator W. Rows are ordered by block, sample and row.

Processes with finitely many features have far fewer weights than rows, so their likelihood is computed in
weight space (Rasmussen and Williams, *Gaussian Processes for Machine Learning*, section 2.1).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import scipy.linalg.lapack
import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.gp.basis import latent_basis
from forcegp.gp.factor import cholesky
from forcegp.gp.features import Block, Features, components_of
from forcegp.gp.kernels import Parameters, Process, sub
from forcegp.resources import threads_of_pytorch

CHUNK_ELEMENTS = 400_000
"""Size of the intermediate arrays for a chunk of samples, chosen to fit into the processor cache."""
Place = tuple[Any, ...]
"""("param", name), ("feature", block, process, name), ("operator", block, process) or ("target", block)."""
Gradient = dict[Place, Tensor]
"""Derivatives, keyed by place."""


def offsets(blocks: Sequence[Block]) -> list[int]:
    """Return the index of the first row of each block, followed by the total number of rows."""
    return list(accumulate((block.rows for block in blocks), initial=0))


def _chunks(n: int, size: int) -> Iterator[tuple[int, int]]:
    step = max(1, CHUNK_ELEMENTS // max(size, 1))
    for first in range(0, n, step):
        yield first, min(first + step, n)


def add_rows(out: Tensor, W1: Tensor, k: Tensor, W2: Tensor, lower: bool = False) -> None:
    """Add Σ_k W1 k W2ᵀ to `out` in chunks; if `lower` is true, only up to the diagonal."""
    r = W1.shape[1]
    W2k = W2.permute(2, 0, 1)
    for i, j in _chunks(len(W1), W2.numel()):
        n = j if lower else len(W2)
        # K_ij += Σ_k W_i k_k(x_i, x_j) W_jᵀ (eq. 12)
        weighted = k[:, i:j, :n].transpose(0, 1)[..., None] * W2k[:, :n]
        out[i * r : j * r, : n * W2.shape[1]] += (W1[i:j] @ weighted.flatten(2)).flatten(0, 1)


def _pairs(
    priors: Sequence[Process],
    params: Parameters,
    blocks1: Sequence[Block],
    blocks2: Sequence[Block],
    lower: bool,
) -> Iterator[tuple[int, dict[str, Tensor], int, int]]:
    """Yield each prior with its hyperparameters and the pairs of blocks that it contributes to."""
    for p, prior in enumerate(priors):
        depends1, depends2 = ([bool(b.operators[p].any()) for b in blocks] for blocks in (blocks1, blocks2))
        process_params = sub(params, prior.prefix)
        for g in range(len(blocks1)):
            for h in range(g + 1 if lower else len(blocks2)):
                if depends1[g] and depends2[h]:
                    yield p, process_params, g, h


def cross_gram(
    priors: Sequence[Process],
    params: Parameters,
    blocks1: Sequence[Block],
    blocks2: Sequence[Block] | None = None,
) -> Tensor:
    """Return the covariance K = Σ_p W_p k_p W_pᵀ of a sum of processes (eq. 13), `(rows1, rows2)`.

    K_ij is the covariance between row i of the first list of blocks and row j of the second (Σ in eq. 10).
    If the second list is omitted, it equals the first, and only the lower triangle of the result is valid.
    """
    lower, blocks2 = blocks2 is None, blocks1 if blocks2 is None else blocks2
    starts1, starts2 = offsets(blocks1), offsets(blocks2)
    like = blocks1[0].target
    K = torch.zeros(starts1[-1], starts2[-1], dtype=like.dtype, device=like.device)
    # K = Σ_p W_p k_p W_pᵀ (eq. 13)
    for p, process_params, g, h in _pairs(priors, params, blocks1, blocks2, lower):
        one, two = blocks1[g], blocks2[h]
        k = priors[p].kernel.covariance(process_params, one.features[p], two.features[p])
        part = K[starts1[g] : starts1[g + 1], starts2[h] : starts2[h + 1]]
        add_rows(part, one.operators[p], k, two.operators[p], lower=lower and g == h)
    return K


def gram(priors: Sequence[Process], params: Parameters, blocks: Sequence[Block]) -> Tensor:
    """Return the covariance of the rows `(rows, rows)`, including unit white noise; lower triangle only."""
    # Σ = K + I (eq. 10)
    K = cross_gram(priors, params, blocks)
    K.diagonal().add_(1.0)
    return K


def gram_gradient(
    priors: Sequence[Process],
    params: Parameters,
    blocks: Sequence[Block],
    K_inv: Tensor,
    alpha: Tensor,
    deep: bool,
) -> Gradient:
    """Return the derivatives of F = ½ log|Σ| + ½ yᵀΣ⁻¹y with Σ = K + I, in closed form.

    With G = Σ⁻¹ − ααᵀ, ∂F/∂Σ = ½ G, and the derivative with respect to the kernel between samples i and j is
    ½ W_iᵀ G_ij W_j. Only the kernels themselves are differentiated automatically.

    Args:
        priors, params, blocks: as for `gram`.
        K_inv: Σ⁻¹ `(rows, rows)`; only its lower triangle is used.
        alpha: Σ⁻¹ y `(rows,)`.
        deep: whether to differentiate with respect to targets, operators and features as well.
    """
    rows = [slice(*pair) for pair in pairwise(offsets(blocks))]
    total: Gradient = {}
    if deep:
        # ∂F/∂y = α
        for g, block in enumerate(blocks):
            total["target", g] = alpha[rows[g]].reshape(block.target.shape)
            total |= {("operator", g, p): torch.zeros_like(W) for p, W in enumerate(block.operators)}
    for p, process_params, g, h in _pairs(priors, params, blocks, blocks, lower=True):
        one, two = blocks[g], blocks[h]
        # ∂F/∂k_ij = ½ W_iᵀ G_ij W_j, for both triangles together
        leaves, k = _kernel_with_leaves(priors[p], process_params, one.features[p], two.features[p], deep)
        dk = _kernel_gradient(
            K_inv[rows[g], rows[h]],
            (alpha[rows[g]], alpha[rows[h]]),
            (one.operators[p], two.operators[p]),
            k.detach(),
            g == h,
            (total["operator", g, p], total["operator", h, p]) if deep else None,
        )
        # ∂F/∂θ = Σ_ij ∂F/∂k_ij ∂k_ij/∂θ, and likewise for kernel inputs
        grads = torch.autograd.grad(k, list(leaves.values()), dk, allow_unused=True)
        for (kind, key), grad in zip(leaves, grads, strict=True):
            where = ("feature", g if kind == "one" else h, p, key)
            place = ("param", f"{priors[p].prefix}.{key}") if kind == "param" else where
            if grad is not None:
                total[place] = total[place] + grad if place in total else grad
    return total


def _kernel_with_leaves(
    prior: Process, process_params: Parameters, f1: Features, f2: Features, with_features: bool
) -> tuple[dict[tuple[str, str], Tensor], Tensor]:
    """Return the kernel matrix, and new autograd leaves for its parameters and (optionally) inputs."""
    leaves = {("param", key): value.detach().requires_grad_() for key, value in process_params.items()}
    one: Mapping[str, Tensor] = f1
    two: Mapping[str, Tensor] = f2
    if with_features:
        leaves |= {("one", key): x.detach().requires_grad_() for key, x in f1.items()}
        leaves |= {("two", key): x.detach().requires_grad_() for key, x in f2.items()}
        one, two = ({key: leaves[side, key] for key in f1} for side in ("one", "two"))
    with torch.enable_grad():
        k = prior.kernel.covariance({key: leaves["param", key] for key in process_params}, one, two)
    return leaves, k


def _kernel_gradient(
    K_inv: Tensor,
    alpha: tuple[Tensor, Tensor],
    operators: tuple[Tensor, Tensor],
    k: Tensor,
    lower: bool,
    into: tuple[Tensor, Tensor] | None,
) -> Tensor:
    """Return ∂F/∂k `(components, n, n')`, and add the derivatives with respect to the operators to `into`.

    In a diagonal block, the lower triangle also accounts for the upper one.
    """
    W1, W2 = operators
    r, s = W1.shape[1], W2.shape[1]
    dk = torch.zeros_like(k)
    W2k = W2.permute(2, 0, 1)
    for i, j in _chunks(len(W1), W2.numel()):
        n = j if lower else len(W2)
        # G = Σ⁻¹ − α αᵀ off the diagonal, ½ (Σ⁻¹ − α αᵀ) on it
        G = torch.addr(K_inv[i * r : j * r, : n * s], alpha[0][i * r : j * r], alpha[1][: n * s], alpha=-1.0)
        if lower:
            diagonal = G[:, i * s :]
            diagonal.copy_(0.5 * (torch.tril(diagonal) + torch.tril(diagonal, -1).mT))
        # Z = W_iᵀ G_ij, ∂F/∂k_ij = Z W_j
        G = G.unflatten(0, (j - i, r))
        Z = (W1[i:j].mT @ G).unflatten(2, (n, s))
        dk[:, i:j, :n] = (Z * W2k[:, :n]).sum(-1).transpose(0, 1)
        if into is not None:
            # ∂F/∂W_i = G_ij W_j k_ij, ∂F/∂W_j = Zᵀ k_ij
            weighted = k[:, i:j, :n].transpose(0, 1)[..., None] * W2k[:, :n]
            into[0][i:j] += G @ weighted.flatten(2).mT
            into[1][:n] += torch.einsum("kij,ikjb->jbk", k[:, i:j, :n], Z)
    return dk


@dataclass(frozen=True)
class Conditioned:
    """A Gaussian process conditioned on whitened rows.

    Attributes:
        L: lower Cholesky factor of K + I `(rows, rows)`.
        alpha: (K + I)⁻¹ y `(rows,)`.
        jitter: jitter added to the diagonal, usually 0.0.
    """

    L: Tensor
    alpha: Tensor
    jitter: float

    def negative_log_likelihood(self, y: Tensor) -> Tensor:
        """Return −log p(y) = ½ yᵀ(K + I)⁻¹y + ½ log|K + I| + ½ n log 2π."""
        # = ½ yᵀα + Σ log L_ii + ½ n log 2π
        return 0.5 * (y @ self.alpha) + self.L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi)


def target_of(blocks: Sequence[Block]) -> Tensor:
    """Return all whitened residuals `(rows,)`."""
    return torch.cat([block.target.reshape(-1) for block in blocks])


def condition(priors: Sequence[Process], params: Parameters, blocks: Sequence[Block]) -> Conditioned:
    """Factorise the covariance of the rows.

    Raises:
        NumericalError: the covariance is not positive definite.
    """
    y = target_of(blocks)
    # Σ = K + I = L Lᵀ (eq. 10, rows in units of their noise)
    L, jitter = cholesky(gram(priors, params, blocks))
    # α = Σ⁻¹ y (eq. 11)
    alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
    return Conditioned(L, alpha, jitter)


def negative_log_likelihood(priors: Sequence[Process], params: Parameters, blocks: Sequence[Block]) -> Tensor:
    """Return the negative log marginal likelihood of whitened rows, which is differentiable in all inputs.

    The value and the gradient are computed from the same factorisation.

    Returns:
        The negative log marginal likelihood `()`.

    Raises:
        NumericalError: the covariance is not positive definite.
    """
    named: dict[Place, Tensor] = {("param", key): x for key, x in params.items()}
    for g, block in enumerate(blocks):
        for p, (features, W) in enumerate(zip(block.features, block.operators, strict=True)):
            named |= {("feature", g, p, name): x for name, x in features.items()}
            named["operator", g, p] = W
        named["target", g] = block.target
    return _OfRows.apply((priors, params, blocks), list(named), *named.values())  # pyright: ignore[reportReturnType]


class _OfRows(torch.autograd.Function):
    """Negative log likelihood whose value and gradient are computed from the same intermediate results."""

    @staticmethod
    def forward(ctx: Any, rows: tuple[Any, Any, Any], places: list[Place], *tensors: Tensor) -> Tensor:
        fit = condition(*rows)
        value = fit.negative_log_likelihood(target_of(rows[2]))
        ctx.wanted = [i for i, need in enumerate(ctx.needs_input_grad[2:]) if need]
        if ctx.wanted:
            # ½ tr((Σ⁻¹ − α αᵀ) ∂Σ)
            deep = any(places[i][0] != "param" for i in ctx.wanted)
            gradient = gram_gradient(*rows, cholesky_inverse_(fit.L), fit.alpha, deep)
            gradients = (gradient.get(places[i]) for i in ctx.wanted)
            pairs = zip(ctx.wanted, gradients, strict=True)
            ctx.save_for_backward(*(torch.zeros_like(tensors[i]) if g is None else g for i, g in pairs))
        return value

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Any, ...]:
        gradients: list[Tensor | None] = [None] * len(ctx.needs_input_grad)
        for i, saved in zip(ctx.wanted, ctx.saved_tensors, strict=True):
            gradients[2 + i] = grad[0] * saved
        return tuple(gradients)


def cholesky_inverse_(L: Tensor) -> Tensor:
    """Overwrite the factor L with (L Lᵀ)⁻¹ (LAPACK potri) and return it. Only the lower triangle is valid."""
    if L.device.type != "cpu":
        return torch.cholesky_inverse(L)
    if L.shape[0] == 0:
        return L
    # Σ⁻¹ = L⁻ᵀ L⁻¹; a row-major lower triangle is an upper triangle in LAPACK's column-major order.
    array = L.numpy().T
    (potri,) = scipy.linalg.lapack.get_lapack_funcs(("potri",), (array,))
    with threads_of_pytorch():
        inverse, info = potri(array, lower=0, overwrite_c=1)
    if info != 0:
        raise NumericalError("a Cholesky factor is singular", got=f"zero pivot in row {info}")
    if not np.shares_memory(inverse, array):
        L.copy_(torch.from_numpy(inverse.T))
    return L


class _OfWeights(torch.autograd.Function):
    """Negative log likelihood −log N(y; 0, I + Φ Φᵀ) and its derivatives."""

    @staticmethod
    def forward(ctx: Any, Phi: Tensor, y: Tensor) -> Tensor:
        # A = I + ΦᵀΦ = L Lᵀ, w = A⁻¹Φᵀy
        L, _ = cholesky(Phi.mT @ Phi + torch.eye(Phi.shape[1], dtype=Phi.dtype, device=Phi.device))
        w = torch.cholesky_solve((Phi.mT @ y)[:, None], L)[:, 0]
        residual = y - Phi @ w
        # ∂F/∂Φ = Φ A⁻¹ − (y − Φ w) wᵀ, ∂F/∂y = y − Φ w
        ctx.save_for_backward(Phi @ torch.cholesky_inverse(L) - residual[:, None] * w, residual)
        # F = ½ yᵀ(y − Φ w) + ½ log|A| + ½ n log 2π
        return 0.5 * (y @ residual) + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi)

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, ...]:
        return tuple(grad[0] * saved for saved in ctx.saved_tensors)


def negative_log_likelihood_of_weights(
    processes: Sequence[Process], params: Parameters, blocks: Sequence[Block]
) -> Tensor:
    """Return `negative_log_likelihood` for finitely many features, at a cost linear in the number of rows.

    The rows are modelled as Φ w + ε with w ~ N(0, I) and Φ_i = W_i φ(x_i)ᵀ.

    Raises:
        NumericalError: the features are not finite.
    """
    none = [{name: x[:0] for name, x in features.items()} for features in blocks[0].features]
    basis = latent_basis(processes, params, none, components_of(blocks[0]))
    Phi = torch.cat([basis.rows(block) for block in blocks])
    return _OfWeights.apply(Phi, target_of(blocks))  # pyright: ignore[reportReturnType]
