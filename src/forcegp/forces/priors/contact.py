"""Priors on the tangential force at a contact with a surface, whose inputs are those of the surface.

What touches knows no world axes: vectors along the surface have two coordinates in a tangent frame that turns
with the surface. The frame at normal n is (R e_x, R e_y), with the smallest rotation R that takes e_z to n.
So what is learned on one surface holds on one that is raised, tilted or curved.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.contact import ContactPoint, SurfaceContact
from forcegp.errors import ModelError
from forcegp.forces.priors.base import CONTACT, ForcePrior, check_inputs
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel

WIDTHS = {"position": 2, "velocity": 2, "speed": 1}
"""Columns of each input: tangential coordinates of the touching point [m] and of its velocity [m/s], and how
fast it slides [m/s]."""
FACING_DOWN = 1e-6
"""A normal is −e_z where 1 + n_z is below this; the smallest rotation has no direction there."""


def tangent_frame(n: Tensor) -> Tensor:
    """Two unit vectors along the surface at unit normals n `(*batch, 3)`, `(*batch, 3, 2)`.

    The columns are R e_x and R e_y with R e_z = n and the smallest rotation R = 1 + [w]ₓ + [w]ₓ²/(1 + n_z),
    w = e_z × n; at n = −e_z, half a turn about e_x.
    """
    x, y, z = n.unbind(-1)
    down = 1.0 + z < FACING_DOWN
    share = torch.where(down, 0.0, 1.0 / torch.where(down, 1.0, 1.0 + z))
    first = torch.stack([1.0 - x * x * share, -x * y * share, -x], dim=-1)
    second = torch.stack([-x * y * share, torch.where(down, -1.0, 1.0) - y * y * share, -y], dim=-1)
    return torch.stack([first, second], dim=-1)


@dataclass(frozen=True)
class SurfaceForcePrior(ForcePrior):
    """A force at a contact with a surface, where it is closed."""

    contact: str
    kernel: Kernel = field(default_factory=SquaredExponential)
    inputs: tuple[str, ...] = ("position", "velocity")
    name: str = ""
    target: str = CONTACT

    vectors = ("position", "velocity")

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or f"contact_{self.contact}")
        check_inputs(self.name, self.inputs, tuple(WIDTHS))

    def check(self, system: ConstrainedSystem) -> None:
        if not isinstance(system.contact(self.contact), SurfaceContact):
            raise ModelError(
                f"contact {self.contact!r} has no surface, so no tangential force",
                expected="a SurfaceContact",
                got=type(system.contact(self.contact)).__name__,
            )

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        if not system.contacts:
            return {name: at.q.new_zeros(len(at.q), WIDTHS[name]) for name in self.inputs}
        point = self._touching(system, at)
        return {name: _along(point, name) for name in self.inputs}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        if not system.contacts:
            return at.q.new_zeros(*at.q.shape, self.outputs(system.robot))
        self._touching(system, at)
        open_ = at.active[:, system.contact_names.index(self.contact)].logical_not()
        return self.directions(system, at).masked_fill(open_[:, None, None], 0.0)

    @abstractmethod
    def directions(self, system: ConstrainedSystem, at: States) -> Tensor:
        """E(x) `(n, nq, outputs)` where the contact is closed."""

    def _touching(self, system: ConstrainedSystem, at: States) -> ContactPoint:
        """The touching point; errors as of `check` where the contact has none."""
        if self.contact not in at.eom.contact_points:
            self.check(system)
        return at.eom.contact_points[self.contact]


def _along(point: ContactPoint, name: str) -> Tensor:
    """An input along the surface: `position` or `velocity` in the tangent frame, or the sliding `speed`."""
    if name == "speed":
        # The floor keeps the derivative of the root finite at rest.
        return point.sliding[1].square().sum(-1, keepdim=True).clamp(min=1e-30).sqrt()
    return (tangent_frame(point.unit_normal).mT @ getattr(point, name)[..., None])[..., 0]


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
        point = at.eom.contact_points[self.contact]
        return point.jacobian.mT @ tangent_frame(point.unit_normal)
