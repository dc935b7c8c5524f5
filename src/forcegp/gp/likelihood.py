"""The covariance of whitened rows (eq. 10), their likelihood and its collapsed bound, with closed gradients.

A block holds `n` samples with `r` rows each. Between two samples the covariance of their rows is
Σ_k W[i,:,k] k_k(x_i, x_j) W[j,:,k]ᵀ, summed over the components k of every prior: the block-by-block
form of H k_Q Hᵀ (eq. 32, figure 1) for any operator W. Rows are ordered by block, sample, row.

The bound of sparse inference is −F = ½ [Σ y² − vᵀA⁻¹v + log|A| + rows log 2π + Σ tr W(k − VᵀV)Wᵀ] (Titsias
2009). It passes over the samples twice, once for the sums and once for the gradient, in memory that does not
grow with their number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.linalg.lapack
import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.gp.basis import ProcessBasis, latent_basis, split
from forcegp.gp.factor import cholesky
from forcegp.gp.features import Block, Features, components_of, rows_of
from forcegp.gp.kernels import Parameters, Process, sub
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import CHUNK_SAMPLES, Moments, accumulate, normal_terms
from forcegp.resources import threads_of_pytorch

CHUNK_ELEMENTS = 400_000
"""Size of the intermediate arrays of one chunk of samples; they should stay in the processor's cache."""


Place = tuple[Any, ...]
"""("param", name), ("feature", block, process, name), ("operator", block, process) or ("target", block)."""

Gradient = dict[Place, Tensor]
"""Derivatives by place."""


def offsets(blocks: Sequence[Block]) -> list[int]:
    """First row of each block, and the number of rows."""
    starts = [0]
    for block in blocks:
        starts.append(starts[-1] + block.rows)
    return starts


def _chunks(n: int, size: int) -> Iterator[tuple[int, int]]:
    step = max(1, CHUNK_ELEMENTS // max(size, 1))
    for first in range(0, n, step):
        yield first, min(first + step, n)


def add_rows(out: Tensor, W1: Tensor, k: Tensor, W2: Tensor, lower: bool = False) -> None:
    """Add Σ_k W1 k W2ᵀ to `out`, chunk by chunk; only up to the diagonal where `lower`."""
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
    """Each prior with its hyperparameters, and the pairs of blocks between which it contributes."""
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
    """Covariance between the rows of two lists of blocks, `(rows1, rows2)` (eqs. 10, 13 and 19).

    Without a second list it is that of the first with itself, of which the lower triangle is valid.
    """
    lower, blocks2 = blocks2 is None, blocks1 if blocks2 is None else blocks2
    starts1, starts2 = offsets(blocks1), offsets(blocks2)
    like = blocks1[0].target
    K = torch.zeros(starts1[-1], starts2[-1], dtype=like.dtype, device=like.device)
    # K = Σ_p W_p k_p W_pᵀ (eqs. 13 and 15)
    for p, process_params, g, h in _pairs(priors, params, blocks1, blocks2, lower):
        one, two = blocks1[g], blocks2[h]
        k = priors[p].kernel.covariance(process_params, one.features[p], two.features[p])
        part = K[starts1[g] : starts1[g + 1], starts2[h] : starts2[h + 1]]
        add_rows(part, one.operators[p], k, two.operators[p], lower=lower and g == h)
    return K


def gram(priors: Sequence[Process], params: Parameters, blocks: Sequence[Block]) -> Tensor:
    """Covariance of the rows of blocks with unit white noise, `(rows, rows)`; the lower triangle is valid."""
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
    """Derivatives of F = ½ log|Σ| + ½ yᵀΣ⁻¹y with Σ = K + I, from ∂F/∂Σ = ½(Σ⁻¹ − ααᵀ) in closed form.

    With G = Σ⁻¹ − ααᵀ the derivative for the kernel between samples i and j is ½ W_iᵀ G_ij W_j; only
    the kernels themselves are differentiated automatically.

    Args:
        priors, params, blocks: as given to `gram`.
        K_inv: Σ⁻¹ `(rows, rows)`, the lower triangle is read.
        alpha: Σ⁻¹ y `(rows,)`.
        deep: whether to compute derivatives for targets, operators and features too.
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
        # ∂F/∂θ = Σ_ij ∂F/∂k_ij ∂k_ij/∂θ, and alike for kernel inputs
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
    """The kernel matrix with a graph to fresh leaves of its parameters and, on request, its inputs."""
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
    """Derivative for the kernel matrix `(components, n, n')`; adds those for the operators to `into`.

    On a diagonal block the lower triangle carries the weight of both.
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
    """A Gaussian process conditioned on rows.

    Attributes:
        L: lower Cholesky factor of K + I `(rows, rows)`.
        alpha: (K + I)⁻¹ y `(rows,)`.
        jitter: what was added to the diagonal, 0.0 as a rule.
    """

    L: Tensor
    alpha: Tensor
    jitter: float

    def negative_log_likelihood(self, y: Tensor) -> Tensor:
        """−log p(y) = ½ yᵀ(K + I)⁻¹y + ½ log|K + I| + ½ n log 2π."""
        # = ½ yᵀα + Σ log L_ii + ½ n log 2π
        return 0.5 * (y @ self.alpha) + self.L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi)


