"""The posterior over latent forces, and every other quantity read off it (eqs. 22 to 25)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.projection import ForceMean, prior_mean, prior_operators
from forcegp.forces.quantities import AffineMap
from forcegp.forces.states import States
from forcegp.gp.kernels import Features, sub
from forcegp.gp.likelihood import Conditioned, condition
from forcegp.gp.standardization import Standardization
from forcegp.gp.structured_covariance import Block, cross_gram

CHUNK_COLUMNS = 700
"""Columns of the triangular solve that are held at a time."""


@dataclass(frozen=True, eq=False)
class ForcePosterior:
    """Latent forces conditioned on whitened rows; independent of the constraint that it is read on.

    Attributes:
        priors, scales: the force priors and the standardization of their inputs.
        params: log-hyperparameters.
        blocks: the rows conditioned on.
        mean: prior mean of Q.
        alpha: (K + I)⁻¹ y `(rows,)`.
    """

    priors: tuple[ForcePrior, ...]
    scales: tuple[Standardization, ...]
    params: dict[str, Tensor]
    blocks: list[Block]
    mean: ForceMean
    alpha: Tensor

    @cached_property
    def conditioned(self) -> Conditioned:
        """Factorisation of the rows' covariance, computed when a covariance is first asked for."""
        return condition(self.priors, self.params, self.blocks)

    @cached_property
    def weights(self) -> list[list[Tensor]]:
        """By prior and block, `(components, n)`: the latent mean is k(x, X) times these weights."""
        weights: list[list[Tensor]] = [[] for _ in self.priors]
        first = 0
        for block in self.blocks:
            alpha = self.alpha[first : first + block.rows].reshape(block.target.shape)
            first += block.rows
            for p, W in enumerate(block.operators):
                weights[p].append(torch.einsum("nak,na->kn", W, alpha))
        return weights

    @cached_property
    def kernels_to_data(self) -> list[list[Callable[[Features], Tensor]]]:
        """By prior and block, x ↦ k(x, X)."""
        return [
            [prior.kernel.towards(sub(self.params, prior.prefix), block.features[p]) for block in self.blocks]
            for p, prior in enumerate(self.priors)
        ]

    def features(self, system: ConstrainedSystem, at: States) -> tuple[dict[str, Tensor], ...]:
        """Standardized kernel inputs of each prior at states."""
        return tuple(self.features_of(p, system, at) for p in range(len(self.priors)))

    def features_of(self, p: int, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Standardized kernel inputs of prior p at states."""
        return self.scales[p].apply(self.priors[p].features(system, at))

    @cached_property
    def measured(self) -> tuple[bool, ...]:
        """Of each prior, whether any row shows its force; the data change nothing about the others."""
        return tuple(
            any(bool(block.operators[p].any()) for block in self.blocks) for p in range(len(self.priors))
        )

    def latent_mean(self, p: int, features: Features) -> Tensor:
        """Posterior mean of the force of prior p, without its prior mean, `(n, components)`."""
        parts = [
            (kernel(features) @ w[..., None])[..., 0]
            for kernel, w in zip(self.kernels_to_data[p], self.weights[p], strict=True)
        ]
        return sum(parts[1:], start=parts[0]).mT

    def total_force(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Posterior mean of Q̄ = m + Σ E f, `(n, nq)`: the force field of a rollout."""
        force = self.mean(system, at)
        for p, prior in enumerate(self.priors):
            if self.measured[p]:
                latent = self.latent_mean(p, self.features_of(p, system, at))
                force = force + (prior.operator(system, at) @ latent[..., None])[..., 0]
        return force

    def read_mean(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Tensor:
        """Posterior mean of a quantity, o + B(m + Σ E f), `(n, d)`."""
        mean = prior_mean(system, at, z, self.mean)
        for p, prior in enumerate(self.priors):
            if self.measured[p]:
                (W,) = prior_operators([prior], system, at, z)
                latent = self.latent_mean(p, self.features_of(p, system, at))
                mean = mean + (W @ latent[..., None])[..., 0]
        return mean

    def read_covariance(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Tensor:
        """Posterior covariance of a quantity at each state, `(n, d, d)`, without measurement noise."""
        operators = prior_operators(self.priors, system, at, z)
        features = self.features(system, at)
        n, d = z.o.shape
        parts = []
        step = max(1, CHUNK_COLUMNS // max(d, 1))
        for i in range(0, n, step):
            rows = slice(i, i + step)
            block = Block(
                tuple({key: x[rows] for key, x in f.items()} for f in features),
                tuple(W[rows] for W in operators),
                z.o[rows],
            )
            parts.append(self._block_covariance(block))
        return torch.cat(parts) if parts else z.o.new_zeros(0, d, d)

    def _block_covariance(self, block: Block) -> Tensor:
        n, d = block.target.shape
        prior = sum(
            torch.einsum("nak,kn,nbk->nab", W, self._prior_variance(p, block.features[p]), W)
            for p, W in enumerate(block.operators)
        )
        cross = cross_gram(self.priors, self.params, self.blocks, [block])
        V = torch.linalg.solve_triangular(self.conditioned.L, cross, upper=False)
        V = V.reshape(len(V), n, d).transpose(0, 1)
        covariance = prior - V.mT @ V
        return 0.5 * (covariance + covariance.mT)

    def _prior_variance(self, p: int, features: Features) -> Tensor:
        return self.priors[p].kernel.diagonal(sub(self.params, self.priors[p].prefix), features)


def posterior(
    priors: Sequence[ForcePrior],
    scales: Sequence[Standardization],
    params: dict[str, Tensor],
    blocks: list[Block],
    mean: ForceMean,
) -> ForcePosterior:
    """Condition latent forces on whitened rows.

    Raises:
        NumericalError: the covariance of the rows is not positive definite.
    """
    fit = condition(priors, params, blocks)
    result = ForcePosterior(tuple(priors), tuple(scales), params, blocks, mean, fit.alpha)
    result.__dict__["conditioned"] = fit
    return result
