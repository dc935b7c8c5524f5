"""A prior on any force at a contact that is tangential to the surface."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.priors.surface_force import SurfaceForcePrior, tangent_frame
from forcegp.forces.quantities import States
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class ContactForcePrior(SurfaceForcePrior):
    """A prior on the dissipative force F_z at a contact, F_z = t_1 f_1 + t_2 f_2 along the surface.

    E = J_Eᵀ (t_1, t_2) where the contact is closed and 0 elsewhere, as in a system without contacts; t_1 and
    t_2 span the surface at the touching point and turn with it (`tangent_frame`).

    Args:
        contact: name of a surface contact of the system.
        kernel: covariance of each component.
        inputs: which of `position`, `velocity` and `speed` of the touching point along the surface the force
            depends on.
        name: prefix of the hyperparameters; the contact's name by default.

    Example:
        >>> ContactForcePrior("table").target
        'contact'

    Raises:
        UnknownNameError: an input is not one of the three.
    """

    def outputs(self, robot: RobotModel) -> int:
        return 2

    def directions(self, system: ConstrainedSystem, at: States) -> Tensor:
        return at.eom.contact_points[self.contact].jacobian.mT @ tangent_frame(self.normal(at))
