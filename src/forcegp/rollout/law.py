"""What moves a rollout: accelerations from a force on the constrained system, or from a model of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.quantities import States
from forcegp.models.base import ForceField, Model


class Motion(NamedTuple):
    """What a law says at a state.

    Attributes:
        qdd: `(n, nq)`.
        multiplier: λ `(n, m)`; NaN where the law knows no forces.
    """

    qdd: Tensor
    multiplier: Tensor


class Law(ABC):
    """A deterministic acceleration of a constrained system."""

    has_multiplier: bool

    @abstractmethod
    def motion(self, system: ConstrainedSystem, at: States) -> Motion:
        """Acceleration and multiplier at states."""


@dataclass(frozen=True)
class ForceLaw(Law):
    """q̈ = L b + H Q̄ and λ = (A M⁻¹ Aᵀ)⁺(b − A M⁻¹ Q̄) of a force field (eqs. 4 and 16)."""

    force: ForceField
    has_multiplier: bool = True

    def motion(self, system: ConstrainedSystem, at: States) -> Motion:
        eom = at.eom
        free = eom.free_acceleration(self.force(system, at))
        missing = eom.b - (eom.A @ free[..., None])[..., 0]
        multiplier = (eom.constraint_inertia @ missing[..., None])[..., 0]
        return Motion(free + (eom.M_inv_At @ multiplier[..., None])[..., 0], multiplier)


@dataclass(frozen=True)
class AccelerationLaw(Law):
    """q̈ as a model predicts it, which need not obey the constraint."""

    model: Model
    has_multiplier: bool = False

    def motion(self, system: ConstrainedSystem, at: States) -> Motion:
        qdd = self.model.predict(at.q, at.qd, at.tau, "qdd", active=at.active, covariance=False).mean
        return Motion(qdd, torch.full_like(at.eom.c, torch.nan))


def law_of(model: Model) -> Law:
    """The mean motion of a model: of its force field where it has one, else of its accelerations."""
    force = model.force_field()
    return AccelerationLaw(model) if force is None else ForceLaw(force)