def target_of(blocks: Sequence[Block]) -> Tensor:
    """All whitened residuals `(rows,)`."""
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
    """Negative log marginal likelihood of whitened rows, differentiable in all that it is made of.

    Value and gradient come from one factorisation.

    Args:
        priors: the force priors.
        params: log-hyperparameters, `<prior>.<name>`.
        blocks: whitened rows.

    Returns:
        The scalar.

    Raises:
        NumericalError: the covariance is not positive definite.
    """

    def value(params: Parameters, blocks: Sequence[Block]) -> Valued:
        fit = condition(priors, params, blocks)

        def gradient(deep: bool) -> Gradient:
            # ½ tr((Σ⁻¹ − α αᵀ) ∂Σ)
            return gram_gradient(priors, params, blocks, cholesky_inverse_(fit.L), fit.alpha, deep)

        return fit.negative_log_likelihood(target_of(blocks)), gradient

    return with_gradient(value, params, blocks)


def cholesky_inverse_(L: Tensor) -> Tensor:
    """Lower triangle of (L Lᵀ)⁻¹, written over the factor L (LAPACK potri); the upper one is undefined."""
    if L.device.type != "cpu":
        return torch.cholesky_inverse(L)
    if L.shape[0] == 0:
        return L
    # Σ⁻¹ = L⁻ᵀ L⁻¹; a row-major lower triangle is the upper one in LAPACK's column-major order.
    array = L.numpy().T
    (potri,) = scipy.linalg.lapack.get_lapack_funcs(("potri",), (array,))
    with threads_of_pytorch():
        inverse, info = potri(array, lower=0, overwrite_c=1)
    if info != 0:
        raise NumericalError("a Cholesky factor is singular", got=f"zero pivot in row {info}")
    if not np.shares_memory(inverse, array):
        L.copy_(torch.from_numpy(inverse.T))
    return L


Valued = tuple[Tensor, Callable[[bool], Gradient]]
"""A value, and what gives its derivatives: those for hyperparameters alone, or for rows too (deep)."""


def with_gradient(
    function: Callable[[Parameters, Sequence[Block]], Valued], params: Parameters, blocks: Sequence[Block]
) -> Tensor:
    """The value of a function that knows its own derivatives, as a node of the autograd graph.

    Args:
        function: of hyperparameters and rows, called without a graph; its derivatives are asked for right
            after the value.
        params, blocks: what it is evaluated at.
    """
    named: dict[Place, Tensor] = {("param", key): x for key, x in params.items()}
    for g, block in enumerate(blocks):
        for p, (features, W) in enumerate(zip(block.features, block.operators, strict=True)):
            named |= {("feature", g, p, name): x for name, x in features.items()}
            named["operator", g, p] = W
        named["target", g] = block.target
    return _WithGradient.apply(lambda: function(params, blocks), list(named), *named.values())  # pyright: ignore[reportReturnType]


class _WithGradient(torch.autograd.Function):
    """Computes the gradient beside the value, while what both need is at hand."""

    @staticmethod
    def forward(ctx: Any, function: Callable[[], Valued], places: list[Place], *tensors: Tensor) -> Tensor:
        value, gradient_of = function()
        ctx.wanted = [i for i, need in enumerate(ctx.needs_input_grad[2:]) if need]
        if ctx.wanted:
            gradient = gradient_of(any(places[i][0] != "param" for i in ctx.wanted))
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


