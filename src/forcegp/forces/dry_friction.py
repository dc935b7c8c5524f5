"""Dry friction of joints, told apart from all other forces.

Dry friction is a force within ±F where a joint is at rest and −F sign(q̇) where it slides. Equations of motion
smooth it to −F tanh(q̇/v₀), so that it can be learned and differentiated; a rollout takes it as it is. With
Q(s) the force where each joint's dry friction has the direction s in place of tanh(q̇/v₀),

    Q = ½ (Q(1) + Q(−1)) − F s,   F = ½ (Q(−1) − Q(1)).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, coulomb_response, with_coulomb
from forcegp.forces.posterior import ForcePosterior, ForceSamples
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.quantities import States

ForceField = Callable[[ConstrainedSystem, States], Tensor]
"""The impressed force Q̄ at states, `(n, nq)`; a batch of functions gives each its share of the n rows."""

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


def split(system: ConstrainedSystem, at: States, force: ForceField) -> DryFriction:
    """A force field at states with the dry friction of joints apart.

    Args:
        system: robot and contacts.
        at: n states.
        force: posterior mean, samples, or a prior mean alone, Q̄.

    Example:
        >>> import torch, forcegp
        >>> from forcegp.forces.priors.joint import AnalyticalMean
        >>> from forcegp.forces.quantities import states_at
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("franka_panda"))
        >>> at, _ = states_at(system, *torch.zeros(3, 1, 7, dtype=torch.float64), None)
        >>> split(system, at, AnalyticalMean()).limit.shape
        torch.Size([1, 7])
    """
    mean, unknown = force, None
    priors: Sequence[ForcePrior] = ()
    coulomb: Sequence[CoulombFriction] = ()
    if isinstance(force, ForcePosterior | ForceSamples):
        posterior = force if isinstance(force, ForcePosterior) else force.posterior
        process, unknown = posterior.process, force
        mean, priors, coulomb = process.mean, process.priors, process.coulomb
    sticking = [p for p, prior in enumerate(priors) if prior.sticks]
    others = [p for p, prior in enumerate(priors) if not prior.sticks]

    def sliding(direction: float, faster: float = 0.0) -> Tensor:
        moved = dataclasses.replace(at, slip=torch.full_like(at.qd, direction), qd=at.qd + faster)
        force = mean(system, moved)
        return force if unknown is None else force + unknown.unknown_force(system, moved, sticking)

    # Only friction is read at another speed: all else that depends on it stands in the equations of motion.
    forward, backward = sliding(1.0), sliding(-1.0)
    damping = ((forward - sliding(1.0, NUDGE)) / NUDGE).clamp(min=0.0)
    limit = 0.5 * (backward - forward)
    Q = 0.5 * (forward + backward) + limit.clamp(max=0.0).neg() * torch.tanh(at.qd / SMOOTH)
    if unknown is not None:
        Q = Q + unknown.unknown_force(system, at, others)
    Q_bar = with_coulomb(system, at, Q, coulomb)
    return DryFriction(Q_bar, limit.clamp(min=0.0), coulomb_response(system, at, coulomb), damping)
