"""When contacts open and close, and the forces they exert: unilateral contact with inelastic impact."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, Equations
from forcegp.constraints.contact import SurfaceContact
from forcegp.types import JointVector


class Landing(NamedTuple):
    """The contacts at the begin of a step, before any force is known.

    Attributes:
        closed: `(n_contacts,)` bool.
        qd: `(nq,)` velocity, after the impact if there was one.
        eom: the equations of motion with the closed contacts.
        impact: whether a contact has closed just now.
    """

    closed: Tensor
    qd: JointVector
    eom: Equations
    impact: bool


class Touch(NamedTuple):
    """The contacts and the forces during a step.

    Attributes:
        closed: `(n_contacts,)` bool.
        c: `(m,)` constraint error, open or closed [m].
        multiplier: λ `(m,)`, zero where open.
        Q: `(nq,)` Q_C + Q_G + Q_D + Q_u [N m].
        Q_D, Q_I, Q_z: `(nq,)` joint friction, and normal and friction force of the contacts [N m].
    """

    closed: Tensor
    c: Tensor
    multiplier: Tensor
    Q: JointVector
    Q_D: JointVector
    Q_I: JointVector
    Q_z: JointVector


def unilateral(system: ConstrainedSystem) -> Tensor:
    """`(n_contacts,)` bool: contacts with a surface can open; other constraints hold both ways."""
    return torch.tensor([isinstance(c, SurfaceContact) for c in system.contacts], dtype=torch.bool)


def land(system: ConstrainedSystem, q: JointVector, qd: JointVector, closed: Tensor) -> Landing:
    """Close the contacts that are reached: c ≤ 0 while ċ < 0.

    An impact is inelastic and without friction, M (q̇⁺ − q̇) = Aᵀ Λ with A q̇⁺ = 0, so q̇⁺ = q̇ − L A q̇.
    """
    eom = system.equations(q, qd, active=closed)
    reached = any_row(system, (eom.c <= 0.0) & (eom.cd < 0.0)) & unilateral(system) & ~closed
    if not bool(reached.any()):
        return Landing(closed, qd, eom, impact=False)
    closed = closed | reached
    eom = system.equations(q, qd, active=closed)
    qd = qd - (eom.L @ (eom.A @ qd[:, None]))[:, 0]
    return Landing(closed, qd, system.equations(q, qd, active=closed), impact=True)


def contact_forces(
    system: ConstrainedSystem,
    q: JointVector,
    qd: JointVector,
    landing: Landing,
    Q_u: JointVector,
    viscous_friction: float,
) -> Touch:
    """Normal and friction force under the torque Q_u, once every contact that would have to pull has opened.

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
        Q_z = friction_force(system, eom, closed, viscous_friction)
        multiplier = eom.multiplier(Q + Q_z)
        pulls = any_row(system, multiplier < 0.0) & unilateral(system) & closed
        if not bool(pulls.any()):
            Q_I = (eom.A.mT @ multiplier[:, None])[:, 0]
            return Touch(closed, eom.c, multiplier, Q, eom.Q_D, Q_I, Q_z)
        closed = closed & ~pulls
        eom = system.equations(q, qd, active=closed)


def friction_force(
    system: ConstrainedSystem, eom: Equations, closed: Tensor, viscous_friction: float
) -> JointVector:
    """Q_z = Σ J_Eᵀ F_z with F_z = −θ_v (I − n nᵀ) ṗ_E, over the closed contacts, `(nq,)` [N m]."""
    Q_z = torch.zeros_like(eom.Q_C)
    for contact, touching in zip(system.contacts, closed.tolist(), strict=True):
        if touching and contact.name in eom.contact_points:
            at = eom.contact_points[contact.name]
            n = torch.nn.functional.normalize(at.normal, dim=-1)
            sliding = at.velocity - (at.velocity @ n) * n
            Q_z = Q_z - viscous_friction * (at.jacobian.mT @ sliding)
    return Q_z


def any_row(system: ConstrainedSystem, rows: Tensor) -> Tensor:
    """`(n_contacts,)` bool from `(m,)` bool: whether any row of each contact is set."""
    parts = rows.split([contact.rows for contact in system.contacts])
    return torch.stack([part.any() for part in parts]) if system.contacts else rows