def bound_of(sums: Moments, posterior: SparsePosterior) -> Tensor:
    """The negative bound from the sums `()`."""
    # −F = ½ [Σ y² − vᵀA⁻¹v + log|A| + rows log 2π + Σ tr W(k − VᵀV)Wᵀ], log|A| = 2 Σ log L_ii
    fit = sums.yy - sums.v @ posterior.weights
    log_determinant = 2.0 * posterior.L.diagonal().abs().log().sum()
    return 0.5 * (fit + log_determinant + sums.rows * math.log(2.0 * math.pi) + sums.missed.sum())


def negative_bound(
    processes: Sequence[Process], params: Parameters, blocks: Sequence[Block], inducing: Sequence[Features]
) -> Tensor:
    """Negative collapsed bound, differentiable in hyperparameters, kernel inputs, operators and targets.

    It is no smaller than the exact negative log likelihood, and equals it where inducing points are the data.
    The inducing points are constants.

    Args:
        processes: the processes.
        params: log-hyperparameters, `<process>.<name>`.
        blocks: whitened rows.
        inducing: kernel inputs of the inducing points of each process.

    Returns:
        The scalar.

    Raises:
        NumericalError: the sums are not finite.
    """

    def value(params: Parameters, blocks: Sequence[Block]) -> Valued:
        basis = latent_basis(processes, params, inducing, components_of(blocks[0]))
        sums = accumulate(basis, blocks)
        posterior = SparsePosterior.of(basis, sums)
        return bound_of(sums, posterior), lambda deep: _BoundGradient(posterior, deep).over(blocks)

    return with_gradient(value, params, blocks)


