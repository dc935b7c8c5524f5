"""Unilateral contact with a surface: opening, closing, impact and sliding friction.

A closed contact opens when its multiplier would become negative. An open contact closes with an inelastic
impact when c ≤ 0 and ċ < 0. Other constraints, such as the connection of two points, never open or close.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints.gauss import Equations
from forcegp.constraints.system import ConstrainedSystem
from forcegp.errors import NumericalError
from forcegp.types import ActiveContacts, JointVector

PULL = 1e-9
"""Value of −λ above which a contact pulls [N]; rounding errors must not open an unloaded contact."""
APPROACH = 1e-9
"""Value of −ċ above which a contact closes [m/s]; after an impact, ċ is zero up to rounding error."""
POSITION_TOLERANCE = 1e-12
"""Largest constraint error considered zero [m]; rounding errors in an arm's kinematics are near 1e-15 m."""
POSITION_ROUNDING = 100.0
"""Constraint error caused by rounding, in units of the machine epsilon; relevant only in float32."""
MAX_ITERATIONS = 30
"""Maximum number of Newton iterations; four are needed for a state one centimetre from the surface."""
MAX_STEP = 0.2
"""Largest change in a joint position per iteration [rad, m]; it mainly limits lightweight wrist joints."""


class Landing(NamedTuple):
    """State of the contacts at the start of a time step, before the forces are computed.

    Attributes:
        closed: `(n_contacts,)` bool, closed contacts.
        qd: `(nq,)` velocity, after the impact if there was one.
        eom: equations of motion under the constraints of the closed contacts.
        impact: whether a contact has just closed.
    """

    closed: Tensor
    qd: Tensor
    eom: Equations
    impact: bool


class ContactForces(NamedTuple):
    """Contacts and forces during a time step.

    Attributes:
        closed: `(n_contacts,)` bool, closed contacts.
        c: `(m,)` constraint error of all contacts, whether open or closed [m].
        multiplier: `(m,)` multiplier λ, which is zero for open contacts.
        Q: `(nq,)` joint force Q_C + Q_G + Q_D + Q_u [N m].
        Q_D, Q_I, Q_z: `(nq,)` joint friction, normal contact force and contact friction [N m].
    """

    closed: Tensor
    c: Tensor
    multiplier: Tensor
    Q: Tensor
    Q_D: Tensor
    Q_I: Tensor
    Q_z: Tensor


def rows_of(system: ConstrainedSystem, active: Tensor) -> Tensor:
    """Return a mask `(*batch, m)` of the rows of the active contacts."""
    repeats = torch.tensor([contact.rows for contact in system.contacts], device=active.device)
    return active.repeat_interleave(repeats, dim=-1)


def any_row(system: ConstrainedSystem, rows: Tensor) -> Tensor:
    """Return a mask `(*batch, n_contacts)` of the constraints with at least one row set in `(*batch, m)`."""
    if system.m == len(system.contacts):
        return rows
    parts = rows.split([contact.rows for contact in system.contacts], dim=-1)
    return torch.stack([part.any(-1) for part in parts], dim=-1)


def normal_rows(system: ConstrainedSystem, rows: Tensor) -> Tensor:
    """Select the first (normal) row of each contact, `(*batch, n_contacts)`, from all rows `(*batch, m)`."""
    if system.m == len(system.contacts):
        return rows
    return rows[..., [contact_rows.start for contact_rows in system.rows.values()]]


def pulling(system: ConstrainedSystem, active: Tensor, multiplier: Tensor) -> Tensor:
    """Return a mask of the closed contacts that open because their multiplier λ `(*batch, m)` is negative."""
    return normal_rows(system, multiplier < -PULL) & system.can_open & active


def reached(system: ConstrainedSystem, active: Tensor, c: Tensor, cd: Tensor) -> Tensor:
    """Return a mask `(*batch, n_contacts)` of the open contacts that close because c ≤ 0 and ċ < 0."""
    return normal_rows(system, (c <= 0.0) & (cd < -APPROACH)) & system.can_open & ~active


def project_velocity(eom: Equations, qd: Tensor) -> Tensor:
    """Return the velocity `(*batch, nq)` after a frictionless inelastic impact with the active constraints.

    M (q̇⁺ − q̇⁻) = Aᵀ Λ with A q̇⁺ = 0, so q̇⁺ = T q̇⁻ = q̇⁻ − L A q̇⁻.
    """
    return qd - (eom.L @ (eom.A @ qd[..., None]))[..., 0]


