"""Dry friction of joints, told apart from all other forces.

Dry friction is a force within ±F where a joint is at rest and −F sign(q̇) where it slides. Equations of motion
smooth it to −F tanh(q̇/v₀), so that it can be learned and differentiated; a rollout takes it as it is. With
Q(s) the force where each joint's dry friction has the direction s in place of tanh(q̇/v₀),

    Q = ½ (Q(1) + Q(−1)) − F s,   F = ½ (Q(−1) − Q(1)).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, coulomb_response, with_coulomb
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import AnalyticalMean, ForceMean, ForcePrior
from forcegp.forces.quantities import States
from forcegp.forces.samples import ForceSamples

SMOOTH = 0.02
"""Speed over which friction that would drive a joint changes sign; it is no friction and cannot stick
[rad/s, m/s]."""
NUDGE = 1e-4
"""Change of speed over which the slope of friction is taken [rad/s, m/s]."""


@dataclass(frozen=True, eq=False)
class DryFriction:
    """An impressed force with the dry friction of joints apart.

    Attributes:
        Q_bar: `(n, nq)` all impressed forces without it [N m, N].
        limit: `(n, nq)` its largest size F ≥ 0 [N m, N].
        response: `(n, nq, nq)` ∂Q̄/∂Q where contacts have Coulomb friction; `None` for the identity.
        damping: `(n, nq)` D = −∂Q_i/∂q̇_i ≥ 0 of the joints' other friction [N m s/rad, N s/m].
    """

    Q_bar: Tensor
    limit: Tensor
    response: Tensor | None
    damping: Tensor


@runtime_checkable
class _Unknown(Protocol):
    """Unknown forces of some priors."""

    def unknown_force(
        self, system: ConstrainedSystem, at: States, priors: Iterable[int]
    ) -> Tensor | float: ...


@dataclass(frozen=True, eq=False)
class TotalForce:
    """A force field Q̄(x) with dry friction that can be told apart.

    Args:
        forces: posterior mean, or samples.

    Example:
        >>> import forcegp
        >>> from forcegp.forces.priors.base import AnalyticalMean
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("franka_panda"))
        >>> has_dry_friction(system, AnalyticalMean(), ())
        True
    """

    forces: ForcePosterior | ForceSamples

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Q̄ with smooth dry friction, `(n, nq)`."""
        return self.forces.total_force(system, at)

    def split(self, system: ConstrainedSystem, at: States) -> DryFriction | None:
        """Q̄ with dry friction apart; `None` where there is none."""
        posterior = self.forces if isinstance(self.forces, ForcePosterior) else self.forces.posterior
        return split(system, at, posterior.mean, posterior.priors, self.forces, posterior.coulomb)


def has_dry_friction(system: ConstrainedSystem, mean: ForceMean, priors: Sequence[ForcePrior]) -> bool:
    """Whether the robot file, where the mean includes it, or a prior declares dry friction."""
    known = isinstance(mean, AnalyticalMean) and "friction" in mean.terms
    declared = known and bool(((system.robot.friction != 0.0) | (system.robot.stribeck != 0.0)).any())
    return declared or any(prior.sticks for prior in priors)


def split(
    system: ConstrainedSystem,
    at: States,
    mean: ForceMean,
    priors: Sequence[ForcePrior] = (),
    unknown: _Unknown | None = None,
    coulomb: Sequence[CoulombFriction] = (),
) -> DryFriction | None:
    """Forces at states with the dry friction of joints apart; `None` where there is none.

    Args:
        system: robot and contacts.
        at: n states.
        mean: prior mean of Q.
        priors: on unknown forces.
        unknown: their forces.
        coulomb: friction of contacts that is proportional to the multiplier.
    """
    if not has_dry_friction(system, mean, priors):
        return None
    sticking = [p for p, prior in enumerate(priors) if prior.sticks]
    others = [p for p, prior in enumerate(priors) if not prior.sticks]

    def sliding(direction: float, faster: float = 0.0) -> Tensor:
        there = dataclasses.replace(at, slip=torch.full_like(at.qd, direction), qd=at.qd + faster)
        known = mean(system, there)
        return known if unknown is None else known + unknown.unknown_force(system, there, sticking)

    # Only friction is read at another speed: all else that depends on it stands in the equations of motion.
    forward, backward = sliding(1.0), sliding(-1.0)
    damping = ((forward - sliding(1.0, NUDGE)) / NUDGE).clamp(min=0.0)
    limit = 0.5 * (backward - forward)
    Q = 0.5 * (forward + backward) + limit.clamp(max=0.0).neg() * torch.tanh(at.qd / SMOOTH)
    if unknown is not None:
        Q = Q + unknown.unknown_force(system, at, others)
    Q_bar = with_coulomb(system, at, Q, coulomb)
    return DryFriction(Q_bar, limit.clamp(min=0.0), coulomb_response(system, at, coulomb), damping)
