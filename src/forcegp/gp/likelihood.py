"""Exact marginal likelihood of whitened rows, with its gradient in closed form (eqs. 10 and 11).

Exact inference takes memory that grows with the square of the rows: what would not fit is refused beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg.lapack
import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError
from forcegp.gp.factor import cholesky
from forcegp.gp.kernels import Parameters
from forcegp.gp.structured_covariance import Block, Gradient, Place, Process, gram, gram_gradient
from forcegp.resources import announce_memory, free_memory, threads_of_pytorch

MATRICES_TO_LEARN = 3.0
"""Square matrices of all rows that learning holds at once: the covariance, its factor and a copy."""
MATRICES_TO_CONDITION = 2.0
"""Those that conditioning holds: the covariance and its factor."""
SHARE = 0.8
"""Fraction of the free memory that exact inference may take."""


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
        function: of detached hyperparameters and rows; its derivatives are asked for right after the value.
        params, blocks: what it is evaluated at.
    """
    named = dict(_tensors_of(params, blocks))
    return _WithGradient.apply(function, list(named), *named.values())  # pyright: ignore[reportReturnType]


class _WithGradient(torch.autograd.Function):
    """Computes the gradient beside the value, while what both need is at hand."""

    @staticmethod
    def forward(ctx: Any, function: Any, places: list[Place], *tensors: Tensor) -> Tensor:
        params, blocks = _from_tensors(dict(zip(places, (t.detach() for t in tensors), strict=True)))
        value, gradient_of = function(params, blocks)
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


def _tensors_of(params: Parameters, blocks: Sequence[Block]) -> Iterator[tuple[Place, Tensor]]:
    """Every tensor that a likelihood depends on, by its place."""
    for key, value in params.items():
        yield ("param", key), value
    for g, block in enumerate(blocks):
        for p, (features, W) in enumerate(zip(block.features, block.operators, strict=True)):
            for name, x in features.items():
                yield ("feature", g, p, name), x
            yield ("operator", g, p), W
        yield ("target", g), block.target


def _from_tensors(named: Mapping[Place, Tensor]) -> tuple[dict[str, Tensor], list[Block]]:
    """Hyperparameters and blocks of the tensors of `_tensors_of`."""
    params = {place[1]: x for place, x in named.items() if place[0] == "param"}
    features: dict[int, dict[int, dict[str, Tensor]]] = {}
    operators: dict[int, list[Tensor]] = {}
    for place, x in named.items():
        if place[0] == "feature":
            features.setdefault(place[1], {}).setdefault(place[2], {})[place[3]] = x
        elif place[0] == "operator":
            operators.setdefault(place[1], []).append(x)
    blocks = [
        Block(tuple(features[g][p] for p in range(len(W))), tuple(W), named["target", g])
        for g, W in operators.items()
    ]
    return params, blocks


def exact_bytes(blocks: Sequence[Block], learning: bool = True) -> int:
    """Bytes of memory that exact inference on whitened rows takes at its peak.

    Args:
        blocks: whitened rows.
        learning: whether hyperparameters are learned, or the rows conditioned on only.
    """
    rows = sum(block.target.numel() for block in blocks)
    components = sum(W.shape[-1] for W in blocks[0].operators) if blocks else 0
    samples = [len(block.target) for block in blocks]
    kernels = max((n * n for n in samples), default=0) * components
    item = blocks[0].target.element_size() if blocks else 8
    return int(item * ((MATRICES_TO_LEARN if learning else MATRICES_TO_CONDITION) * rows**2 + kernels))


def require_exact_fits(blocks: Sequence[Block], learning: bool = True, available: int | None = None) -> None:
    """Refuse exact inference that would not fit into memory, and announce what takes most of it.

    Args:
        blocks: whitened rows.
        learning: whether hyperparameters are learned.
        available: bytes that may be taken; by default `SHARE` of what is free.

    Raises:
        ModelError: it takes more.
    """
    free = free_memory()
    allowed = (None if free is None else int(SHARE * free)) if available is None else available
    needed = exact_bytes(blocks, learning)
    rows = sum(block.target.numel() for block in blocks)
    samples = sum(len(block.target) for block in blocks)
    if allowed is not None and needed > allowed:
        raise ModelError(
            f"exact inference on {samples} samples ({rows} rows) does not fit into memory",
            expected=f"at most {allowed / 2**30:.1f} GiB",
            got=f"{needed / 2**30:.1f} GiB",
            hint='use inference="sparse", or fewer samples',
        )
    announce_memory(needed, f"exact inference on {samples} samples ({rows} rows)")
