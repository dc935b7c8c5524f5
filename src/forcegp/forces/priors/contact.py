"""Priors on the dissipative force F_z at a contact with a surface: any tangential one, or friction alone."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.functional import normalize

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.contact import SurfaceContact
from forcegp.errors import ModelError
from forcegp.forces.priors.base import CONTACT, ForcePrior, check_inputs
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel
from forcegp.gp.stationary import SquaredExponential
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class SurfaceForcePrior(ForcePrior):
    """A force at a contact with a surface, where it is closed; inputs are those of the touching point."""

    contact: str
    kernel: Kernel = field(default_factory=SquaredExponential)
    inputs: tuple[str, ...] = ("position", "velocity")
    name: str = ""
    target: str = CONTACT

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or f"contact_{self.contact}")
        check_inputs(self.name, self.inputs, ("position", "velocity"))

    def check(self, system: ConstrainedSystem) -> None:
        if not isinstance(system.contact(self.contact), SurfaceContact):
            raise ModelError(
                f"contact {self.contact!r} has no surface, so no tangential force",
                expected="a SurfaceContact",
                got=type(system.contact(self.contact)).__name__,
            )

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        if not system.contacts:
            return {name: at.q.new_zeros(len(at.q), 3) for name in self.inputs}
        self.check(system)
        point = at.eom.contact_points[self.contact]
        return {name: getattr(point, name) for name in self.inputs}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        if not system.contacts:
            return at.q.new_zeros(*at.q.shape, self.outputs(system.robot))
        self.check(system)
        closed = at.active[:, system.contact_names.index(self.contact)]
        return torch.where(closed[:, None, None], self.directions(at), 0.0)

    @abstractmethod
    def directions(self, at: States) -> Tensor:
        """E(x) `(n, nq, outputs)` where the contact is closed."""

    def _tangential(self, at: States) -> Tensor:
        """(1 − n nᵀ) J_E `(n, 3, nq)`."""
        point = at.eom.contact_points[self.contact]
        n = normalize(point.normal, dim=-1)
        return point.jacobian - n[..., :, None] * (n[..., None, :] @ point.jacobian)


@dataclass(frozen=True)
class ContactForcePrior(SurfaceForcePrior):
    """A prior on the Cartesian dissipative force F_z at a contact, tangential to the surface.

    E = J_Eᵀ (1 − n nᵀ) where the contact is closed and 0 elsewhere, as in a system without contacts; the
    inputs are the position and velocity of the touching point.

    Args:
        contact: name of a surface contact of the system.
        kernel: covariance of each Cartesian component.
        inputs: which of `position`, `velocity` the force depends on.
        name: prefix of the hyperparameters; the contact's name by default.

    Raises:
        UnknownNameError: an input is not one of the two.
    """

    def outputs(self, robot: RobotModel) -> int:
        return 3

    def directions(self, at: States) -> Tensor:
        return self._tangential(at).mT


@dataclass(frozen=True)
class SlidingFrictionPrior(SurfaceForcePrior):
    """A prior on the friction that opposes sliding: F_z = −(θ_v + θ_d / √(|v|² + ε²)) v, v = (1 − n nᵀ) ṗ_E.

    The unknowns are two scalar functions of the touching point, viscous friction θ_v [N s/m] and dry friction
    θ_d [N], which is smooth below the speed ε. Two scalars whose direction is known take fewer points than
    the components of a force in space.

    Args:
        contact: name of a surface contact of the system.
        kernel: covariance of θ_v and of θ_d.
        inputs: which of `position`, `velocity` they depend on.
        name: prefix of the hyperparameters; the contact's name by default.
        smoothing: ε [m/s].

    Raises:
        UnknownNameError: an input is not one of the two.
        ModelError: ε is not positive.
    """

    kernel: Kernel = field(default_factory=lambda: SquaredExponential(shared=True))
    smoothing: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.smoothing < float("inf"):
            raise ModelError(
                f"force prior {self.name!r} has no such smoothing speed",
                expected="a positive finite speed [m/s]",
                got=self.smoothing,
            )

    def outputs(self, robot: RobotModel) -> int:
        return 2

    def directions(self, at: States) -> Tensor:
        J = self._tangential(at)
        v = (J @ at.qd[..., None])[..., 0]
        speed = (v.square().sum(-1, keepdim=True) + self.smoothing**2).sqrt()
        return -J.mT @ torch.stack([v, v / speed], dim=-1)
