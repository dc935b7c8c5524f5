"""A prior on the friction that opposes sliding: viscous, dry, Coulomb, Stribeck and torsional.

Friction proportional to the normal force couples force and multiplier. With one contact, u = −J_Eᵀ s(v) and
g = Lᵀ u, the equations λ = λ_K − Lᵀ Q_z and Q_z = μ λ u have the solution λ = λ_K / (1 + μ g), where λ_K is
the multiplier without friction. A latent function must enter the force linearly, and μ does not: the operator
is the secant at a given μ̂, u λ_K / (1 + μ̂ g).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.contact import SurfaceContact
from forcegp.errors import ModelError
from forcegp.forces.priors.base import check_inputs
from forcegp.forces.priors.contact import SurfaceForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel

TERMS = ("viscous", "dry", "coulomb", "stribeck", "torsion")
"""Kinds of friction, in the order of the components of the latent function."""
LOADED = ("coulomb", "stribeck", "torsion")
"""Kinds that are proportional to the multiplier."""


@dataclass(frozen=True)
class SlidingFrictionPrior(SurfaceForcePrior):
    """A prior on the friction that opposes sliding, with v = (1 − n nᵀ) ṗ_E and s(v) = v / √(|v|² + ε²).

    F_z = −θ_v v − (θ_d + λ (μ + μ_s e^{−|v|²/v_s²})) s(v), and the moment −θ_t λ s(ω_n) n about the normal.

    The unknowns are the scalar functions named in `terms`: `viscous` θ_v [N s/m], `dry` θ_d [N], `coulomb` μ,
    `stribeck` μ_s, `torsion` θ_t [m]. They take fewer points than the components of a force. They depend on
    the sliding speed by default, so they hold on surfaces of any place, tilt and shape.

    λ = max(λ_K, 0) / (1 + μ̂ g) with the multiplier λ_K of the analytical forces Q_K + τ without friction and
    g = −Lᵀ J_Eᵀ s(v). This is exact for one contact whose friction is −μ̂ λ s(v). Otherwise it misses terms
    of
    second order: μ (μ − μ̂), μ times any other friction of the contact, and μ times unknown joint forces or
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
        against = -(J.mT @ v[..., None])[..., 0]
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