def project_state(
    system: ConstrainedSystem, q: JointVector, qd: JointVector, active: ActiveContacts | None = None
) -> tuple[JointVector, JointVector]:
    """Project (q, q̇) `(*batch, nq)` onto the constraint manifold in the metric of M.

    The Newton iteration q ← q − M⁻¹Aᵀ(A M⁻¹ Aᵀ)⁺ c moves along the directions of the constraint forces. The
    projected q̇ − L A q̇ is the closest admissible velocity in the kinetic-energy metric. The result
    satisfies |c(q)| ≤ 1e−12 m (1e−5 m in float32) and A q̇ = 0 for the `active` contacts `(*batch,
    n_contacts)` (all by default).

    Raises:
        NumericalError: the iteration does not converge, for example if the surface is out of reach.
    """
    rows = system.active_rows(active, q.shape[:-1])
    tolerance = max(POSITION_TOLERANCE, POSITION_ROUNDING * torch.finfo(q.dtype).eps)
    error = 0.0
    for _ in range(MAX_ITERATIONS):
        eom = system.equations(q, qd, active)
        c = torch.where(rows, eom.c, 0.0)
        error = float(c.detach().abs().max()) if c.numel() else 0.0
        if error <= tolerance:
            return q, project_velocity(eom, qd)
        move = (eom.L @ c[..., None])[..., 0]
        q = q - move * (MAX_STEP / move.detach().abs().amax(-1, keepdim=True).clamp(min=MAX_STEP))
    raise NumericalError(
        "no state on the constraint manifold was found",
        expected=f"a constraint error of at most {tolerance:g} m after {MAX_ITERATIONS} iterations",
        got=f"{error:.3g} m",
        hint="start closer to the surface, and check that the arm can reach it",
    )


def sliding_friction(
    system: ConstrainedSystem, eom: Equations, active: Tensor, viscous_friction: float
) -> Tensor:
    """Return the friction Q_z = Σ J_Eᵀ F_z `(*batch, nq)` of active contacts, F_z = −θ_v (I − n nᵀ) ṗ_E.

    `active` is a mask `(*batch, n_contacts)`, and `viscous_friction` is the coefficient θ_v [N s/m].
    """
    Q_z = 0.0 * eom.Q_C
    for i, contact in enumerate(system.contacts):
        if contact.name in eom.contact_points:
            # F_z = −θ_v (I − n nᵀ) ṗ_E, Q_z += J_Eᵀ F_z
            at = eom.contact_points[contact.name]
            n, v = at.normal, at.velocity
            sliding = v - ((v * n).sum(-1) / (n * n).sum(-1))[..., None] * n
            force = (-viscous_friction * active[..., i, None]) * sliding
            Q_z = Q_z + (at.jacobian.mT @ force[..., None])[..., 0]
    return Q_z


def land(system: ConstrainedSystem, q: Tensor, qd: Tensor, closed: Tensor) -> Landing:
    """Close the contacts reached at a state `(nq,)`, and apply their impacts."""
    eom = system.equations(q, qd, active=closed)
    new = reached(system, closed, eom.c, eom.cd)
    if not bool(new.any()):
        return Landing(closed, qd, eom, impact=False)
    closed = closed | new
    qd = project_velocity(system.equations(q, qd, active=closed), qd)
    return Landing(closed, qd, system.equations(q, qd, active=closed), impact=True)


def contact_forces(
    system: ConstrainedSystem, q: Tensor, qd: Tensor, landing: Landing, Q_u: Tensor, viscous_friction: float
) -> ContactForces:
    """Return the normal and friction forces at a state `(nq,)` under the torque Q_u [N m].

    Contacts that would pull are opened first. `landing` contains the closed contacts and their equations of
    motion. `viscous_friction` is the coefficient θ_v [N s/m].
    """
    closed, eom = landing.closed, landing.eom
    # Q = Q_C + Q_G + Q_D + Q_u
    Q = eom.Q_K + Q_u
    while True:
        # λ = (A M⁻¹ Aᵀ)⁺ (b − A M⁻¹ (Q + Q_z)) ≥ 0
        Q_z = sliding_friction(system, eom, closed, viscous_friction)
        multiplier = eom.multiplier(Q + Q_z)
        pulls = pulling(system, closed, multiplier)
        if not bool(pulls.any()):
            # Q_I = Aᵀ λ (eq. 17)
            Q_I = (eom.A.T @ multiplier[:, None])[:, 0]
            return ContactForces(closed, eom.c, multiplier, Q, eom.Q_D, Q_I, Q_z)
        closed = closed & ~pulls
        eom = system.equations(q, qd, active=closed)
