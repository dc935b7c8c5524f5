"""The posterior over latent forces, which determines every other quantity (eqs. 22 to 25), and samples of it.

Each force function drawn from the posterior is a deterministic force field that can be integrated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, coupled, with_coulomb
from forcegp.forces.priors.base import CONTACT, ForceMean, ForcePrior, prior_rows
from forcegp.forces.quantities import AffineMap, States
from forcegp.gp.draws import FunctionSamples
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Block, Features, Standardization
from forcegp.gp.sparse import SparsePosterior

LatentPosterior = ExactPosterior | SparsePosterior
"""Latent processes conditioned on rows, exactly or through inducing points."""


@dataclass(frozen=True, eq=False)
class ForcePosterior:
    """Latent forces conditioned on data; independent of the constraint under which it is read.

    Attributes:
        priors, scales: the force priors and the standardization of their inputs.
        mean: prior mean of Q.
        latent: the conditioned processes.
        pinned: by number of the prior, value `(components,)` of a constant latent force that the robot
            contains: it has mean zero, and only its uncertainty remains.
        coulomb: friction of contacts that is proportional to the multiplier.
    """

    priors: tuple[ForcePrior, ...]
    scales: tuple[Standardization, ...]
    mean: ForceMean
    latent: LatentPosterior
    pinned: Mapping[int, Tensor] = field(default_factory=dict)
    coulomb: tuple[CoulombFriction, ...] = ()

    def shift(self, p: int, features: Features) -> Tensor | float:
        """What samples of the latent force of prior p must be moved by to have the mean that is predicted."""
        if not self.pinned:
            return 0.0
        return self.means.latent_mean(p, features) - self.latent.latent_mean(p, features)

    @cached_property
    def means(self) -> LatentPosterior:
        """The processes that means are read from: those given the forces that the robot contains."""
        means = self.latent
        for p, value in self.pinned.items():
            means = means.knowing(p, {"one": value.new_zeros(1, 1)}, value)
        return means

    def features_of(self, p: int, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Standardized kernel inputs of prior p at states."""
        return self.scales[p].apply(self.priors[p].features(system, at))

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Posterior mean of Q̄ = Σ E f + m, `(n, nq)`: the force field of a rollout."""
        force = self.unknown_force(system, at, range(len(self.priors))) + self.mean(system, at)
        return with_coulomb(system, at, force, self.coulomb) if self.coulomb else force

    def unknown_force(self, system: ConstrainedSystem, at: States, priors: Iterable[int]) -> Tensor | float:
        """Posterior mean of Σ E f over some priors, `(n, nq)`, without Coulomb friction of contacts."""
        # Σ_p E_p μ_p
        means = self.means
        pairs = [(p, self.priors[p]) for p in priors if means.measured[p]]
        parts = [(p, prior.features(system, at), prior.operator(system, at)) for p, prior in pairs]
        force: Tensor | float = 0.0
        for p, x, E in parts:
            force = force + (E @ means.latent_mean(p, self.scales[p].apply(x))[..., None])[..., 0]
        return force

    def rows(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Block:
        """A quantity at n states as rows of the processes, with its prior mean as target.

        Args:
            system: robot and contacts.
            at: n states.
            z: the quantity, without Coulomb friction of contacts.
        """
        # W = B E, target o + B m (eqs. 12 and 15)
        z = coupled(system, at, z, self.coulomb) if self.coulomb else z
        return prior_rows(self.priors, self.scales, self.mean, system, at, z)

    def read(self, system: ConstrainedSystem, at: States, z: AffineMap) -> tuple[Tensor, Tensor]:
        """Posterior mean `(n, d)` and covariance `(n, d, d)` of a quantity, without measurement noise."""
        # o + B (m + Σ E μ), and W Cov(f) Wᵀ (eqs. 23 to 25)
        rows = self.rows(system, at, z)
        return rows.target + self.means.mean(rows), self.latent.covariance(rows)

    def read_mean(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Tensor:
        """Posterior mean o + B(m + Σ E f) of a quantity at states, `(n, d)`."""
        rows = self.rows(system, at, z)
        return rows.target + self.means.mean(rows)


CHUNK_STATES = 256
"""States at which samples are evaluated at once, so that intermediate arrays stay in the cache."""


@dataclass(frozen=True, eq=False)
class ForceSamples:
    """Forces drawn from the posterior.

    Attributes:
        posterior: what they are drawn from.
        functions: the latent functions.
    """

    posterior: ForcePosterior
    functions: FunctionSamples

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.functions.count

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
        # Q = m + Σ E f over joint forces, Q_z = Σ E f over contact forces (eq. 18)
        Q = self.posterior.mean(system, at)
        Q = Q if sample is not None else Q.expand(self.count, *Q.shape)
        Q_z = torch.zeros_like(Q)
        for p, prior in enumerate(self.posterior.priors):
            features = self.posterior.features_of(p, system, at)
            latent = self.functions.latent(p, features, sample) + self.posterior.shift(p, features)
            force = (prior.operator(system, at) @ latent[..., None])[..., 0]
            Q, Q_z = (Q, Q_z + force) if prior.target == CONTACT else (Q + force, Q_z)
        # Q_z ← Q̄ − Q, with Coulomb friction in Q̄
        return Q, with_coulomb(system, at, Q + Q_z, self.posterior.coulomb) - Q

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Q̄ = Q + Q_z of one sample per trajectory, the force field of a rollout.

        Args:
            system: robot and contacts.
            at: samples × k states, of which the s-th run of k belongs to sample s.

        Returns:
            `(samples · k, nq)` [N m, N].
        """
        # Q̄ = m + Σ E f
        priors = range(len(self.posterior.priors))
        Q_bar = self.posterior.mean(system, at) + self.unknown_force(system, at, priors)
        return with_coulomb(system, at, Q_bar, self.posterior.coulomb)

    def unknown_force(self, system: ConstrainedSystem, at: States, priors: Iterable[int]) -> Tensor | float:
        """Σ E f over some priors, without Coulomb friction of contacts."""
        unknown: Tensor | float = 0.0
        runs = len(at.q) // self.count
        step = max(1, CHUNK_STATES // max(runs, 1))
        chunks = [range(i, min(i + step, self.count)) for i in range(0, self.count, step)]
        for p in priors:
            prior, features = self.posterior.priors[p], self.posterior.features_of(p, system, at)
            force = torch.cat(
                [
                    self.functions.by_runs(
                        p,
                        {n: x[chunk.start * runs : chunk.stop * runs] for n, x in features.items()},
                        chunk,
                        runs,
                    )
                    for chunk in chunks
                ]
            )
            force = force + self.posterior.shift(p, features)
            unknown = unknown + (prior.operator(system, at) @ force[..., None])[..., 0]
        return unknown


def draw_samples(
    posterior: ForcePosterior, count: int, generator: torch.Generator, features: int | None = None
) -> ForceSamples:
    """Draw force functions from the posterior.

    Args:
        posterior: what to draw from.
        count: number of functions.
        generator: source of randomness, on the CPU.
        features: random features per component; by default as many as the kind of posterior needs.
    """
    size = () if features is None else (features,)
    return ForceSamples(posterior, posterior.latent.draw(count, generator, *size))