class _BoundGradient:
    """Derivatives of the negative bound, added up chunk by chunk.

    With D = ½(A⁻¹ + mmᵀ) the derivative for V_k of one sample is 2 Σ_l S_kl D_kl V_l − m_k c_k − S_kk V_k,
    and that for S_kl is V_kᵀD_kl V_l + ½ δ_kl (k − |V|²).
    """

    def __init__(self, posterior: SparsePosterior, deep: bool) -> None:
        self.basis, self.deep = posterior.basis, deep
        # m = A⁻¹v, D = ½ (A⁻¹ + m mᵀ)
        self.m = posterior.weights
        self.D = 0.5 * torch.addr(torch.cholesky_inverse(posterior.L), self.m, self.m)
        self.total: Gradient = {}
        # By process, Σ k(Z, x) ∂F/∂V `(components, m, kept)`: the derivative for R.
        self.roots = [
            torch.zeros_like(part.roots) if part.spectra else self.m[:0] for part in self.basis.parts
        ]

    def over(self, blocks: Sequence[Block]) -> Gradient:
        """The derivatives over all samples."""
        for g, block in enumerate(blocks):
            chunks = []
            for first in range(0, len(block.target), CHUNK_SAMPLES):
                chunks.append(self._chunk(rows_of(block, slice(first, first + CHUNK_SAMPLES))))
            if self.deep and chunks:
                for place in chunks[0]:
                    self.total[(place[0], g, *place[1:])] = torch.cat([chunk[place] for chunk in chunks])
        for part, prior, dR in zip(self.basis.parts, self.basis.processes, self.roots, strict=True):
            if part.spectra:
                self._through_inducing(part, prior.prefix, dR)
        return self.total

    def _chunk(self, block: Block) -> Gradient:
        """Add the derivatives for hyperparameters; return those for the block's own tensors."""
        V, _, missed = self.basis.evaluate(block.features)
        W, S, c = normal_terms(block)
        gradient: Gradient = {}
        dV = self._basis_gradient(V, S, c)
        if self.deep:
            # dS_kl = V_kᵀ D_kl V_l + ½ δ_kl (k − |V|²), dc_k = −m_kᵀ V_k
            columns = self.basis.columns
            dS = torch.stack([self._by_component(V * (V[:, l] @ self.D[l])) for l in columns], dim=-1)
            dS = 0.5 * (dS + dS.mT) + 0.5 * torch.diag_embed(missed)
            dc = -self._by_component(V * self.m)
            # dW = 2 W dS + y dcᵀ, dy = y + W dc
            dW = 2.0 * W @ dS + block.target[..., None] * dc[:, None, :]
            for p, components in enumerate(self.basis.components):
                gradient["operator", p] = dW[..., components]
            gradient["target",] = block.target + (W @ dc[..., None])[..., 0]
        weight = torch.diagonal(S, dim1=0, dim2=1)
        for p in range(len(self.basis.parts)):
            gradient |= self._through_kernel(p, block.features[p], dV, 0.5 * weight)
        return gradient

    def _basis_gradient(self, V: Tensor, S: Tensor, c: Tensor) -> Tensor:
        """Derivative for V `(n, size)`."""
        # dV_k = 2 Σ_l S_kl D_kl V_l − m_k c_k − S_kk V_k
        owner, columns = self.basis.owner, self.basis.columns
        weight = torch.diagonal(S, dim1=0, dim2=1)
        dV = torch.addcmul(-self.m * c[:, owner], V * self.from_inducing, weight[:, owner], value=-1.0)
        twice, weighted = 2.0 * S, torch.empty_like(V)
        for k, of_k in enumerate(columns):
            for l, of_l in enumerate(columns):
                torch.mul(V[:, of_l], twice[k, l, :, None], out=weighted[:, of_l])
            dV[:, of_k].addmm_(weighted, self.D[:, of_k])
        return dV

    @cached_property
    def from_inducing(self) -> Tensor:
        """1 for basis functions of inducing points, whose squares are missed no more, else 0 `(size,)`."""
        chosen = []
        for part in self.basis.parts:
            position = part.columns % max(part.used.shape[1], 1)
            chosen.append(position < part.used.shape[1] - part.finite_size)
        return torch.cat(chosen).to(self.m)

    def _by_component(self, x: Tensor) -> Tensor:
        """Sums over the basis functions of each component, `(n, components)`."""
        return x.new_zeros(len(x), len(self.basis.columns)).index_add_(1, self.basis.owner, x)

    def _through_kernel(self, p: int, features: Features, dV: Tensor, weight: Tensor) -> Gradient:
        """Derivatives of one chunk through k(x, Z), φ(x) and k(x, x)."""
        part, prefix = self.basis.parts[p], self.basis.processes[p].prefix
        filled = dV.new_zeros(len(dV), part.used.numel())
        filled.index_copy_(1, part.columns, dV[:, self.basis.of_process(p)])
        filled = filled.unflatten(1, part.used.shape).transpose(0, 1)
        width = filled.shape[-1] - part.finite_size
        params, x = _leaves(part.params), _leaves(features, self.deep)
        outputs, gradients = [], []
        with torch.enable_grad():
            kernels = split(part.kernel, params)
            if (rest := kernels.rest) is not None:
                # d k(x, x) = ½ S_kk
                outputs.append(rest.kernel.diagonal(rest.params, x))
                gradients.append(weight[:, self.basis.components[p]].mT)
                if part.spectra:
                    # V = k(x, Z) R: dR += k(Z, x) dV, dk(x, Z) = dV Rᵀ
                    kernel = rest.kernel.covariance(rest.params, x, part.inducing)
                    self.roots[p] = self.roots[p] + kernel.detach().mT @ filled[..., :width]
                    outputs.append(kernel)
                    gradients.append(filled[..., :width] @ part.roots.mT)
            if kernels.finite is not None:
                outputs.append(kernels.finite.features(part.inducing).basis(x))
                gradients.append(filled[..., width:])
        return self._add(prefix, params, x if self.deep else {}, outputs, gradients, p)

    def _add(
        self,
        prefix: str,
        params: dict[str, Tensor],
        x: dict[str, Tensor],
        outputs: list[Tensor],
        gradients: list[Tensor],
        p: int = 0,
    ) -> Gradient:
        """Add what arrives at hyperparameters; return what arrives at kernel inputs."""
        leaves = {("param", f"{prefix}.{key}"): value for key, value in params.items()}
        leaves |= {("feature", p, key): value for key, value in x.items()}
        inputs = list(leaves.values())
        grads = torch.autograd.grad(outputs, inputs, gradients, allow_unused=True, materialize_grads=True)
        found = dict(zip(leaves, grads, strict=True))
        for place in [place for place in found if place[0] == "param"]:
            value = found.pop(place)
            self.total[place] = self.total[place] + value if place in self.total else value
        return found

    def _through_inducing(self, part: ProcessBasis, prefix: str, dR: Tensor) -> None:
        """Derivatives through K_zz."""
        params = _leaves(part.params)
        with torch.enable_grad():
            rest = split(part.kernel, params).rest
            assert rest is not None
            K = rest.kernel.covariance(rest.params, part.inducing, part.inducing)
        dK = torch.stack([s.pull_back(d) for s, d in zip(part.spectra, dR, strict=True)])
        self._add(prefix, params, {}, [K], [dK])


def _leaves(tensors: Parameters, requires_grad: bool = True) -> dict[str, Tensor]:
    return {key: value.detach().requires_grad_(requires_grad) for key, value in tensors.items()}
