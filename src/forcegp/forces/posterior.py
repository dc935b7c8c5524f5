"""The posterior over latent forces, and every other quantity read off it (eqs. 22 to 25)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, coupled, with_coulomb
from forcegp.forces.priors.base import ForceMean, ForcePrior, prior_rows
from forcegp.forces.quantities import AffineMap, States
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Features, Standardization
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.structured_covariance import Block

LatentPosterior = ExactPosterior | SparsePosterior
"""Latent processes conditioned on rows, exactly or through inducing points."""


@dataclass(frozen=True, eq=False)
class ForcePosterior:
    """Latent forces conditioned on data; independent of the constraint under which it is read.

    Attributes:
        priors, scales: the force priors and the standardization of their inputs.
        mean: prior mean of Q.
        latent: the conditioned processes.
        offsets: prior means of latent forces `(components,)`, by prior; zero where not named.
        central: processes that means are read from, where some forces are pinned to zero; `latent` by
            default.
        coulomb: friction of contacts that is proportional to the multiplier.
    """

    priors: tuple[ForcePrior, ...]
    scales: tuple[Standardization, ...]
    mean: ForceMean
    latent: LatentPosterior
    offsets: Mapping[str, Tensor] = field(default_factory=dict)
    central: LatentPosterior | None = None
    coulomb: tuple[CoulombFriction, ...] = ()

    def moves(self, p: int) -> bool:
        """Whether the posterior mean of the force of prior p can differ from zero."""
        if self.central is not None:
            return self.central.is_measured(p)
        return self.latent.is_measured(p) or self._has_offset(p)

    def latent_mean(self, p: int, features: Features) -> Tensor:
        """Posterior mean of the force of prior p at standardized features, `(n, components)`."""
        if self.central is not None:
            return self.central.latent_mean(p, features)
        mean = self.latent.latent_mean(p, features)
        return mean + self.offsets[self.priors[p].name] if self._has_offset(p) else mean

    def shift(self, p: int, features: Features) -> Tensor | float:
        """What samples of the latent force of prior p must be moved by to have the mean that is predicted."""
        if self.central is not None:
            return self.central.latent_mean(p, features) - self.latent.latent_mean(p, features)
        return self.offsets[self.priors[p].name] if self._has_offset(p) else 0.0

    def _has_offset(self, p: int) -> bool:
        return bool(self.offsets) and self.priors[p].name in self.offsets

    def features_of(self, p: int, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Standardized kernel inputs of prior p at states."""
        return self.scales[p].apply(self.priors[p].features(system, at))

    def total_force(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Posterior mean of Q̄ = m + Σ E f, `(n, nq)`: the force field of a rollout."""
        force = self.mean(system, at)
        pairs = [(p, prior) for p, prior in enumerate(self.priors) if self.moves(p)]
        parts = [(p, prior.features(system, at), prior.operator(system, at)) for p, prior in pairs]
        for p, x, E in parts:
            force = force + (E @ self.latent_mean(p, self.scales[p].apply(x))[..., None])[..., 0]
        return with_coulomb(system, at, force, self.coulomb) if self.coulomb else force

    def rows(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Block:
        """A quantity at n states as rows of the processes, with its prior mean as target.

        Args:
            system: robot and contacts.
            at: n states.
            z: the quantity, without Coulomb friction of contacts.
        """
        z = coupled(system, at, z, self.coulomb) if self.coulomb else z
        return prior_rows(self.priors, self.scales, self.mean, system, at, z)

    def mean_of(self, rows: Block) -> Tensor:
        """Posterior mean o + B(m + Σ E f) of rows, `(n, d)`."""
        mean = rows.target
        for p, W in enumerate(rows.operators):
            mean = mean + (W @ self.latent_mean(p, rows.features[p])[..., None])[..., 0]
        return mean

    def read_mean(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Tensor:
        """Posterior mean of a quantity at states, `(n, d)`."""
        return self.mean_of(self.rows(system, at, z))

    def read_covariance(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Tensor:
        """Posterior covariance of a quantity at each state, `(n, d, d)`, without measurement noise."""
        return self.latent.covariance(self.rows(system, at, z))
