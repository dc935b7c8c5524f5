"""Exact marginal likelihood of whitened rows, with its gradient in closed form (eqs. 10 and 11)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from forcegp.gp.kernels import Parameters
from forcegp.gp.structured_covariance import Block, GramGradient, Process, gram, gram_gradient
from forcegp.linalg import cholesky, cholesky_inverse_


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
        """½ yᵀK⁻¹y + ½ log|K| + ½ n log 2π."""
        return 0.5 * (y @ self.alpha) + self.L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi)


def target_of(blocks: Sequence[Block]) -> Tensor:
    """All whitened residuals `(rows,)`."""
    return torch.cat([block.target.reshape(-1) for block in blocks])


def condition(priors: Sequence[Process], params: Parameters, blocks: Sequence[Block]) -> Conditioned:
    """Factorise the covariance of the rows.

    Raises:
        NumericalError: the covariance is not positive definite.
    """
    L, jitter = cholesky(gram(priors, params, blocks))
    alpha = torch.cholesky_solve(target_of(blocks)[:, None], L)[:, 0]
    return Conditioned(L, alpha, jitter)


class _NegativeLogLikelihood(torch.autograd.Function):
    """½ yᵀK⁻¹y + ½ log|K| + ½ n log 2π; forward computes the gradient too, from one factorisation."""

    @staticmethod
    def forward(ctx: Any, priors: Sequence[Process], layout: _Layout, *tensors: Tensor) -> Tensor:
        params, blocks = layout.unpack(tensors)
        fit = condition(priors, params, blocks)
        value = fit.negative_log_likelihood(target_of(blocks))
        needs = ctx.needs_input_grad[2:]
        if any(needs):
            K_inv = cholesky_inverse_(fit.L)
            deep = any(needs[len(layout.params) :])
            gradient = gram_gradient(priors, params, blocks, K_inv, fit.alpha, deep)
            ctx.save_for_backward(*layout.pack_gradient(gradient, fit.alpha, blocks))
        layout.jitter = fit.jitter
        return value

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Any, ...]:
        return (None, None, *(grad[0] * g for g in ctx.saved_tensors))


class _Layout:
    """Flattens hyperparameters and blocks into the list of tensors that autograd wants, and back."""

    def __init__(self, params: Parameters, blocks: Sequence[Block]) -> None:
        self.params = list(params)
        self.names = [[list(f) for f in block.features] for block in blocks]
        self.jitter = 0.0

    @staticmethod
    def pack(params: Parameters, blocks: Sequence[Block]) -> list[Tensor]:
        tensors = list(params.values())
        for block in blocks:
            tensors += [x for f in block.features for x in f.values()]
            tensors += [*block.operators, block.target]
        return tensors

    def unpack(self, tensors: Sequence[Tensor]) -> tuple[dict[str, Tensor], list[Block]]:
        flow = iter(t.detach() for t in tensors)
        params = {key: next(flow) for key in self.params}
        blocks = []
        for names in self.names:
            features = tuple({key: next(flow) for key in keys} for keys in names)
            operators = tuple(next(flow) for _ in names)
            blocks.append(Block(features, operators, next(flow)))
        return params, blocks

    @staticmethod
    def pack_gradient(gradient: GramGradient, alpha: Tensor, blocks: Sequence[Block]) -> list[Tensor]:
        tensors = list(gradient.params.values())
        for g, block in enumerate(blocks):
            tensors += [x for f in gradient.features[g] for x in f.values()]
            own, alpha = alpha[: block.rows], alpha[block.rows :]
            tensors += [*gradient.operators[g], own.reshape(block.target.shape)]
        return tensors


def negative_log_likelihood(
    priors: Sequence[Process], params: Parameters, blocks: Sequence[Block]
) -> tuple[Tensor, float]:
    """Negative log marginal likelihood of whitened rows, differentiable in all that it is made of.

    Args:
        priors: the force priors.
        params: log-hyperparameters, `<prior>.<name>`.
        blocks: whitened rows.

    Returns:
        The scalar, and the jitter that the factorisation needed.

    Raises:
        NumericalError: the covariance is not positive definite.
    """
    layout = _Layout(params, blocks)
    value = _NegativeLogLikelihood.apply(priors, layout, *layout.pack(params, blocks))
    return value, layout.jitter  # pyright: ignore[reportReturnType]
