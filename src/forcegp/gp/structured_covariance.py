"""Gram matrices of force priors seen through operators, and their derivatives.

A block holds `n` samples with `r` rows each. Between two samples the covariance of their rows is
Σ_k W[i,:,k] k_k(x_i, x_j) W[j,:,k]ᵀ, summed over the components k of every prior: the block-by-block
form of H k_Q Hᵀ (eq. 32, figure 1) for any operator W. Rows are ordered by block, sample, row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from forcegp.gp.kernels import Features, Kernel, Parameters, sub

CHUNK_ELEMENTS = 400_000
"""Size of the intermediate arrays of one chunk of samples; they should stay in the processor's cache."""


Place = tuple[Any, ...]
"""("param", name), ("feature", block, process, name), ("operator", block, process) or ("target", block)."""

Gradient = dict[Place, Tensor]
"""Derivatives by place."""


@runtime_checkable
class Process(Protocol):
    """A Gaussian process by its kernel and the prefix of its hyperparameters."""

    @property
    def kernel(self) -> Kernel:
        """Covariance of each component."""
        ...

    @property
    def prefix(self) -> str:
        """Prefix of the hyperparameters; another process's where they are shared."""
        ...


@dataclass(frozen=True)
class Block:
    """Samples that share a number of rows.

    Attributes:
        features: standardized kernel inputs of each prior, `(n, w)` by name.
        operators: W of each prior, `(n, r, components)`.
        target: whitened residual `(n, r)`.
    """

    features: tuple[Features, ...]
    operators: tuple[Tensor, ...]
    target: Tensor

    @property
    def rows(self) -> int:
        """Number of rows, n r."""
        return self.target.numel()


def points(features: Features) -> int:
    """Number of inputs in a dictionary of features."""
    return len(next(iter(features.values())))


def components_of(block: Block) -> list[int]:
    """Number of components of each process."""
    return [W.shape[-1] for W in block.operators]


def chunked(blocks: Iterable[Block], samples: int) -> Iterator[Block]:
    """The samples of blocks in blocks of at most so many."""
    for block in blocks:
        for first in range(0, len(block.target), samples):
            yield rows_of(block, slice(first, first + samples))


def rows_of(block: Block, index: slice | Tensor) -> Block:
    """Some of the samples of a block."""
    return Block(
        tuple({name: x[index] for name, x in f.items()} for f in block.features),
        tuple(W[index] for W in block.operators),
        block.target[index],
    )


def rows_mean(latent_mean: Callable[[int, Features], Tensor], block: Block) -> Tensor:
    """Mean Σ_p W_p μ_p of the rows of each sample of a block, `(n, d)` (eq. 23).

    Args:
        latent_mean: μ_p of process p at kernel inputs, `(n, components)`.
        block: samples; the targets are not read.
    """
    mean = torch.zeros_like(block.target)
    for p, (W, x) in enumerate(zip(block.operators, block.features, strict=True)):
        mean = mean + (W @ latent_mean(p, x)[..., None])[..., 0]
    return mean


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
    """Covariance between the rows of two lists of blocks, `(rows1, rows2)`.

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
