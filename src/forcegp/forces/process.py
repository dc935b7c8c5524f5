"""The impressed forces before any data: a Gaussian process that the operators of the priors carry.

Q̄ = m + Σ_p E_p f_p with f_p ~ GP(0, k_p), and Coulomb friction of contacts, which goes with the multiplier.
Every quantity z = B_Q Q + B_z Q_z + o is an affine map of the latent forces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor
from torch.linalg import vecdot

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, coupled
from forcegp.forces.priors.base import CONSTRAINT, CONTACT, ForceMean, ForcePrior
from forcegp.forces.quantities import AffineMap, States
from forcegp.gp.features import Standardization
from forcegp.gp.structured_covariance import Block


@dataclass(frozen=True, eq=False)
class ForceProcess:
    """Priors on forces with what their operators have learned.

    Attributes:
        priors, scales: the force priors and the standardization of their inputs.
        mean: prior mean of Q.
        coulomb: friction of contacts that is proportional to the multiplier.
        pinned: by number of the prior, value `(components,)` of a constant latent force that the robot
            contains: its prior mean is minus this value, its posterior mean zero.
    """

    priors: tuple[ForcePrior, ...]
    scales: tuple[Standardization, ...]
    mean: ForceMean
    coulomb: tuple[CoulombFriction, ...] = ()
    pinned: Mapping[int, Tensor] = field(default_factory=dict)

    def features(self, p: int, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Standardized kernel inputs of prior p at states."""
        return self.scales[p].apply(self.priors[p].features(system, at))

    def coupled(self, system: ConstrainedSystem, at: States, z: AffineMap) -> AffineMap:
        """The affine map of a quantity with Coulomb friction of contacts."""
        return coupled(system, at, z, self.coulomb)

    def rows(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Block:
        """A quantity as rows of the latent forces.

        Args:
            system: robot and contacts.
            at: n states.
            z: the quantity, with Coulomb friction of contacts.

        Returns:
            Kernel inputs and operators B(x) E(x) of each prior, with o(x) + B(x) m(x) as target.
        """
        # E[z] = o + B_Q m (eq. 15)
        target = z.o + vecdot(z.B_Q, self.mean(system, at)[..., None, :])
        by_target = {CONTACT: z.B_z, CONSTRAINT: z.B_N}
        features, operators = [], []
        for p, prior in enumerate(self.priors):
            # W = B E (eq. 12), with E the identity for a prior per joint
            features.append(self.features(p, system, at))
            B = by_target.get(prior.target, z.B_Q)
            if B is None:
                operators.append(z.o.new_zeros(*z.o.shape, prior.outputs(system.robot)))
            else:
                operators.append(B if prior.per_joint else B @ prior.operator(system, at))
        return Block(tuple(features), tuple(operators), target)
