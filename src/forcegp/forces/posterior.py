"""The posterior over latent forces, and every other quantity read off it (eqs. 22 to 25)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, coupled, with_coulomb
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.projection import ForceMean, prior_mean, prior_operators
from forcegp.forces.quantities import AffineMap, States
from forcegp.gp.features import Features, Standardization
from forcegp.gp.pathwise import FunctionSamples
from forcegp.gp.structured_covariance import Block

CHUNK_COLUMNS = 700
"""Columns of the triangular solve that are held at a time."""


@runtime_checkable
class LatentPosterior(Protocol):
    """Latent processes conditioned on rows, exactly or through inducing points."""

    def is_measured(self, p: int) -> bool:
        """Whether any row depends on process p; where none does, its posterior is its prior."""
        ...

    def latent_mean(self, p: int, features: Features) -> Tensor:
        """Posterior mean of process p, `(n, components)`."""
        ...

    def covariance(self, block: Block) -> Tensor:
        """Posterior covariance of the rows of each sample of a block, `(n, r, r)`."""
        ...

    def draw(self, count: int, generator: torch.Generator, features: int) -> FunctionSamples:
        """Functions from the posterior."""
        ...


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

    def latent_mean(self, p: int, system: ConstrainedSystem, at: States) -> Tensor | None:
        """Posterior mean of the force of prior p, `(n, components)`; `None` where it is zero."""
        if self.central is not None:
            if not self.central.is_measured(p):
                return None
            return self.central.latent_mean(p, self.features_of(p, system, at))
        return self._own_mean(p, system, at)

    def _own_mean(self, p: int, system: ConstrainedSystem, at: States) -> Tensor | None:
        """Posterior mean where no force is pinned."""
        offset = self.offsets.get(self.priors[p].name)
        if not self.latent.is_measured(p):
            return None if offset is None else offset.expand(len(at.q), -1)
        mean = self.latent.latent_mean(p, self.features_of(p, system, at))
        return mean if offset is None else mean + offset

    def shift(self, p: int, system: ConstrainedSystem, at: States) -> Tensor | float:
        """What samples of the latent force of prior p must be moved by to have the mean that is predicted."""
        if self.central is None:
            return self.offsets.get(self.priors[p].name, 0.0)
        mean, own = self.latent_mean(p, system, at), self._own_mean(p, system, at)
        offset = self.offsets.get(self.priors[p].name, 0.0)
        return (0.0 if mean is None else mean) - (0.0 if own is None else own) + offset

    def features_of(self, p: int, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Standardized kernel inputs of prior p at states."""
        return self.scales[p].apply(self.priors[p].features(system, at))

    def total_force(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Posterior mean of Q̄ = m + Σ E f, `(n, nq)`: the force field of a rollout."""
        force = self.mean(system, at)
        for p, prior in enumerate(self.priors):
            latent = self.latent_mean(p, system, at)
            if latent is not None:
                force = force + (prior.operator(system, at) @ latent[..., None])[..., 0]
        return with_coulomb(system, at, force, self.coulomb)

    def read_mean(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Tensor:
        """Posterior mean of a quantity, o + B(m + Σ E f), `(n, d)`."""
        z = coupled(system, at, z, self.coulomb)
        mean = prior_mean(system, at, z, self.mean)
        for p, prior in enumerate(self.priors):
            latent = self.latent_mean(p, system, at)
            if latent is not None:
                (W,) = prior_operators([prior], system, at, z)
                mean = mean + (W @ latent[..., None])[..., 0]
        return mean

    def read_covariance(
        self,
        system: ConstrainedSystem,
        at: States,
        z: AffineMap,
        without: Sequence[str] = (),
    ) -> Tensor:
        """Posterior covariance of a quantity at each state, `(n, d, d)`, without measurement noise.

        Args:
            system: robot and contacts.
            at: n states.
            z: the quantity.
            without: targets of priors that are left out.
        """
        z = coupled(system, at, z, self.coulomb)
        operators = [
            torch.zeros_like(W) if prior.target in without else W
            for prior, W in zip(self.priors, prior_operators(self.priors, system, at, z), strict=True)
        ]
        features = [self.features_of(p, system, at) for p in range(len(self.priors))]
        n, d = z.o.shape
        step = max(1, CHUNK_COLUMNS // max(d, 1))
        parts = []
        for i in range(0, n, step):
            rows = slice(i, i + step)
            block = Block(
                tuple({key: x[rows] for key, x in f.items()} for f in features),
                tuple(W[rows] for W in operators),
                z.o[rows],
            )
            parts.append(self.latent.covariance(block))
        return torch.cat(parts) if parts else z.o.new_zeros(0, d, d)
