"""Priors on the force at a contact with a surface: along it, or against it, which no acceleration shows.

What touches knows no world axes: vectors along the surface have two coordinates in a tangent frame that turns
with the surface. The frame at normal n is (R e_x, R e_y), with the smallest rotation R that takes e_z to n.
So what is learned on one surface holds on one that is raised, tilted or curved.

Friction proportional to the normal force couples force and multiplier. With one contact, u = −J_Eᵀ s(v) and
g = Lᵀ u, the equations λ = λ_K − Lᵀ Q_z and Q_z = μ λ u have the solution λ = λ_K / (1 + μ g), where λ_K is
the multiplier without friction. A latent function must enter the force linearly, and μ does not: the operator
is the secant at a given μ̂, u λ_K / (1 + μ̂ g).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.contact import SurfaceContact
from forcegp.constraints.gauss import ContactPoint
from forcegp.errors import ModelError
from forcegp.forces.priors.base import CONSTRAINT, CONTACT, ForcePrior, check_inputs
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel

WIDTHS = {"position": 2, "velocity": 2, "speed": 1}
"""Columns of each input: tangential coordinates of the touching point [m] and of its velocity [m/s], and how
fast it slides [m/s]."""
FACING_DOWN = 1e-6
"""A normal is −e_z where 1 + n_z is below this; the smallest rotation has no direction there."""
TERMS = ("viscous", "dry", "coulomb", "stribeck", "torsion")
"""Kinds of friction, in the order of the components of the latent function."""
LOADED = ("coulomb", "stribeck", "torsion")
"""Kinds that are proportional to the multiplier."""


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


@dataclass(frozen=True)
class SlidingFrictionPrior(SurfaceForcePrior):
    """A prior on the friction that opposes sliding, with v = (1 − n nᵀ) ṗ_E and s(v) = v / √(|v|² + ε²).

    F_z = −θ_v v − (θ_d + λ (μ + μ_s e^{−|v|²/v_s²})) s(v), and the moment −θ_t λ s(ω_n) n about the normal.

    The unknowns are the scalar functions named in `terms`: `viscous` θ_v [N s/m], `dry` θ_d [N], `coulomb` μ,
    `stribeck` μ_s, `torsion` θ_t [m]. They take fewer points than the components of a force. They depend on
    the sliding speed by default, so they hold on surfaces of any place, tilt and shape.

    λ = max(λ_K, 0) / (1 + μ̂ g) with the multiplier λ_K of the analytical forces Q_K + τ without friction and
    g = −Lᵀ J_Eᵀ s(v). This is exact for one contact whose friction is −μ̂ λ s(v). Otherwise it misses terms
    of second order: μ (μ − μ̂), μ times any other friction of the contact, and μ times unknown joint forces or
    the friction of other contacts. Where unknown joint forces are large, prefer `dry`, or learn them as
    analytical parameters, which λ_K follows.

    Args:
        contact: name of a surface contact of the system.
        kernel: covariance of each unknown.
        inputs: which of `position`, `velocity`, `speed` they depend on.
        name: prefix of the hyperparameters; the contact's name by default.
        smoothing: ε [m/s].
        terms: kinds of friction.
        friction_coefficient: μ̂.
        stribeck_speed: v_s [m/s].
        torsion_smoothing: rate of turning about the normal below which torsional friction is smooth [rad/s].
        coupled: whether Coulomb friction −μ λ s(v) with a constant μ, which is learned together with its ε,
            is part of the mechanics beside the functions in `terms` (`forces/coulomb.py`).

    Raises:
        UnknownNameError: an input or a kind of friction is not known.
        ModelError: a speed is not positive, or the friction coefficient is negative.

    Example:
        >>> SlidingFrictionPrior("table", terms=("viscous", "coulomb")).terms
        ('viscous', 'coulomb')
    """

    kernel: Kernel = field(default_factory=lambda: SquaredExponential(shared=True))
    inputs: tuple[str, ...] = ("speed",)
    smoothing: float = 0.01
    terms: tuple[str, ...] = ("viscous", "dry")
    friction_coefficient: float = 0.0
    stribeck_speed: float = 0.05
    torsion_smoothing: float = 0.1
    coupled: bool = False

    commensurate = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_inputs(f"{self.name}.terms", self.terms, TERMS)
        if len(set(self.terms)) < len(self.terms):
            raise ModelError(f"force prior {self.name!r} has a kind of friction twice", got=self.terms)
        speeds = {"smoothing speed": self.smoothing, "Stribeck speed": self.stribeck_speed}
        for what, value in (speeds | {"torsional smoothing speed": self.torsion_smoothing}).items():
            if not 0.0 < value < float("inf"):
                raise ModelError(
                    f"force prior {self.name!r} has no such {what}",
                    expected="a positive finite speed [m/s, rad/s]",
                    got=value,
                )
        if not 0.0 <= self.friction_coefficient < float("inf"):
            raise ModelError(
                f"force prior {self.name!r} has no such friction coefficient",
                expected="a finite number, 0 or above",
                got=self.friction_coefficient,
            )

    def outputs(self, robot: RobotModel) -> int:
        return len(self.terms)

    def directions(self, system: ConstrainedSystem, at: States) -> Tensor:
        J, v = at.eom.contact_points[self.contact].sliding
        square = v.square().sum(-1, keepdim=True)
        against = -vecdot(J, v[..., None], dim=-2)
        dry = against / (square + self.smoothing**2).sqrt()
        columns = {"viscous": against, "dry": dry}
        if set(self.terms) & set(LOADED):
            load = self._load(system, at, dry)
            columns["coulomb"] = load * dry
            columns["stribeck"] = columns["coulomb"] * torch.exp(-square / self.stribeck_speed**2)
            if "torsion" in self.terms:
                columns["torsion"] = load * self._spin(system, at)
        return torch.stack([columns[term] for term in self.terms], dim=-1)

    def _load(self, system: ConstrainedSystem, at: States, u: Tensor) -> Tensor:
        """The multiplier of the analytical forces with the friction μ̂ λ u, `(n, 1)`.

        Raises:
            ModelError: with this friction the contact jams.
        """
        contact = system.contact_names.index(self.contact)
        row = sum(c.rows for c in system.contacts[:contact])
        free = at.eom.multiplier(at.eom.Q_K + at.tau)[:, row].clamp(min=0.0)
        gain = 1.0 + self.friction_coefficient * (at.eom.L[..., row] * u).sum(-1)
        if bool((gain[at.active[:, contact]] <= 0.0).any()):
            raise ModelError(
                f"contact {self.contact!r} jams with a friction coefficient of {self.friction_coefficient:g}",
                hint="friction would press harder than it opposes: give a smaller friction_coefficient",
            )
        return (free / gain)[:, None]

    def _spin(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Generalized force of a unit moment against the rotation about the normal, `(n, nq)`."""
        contact = system.contact(self.contact)
        assert isinstance(contact, SurfaceContact)
        index, origin = (
            system.robot.frame_index(contact.frame),
            kinematics.as_point(system.robot, contact.point),
        )
        angular = kinematics.jacobian_of_poses(system.robot, at.eom.poses, index, origin)[..., :3, :]
        about = (at.eom.contact_points[self.contact].unit_normal[..., None, :] @ angular)[..., 0, :]
        rate = (about * at.qd).sum(-1, keepdim=True)
        return -about * rate / (rate.square() + self.torsion_smoothing**2).sqrt()


@dataclass(frozen=True)
class NormalForcePrior(ForcePrior):
    """What accelerations in contact never show: a joint force along the constraint, E = Aᵀ Lᵀ = I − P.

    H Aᵀ = 0, so a force Aᵀ g(x) changes the multiplier by −g(x) and no acceleration. A joint force prior
    alone is overconfident along the normal. This independent process, with the hyperparameters of the joint
    force prior, keeps the uncertainty of that part until a force sensor or the like reduces it.

    Args:
        like: the joint force prior whose kernel, inputs and hyperparameters it shares.

    Example:
        >>> from forcegp import JointForcePrior
        >>> NormalForcePrior(JointForcePrior()).target
        'constraint'
    """

    like: JointForcePrior = field(default_factory=JointForcePrior)
    target: str = CONSTRAINT

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", f"{self.like.name}_normal")
        object.__setattr__(self, "kernel", self.like.kernel)

    @property
    def prefix(self) -> str:
        return self.like.name

    def outputs(self, robot: RobotModel) -> int:
        return self.like.outputs(robot)

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return self.like.features(system, at)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return at.eom.A.mT @ at.eom.L.mT
