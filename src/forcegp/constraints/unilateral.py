"""Contact with a surface, which pushes and never pulls: opening, closing, impact and sliding friction.

The simulator and rollouts share this file. A closed contact opens where its multiplier would turn negative.
An open contact closes where c ≤ 0 and ċ < 0, with an inelastic impact. Constraints without a surface, such as
a connection of two points, hold in both directions and never change.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints.contact import SurfaceContact
from forcegp.constraints.gauss import Equations
from forcegp.constraints.projection import project_velocity
from forcegp.constraints.system import ConstrainedSystem
from forcegp.types import ConstraintVector, JointVector

PULL = 1e-9
"""A contact pulls if λ is below minus this [N]; rounding must not open a contact that carries no load."""
APPROACH = 1e-9
"""A contact is approached if ċ is below minus this [m/s]; after an impact ċ is zero up to rounding."""


class Landing(NamedTuple):
    """The contacts at the start of a step, before any force is known.

    Attributes:
        closed: `(n_contacts,)` bool.
        qd: `(nq,)` velocity, after the impact if there was one.
        eom: the equations of motion with the closed contacts.
        impact: whether a contact has just closed.
    """

    closed: Tensor
    qd: JointVector
    eom: Equations
    impact: bool


class ContactForces(NamedTuple):
    """The contacts and the forces during a step.

    Attributes:
        closed: `(n_contacts,)` bool.
        c: `(m,)` constraint error, open or closed [m].
        multiplier: λ `(m,)`, zero where open.
        Q: `(nq,)` Q_C + Q_G + Q_D + Q_u [N m].
        Q_D, Q_I, Q_z: `(nq,)` joint friction, and normal and friction force of the contacts [N m].
    """

    closed: Tensor
    c: ConstraintVector
    multiplier: ConstraintVector
    Q: JointVector
    Q_D: JointVector
    Q_I: JointVector
    Q_z: JointVector


def can_open(system: ConstrainedSystem) -> Tensor:
    """Which constraints are contacts with a surface, `(n_contacts,)` bool."""
    flags = [isinstance(contact, SurfaceContact) for contact in system.contacts]
    return torch.tensor(flags, dtype=torch.bool, device=system.robot.device)


def rows_of(system: ConstrainedSystem, active: Tensor) -> Tensor:
    """The rows of the active contacts, `(*batch, m)` bool."""
    if system.m == len(system.contacts):
        return active
    repeats = torch.tensor([contact.rows for contact in system.contacts], device=active.device)
    return active.repeat_interleave(repeats, dim=-1)


def any_row(system: ConstrainedSystem, rows: Tensor) -> Tensor:
    """Whether any row of each contact is set: `(*batch, n_contacts)` bool from `(*batch, m)` bool."""
    if system.m == len(system.contacts):
        return rows
    parts = rows.split([contact.rows for contact in system.contacts], dim=-1)
    return torch.stack([part.any(-1) for part in parts], dim=-1)


def pulling(system: ConstrainedSystem, active: Tensor, multiplier: ConstraintVector) -> Tensor:
    """Closed contacts that would have to pull, λ < 0, and therefore open.

    Args:
        system: robot and contacts.
        active: `(*batch, n_contacts)` bool, closed contacts.
        multiplier: λ `(*batch, m)` [N].

    Returns:
        `(*batch, n_contacts)` bool.
    """
    return any_row(system, multiplier < -PULL) & can_open(system) & active


def reached(system: ConstrainedSystem, active: Tensor, c: ConstraintVector, cd: ConstraintVector) -> Tensor:
    """Open contacts that the robot has reached, c ≤ 0 while ċ < 0, and that therefore close.

    Args:
        system: robot and contacts.
        active: `(*batch, n_contacts)` bool, closed contacts.
        c, cd: `(*batch, m)` constraint error and its rate [m], [m/s].

    Returns:
        `(*batch, n_contacts)` bool.
    """
    return any_row(system, (c <= 0.0) & (cd < -APPROACH)) & can_open(system) & ~active


def impact_velocity(
    system: ConstrainedSystem, q: JointVector, qd: JointVector, active: Tensor
) -> JointVector:
    """Velocity `(*batch, nq)` after an inelastic impact without friction on the active contacts.

    M (q̇⁺ − q̇⁻) = Aᵀ Λ with A q̇⁺ = 0, so q̇⁺ = T q̇⁻ = q̇⁻ − L A q̇⁻.
    """
    return project_velocity(system.equations(q, qd, active=active), qd)


def sliding_friction(
    system: ConstrainedSystem, eom: Equations, active: Tensor, viscous_friction: float
) -> JointVector:
    """Friction of the active contacts: Q_z = Σ J_Eᵀ F_z with F_z = −θ_v (I − n nᵀ) ṗ_E.

    Args:
        system: robot and contacts.
        eom: the equations of motion at the states.
        active: `(*batch, n_contacts)` bool, closed contacts.
        viscous_friction: θ_v [N s/m].

    Returns:
        `(*batch, nq)` [N m, N].
    """
    Q_z = torch.zeros_like(eom.Q_C)
    for i, contact in enumerate(system.contacts):
        if contact.name in eom.contact_points:
            at = eom.contact_points[contact.name]
            n = torch.nn.functional.normalize(at.normal, dim=-1)
            sliding = at.velocity - (at.velocity * n).sum(-1, keepdim=True) * n
            force = torch.where(active[..., i, None], -viscous_friction * sliding, 0.0)
            Q_z = Q_z + (at.jacobian.mT @ force[..., None])[..., 0]
    return Q_z


def land(system: ConstrainedSystem, q: JointVector, qd: JointVector, closed: Tensor) -> Landing:
    """Close the contacts that one state `(nq,)` has reached, with their impact."""
    eom = system.equations(q, qd, active=closed)
    new = reached(system, closed, eom.c, eom.cd)
    if not bool(new.any()):
        return Landing(closed, qd, eom, impact=False)
    closed = closed | new
    qd = impact_velocity(system, q, qd, closed)
    return Landing(closed, qd, system.equations(q, qd, active=closed), impact=True)


def contact_forces(
    system: ConstrainedSystem,
    q: JointVector,
    qd: JointVector,
    landing: Landing,
    Q_u: JointVector,
    viscous_friction: float,
) -> ContactForces:
    """Normal and friction force under the torque Q_u, after every contact that would have to pull has opened.

    Args:
        system: robot and contacts.
        q, qd: `(nq,)` the state.
        landing: the contacts closed so far, and the equations of motion with them.
        Q_u: `(nq,)` motor torque [N m].
        viscous_friction: θ_v [N s/m].
    """
    closed, eom = landing.closed, landing.eom
    Q = eom.Q_K + Q_u
    while True:
        Q_z = sliding_friction(system, eom, closed, viscous_friction)
        multiplier = eom.multiplier(Q + Q_z)
        pulls = pulling(system, closed, multiplier)
        if not bool(pulls.any()):
            Q_I = (eom.A.mT @ multiplier[:, None])[:, 0]
            return ContactForces(closed, eom.c, multiplier, Q, eom.Q_D, Q_I, Q_z)
        closed = closed & ~pulls
        eom = system.equations(q, qd, active=closed)
