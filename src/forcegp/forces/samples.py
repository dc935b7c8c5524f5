"""Functions drawn from the posterior over forces, cheap to evaluate anywhere (pathwise conditioning).

A prior function is drawn with random features and corrected by the data, Matheron's rule:
f_post(x) = f_prior(x) + k(x, X) Wᵀ (K + I)⁻¹ (y − W f_prior(X) − ε) (Wilson et al. 2020). Each sample is one
deterministic force function, so a trajectory integrated under it obeys Newton's equation and the
constraint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.states import States
from forcegp.gp.kernels import Features, FunctionDraw, sub
from forcegp.gp.likelihood import target_of

FEATURES = 1024
"""Random features an output; the covariance of the prior draws errs by about 1/√FEATURES of its scale."""

CHUNK_STATES = 48
"""States at which samples are evaluated at once, so that intermediate arrays stay small."""

UNMEASURED = 4
"""How many times fewer of them a prior has whose force no row shows."""


@dataclass(frozen=True, eq=False)
class PosteriorSamples:
    """Functions drawn from the posterior over latent forces.

    Attributes:
        posterior: what they are drawn from.
        draws: random features of each prior.
        feature_weights: of each prior, `(components, features, samples)`.
        data_weights: of each prior and block, `(components, n, samples)`; none where no row shows the force.
    """

    posterior: ForcePosterior
    draws: tuple[FunctionDraw, ...]
    feature_weights: tuple[Tensor, ...]
    data_weights: tuple[tuple[Tensor, ...], ...]

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.feature_weights[0].shape[-1]

    def latent(self, p: int, features: Features, sample: Tensor | None = None) -> Tensor:
        """Forces of prior p.

        Args:
            p: index of the prior.
            features: its standardized inputs at n states.
            sample: `(n,)` which sample each state belongs to; all samples at all states by default.

        Returns:
            `(samples, n, components)`, or `(n, components)` where `sample` is given.
        """
        weights = (self.feature_weights[p], *self.data_weights[p])
        terms = list(zip(self._bases(p, features), weights, strict=True))
        if sample is None:
            return sum((k @ w for k, w in terms[1:]), start=terms[0][0] @ terms[0][1]).permute(2, 1, 0)
        rows = torch.stack([torch.einsum("knj,kjn->nk", k, w[..., sample]) for k, w in terms])
        return rows.sum(0)

    def _bases(self, p: int, features: Features) -> list[Tensor]:
        """Random features of prior p, and its covariances with the data that show it."""
        measured = self.posterior.measured[p]
        kernels = self.posterior.kernels_to_data[p] if measured else []
        return [self.draws[p].basis(features), *(kernel(features) for kernel in kernels)]

    def forces(
        self, system: ConstrainedSystem, at: States, sample: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Sampled joint force Q and dissipative contact force Q_z.

        Args:
            system: robot and contacts.
            at: n states.
            sample: `(n,)` which sample each state belongs to; all samples at all states by default.

        Returns:
            Q and Q_z `(samples, n, nq)`, or `(n, nq)` where `sample` is given [N m, N].
        """
        Q = self.posterior.mean(system, at)
        Q = Q if sample is not None else Q.expand(self.count, *Q.shape)
        Q_z = torch.zeros_like(Q)
        for p, features in enumerate(self.posterior.features(system, at)):
            prior = self.posterior.priors[p]
            force = (prior.operator(system, at) @ self.latent(p, features, sample)[..., None])[..., 0]
            Q, Q_z = (Q, Q_z + force) if prior.in_contact_only else (Q + force, Q_z)
        return Q, Q_z

    @cached_property
    def _weights_by_sample(self) -> list[list[Tensor]]:
        """By prior, `(components, samples, terms, 1)` weights of the features and of each block's data."""
        pairs = zip(self.feature_weights, self.data_weights, strict=True)
        return [[w.mT.contiguous()[..., None] for w in (own, *data)] for own, data in pairs]

    def total_force(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Q̄ = Q + Q_z of one sample a trajectory, the force field of a rollout.

        Args:
            system: robot and contacts.
            at: samples × k states, of which the s-th run of k belongs to sample s.

        Returns:
            `(samples · k, nq)` [N m, N].
        """
        Q_bar = self.posterior.mean(system, at)
        runs = len(at.q) // self.count
        step = max(1, CHUNK_STATES // max(runs, 1))
        chunks = [range(i, min(i + step, self.count)) for i in range(0, self.count, step)]
        for p, features in enumerate(self.posterior.features(system, at)):
            force = torch.cat([self._own_force(p, features, samples, runs) for samples in chunks])
            E = self.posterior.priors[p].operator(system, at)
            Q_bar = Q_bar + (E @ force[..., None])[..., 0]
        return Q_bar

    def _own_force(self, p: int, features: Features, samples: range, runs: int) -> Tensor:
        """Forces of prior p from some samples, each at its own runs: `(samples · runs, components)`."""
        own = slice(samples.start * runs, samples.stop * runs)
        bases = self._bases(p, {name: x[own] for name, x in features.items()})
        parts = [
            k.unflatten(1, (len(samples), runs)) @ w[:, samples.start : samples.stop]
            for k, w in zip(bases, self._weights_by_sample[p], strict=True)
        ]
        return sum(parts[1:], start=parts[0])[..., 0].flatten(1).mT


def draw_samples(
    posterior: ForcePosterior, count: int, generator: torch.Generator, features: int = FEATURES
) -> PosteriorSamples:
    """Draw functions from the posterior over forces.

    Args:
        posterior: what to draw from.
        count: number of functions.
        generator: source of randomness, on the CPU.
        features: random features an output.
    """
    like = posterior.alpha
    draws, weights, prior_at_data = (
        [],
        [],
        torch.zeros(len(like), count, dtype=like.dtype, device=like.device),
    )
    for p, prior in enumerate(posterior.priors):
        # The data do not correct what no row shows: its prior need be no better than its hyperparameters.
        own = features if posterior.measured[p] else max(1, features // UNMEASURED)
        draw = prior.kernel.draw(sub(posterior.params, prior.prefix), own, generator)
        size = draw.basis(posterior.blocks[0].features[p]).shape
        w = torch.randn(size[0], size[2], count, dtype=torch.float64, generator=generator).to(like)
        rows = [
            torch.einsum("nak,kns->nas", block.operators[p], draw.basis(block.features[p]) @ w).flatten(0, 1)
            for block in posterior.blocks
        ]
        prior_at_data += torch.cat(rows)
        draws.append(draw)
        weights.append(w)
    noise = torch.randn(len(like), count, dtype=torch.float64, generator=generator).to(like)
    residual = target_of(posterior.blocks)[:, None] - prior_at_data - noise
    alpha = torch.cholesky_solve(residual, posterior.conditioned.L)
    data_weights: list[list[Tensor]] = [[] for _ in posterior.priors]
    first = 0
    for block in posterior.blocks:
        own = alpha[first : first + block.rows].unflatten(0, block.target.shape)
        first += block.rows
        for p, W in enumerate(block.operators):
            if posterior.measured[p]:
                data_weights[p].append(torch.einsum("nak,nas->kns", W, own))
    return PosteriorSamples(posterior, tuple(draws), tuple(weights), tuple(tuple(w) for w in data_weights))
