"""Sticking contacts in a rollout: their friction cone, and the stopping of sliding contacts.

A contact sticks if the required tangential force λ_t is within its friction cone, which the model defines.
For a test, the model's friction is evaluated at a velocity v d along d = −λ_t/|λ_t|, where v exceeds
`stick_speed` and the speed scale of smoothed friction. The contact slides along d if this friction does not
stop it: dᵀ(A_t q̈ − b_t) > 0. Within a step, friction can stop a sliding contact but not reverse it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Mapping

import torch
from torch import Tensor
from torch.linalg import vecdot
from torch.nn.functional import normalize

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.gauss import Equations, tangent_frame
from forcegp.constraints.unilateral import project_velocity
from forcegp.forces.quantities import States


def sticking_contacts(system: ConstrainedSystem, at: States, among: Container[str]) -> Tensor:
    """Return a mask `(n, n_contacts)` of the named contacts that are closed and stick."""
    sticks = torch.zeros_like(at.active)
    for k, contact, _ in system.may_stick:
        rests = at.eom.contact_points[contact.name].sticks
        if contact.name in among and rests is not None:
            sticks[:, k] = rests & at.active[:, k]
    return sticks


def sliding_away(
    system: ConstrainedSystem, at: States, multiplier: Tensor, slides: Tensor, speeds: Mapping[str, float]
) -> States:
    """Return the states after the given sticking contacts start to slide.

    Args:
        multiplier: multipliers λ `(n, m)` while the contacts stick.
        slides: mask `(n, n_contacts)` of the contacts that start to slide.
        speeds: sliding speed of each contact [m/s], keyed by name.
    """
    eom, points = at.eom, dict(at.eom.contact_points)
    free = torch.zeros_like(eom.b, dtype=torch.bool)
    for k, contact, rows in system.may_stick:
        if contact.name not in speeds:
            continue
        point, gone = points[contact.name], slides[:, k, None]
        # ṗ = −v (t_1, t_2) λ_t/|λ_t|
        along = tangent_frame(point.unit_normal) @ normalize(multiplier[:, rows], dim=-1)[..., None]
        velocity = torch.where(gone, -speeds[contact.name] * along[..., 0], point.velocity)
        sticks = None if point.sticks is None else point.sticks & ~gone[:, 0]
        points[contact.name] = dataclasses.replace(point, velocity=velocity, sticks=sticks)
        free[:, rows] = gone
    A, b, holds = eom.A.masked_fill(free[..., None], 0.0), eom.b.masked_fill(free, 0.0), eom.holds & ~free
    return dataclasses.replace(at, eom=dataclasses.replace(eom, A=A, b=b, holds=holds, contact_points=points))


def accelerating(system: ConstrainedSystem, at: States, multiplier: Tensor, qdd: Tensor) -> Tensor:
    """Return a mask `(n, n_contacts)` of the contacts that accelerate against the force that held them."""
    away = torch.zeros_like(at.active)
    # −λ_tᵀ(A_t q̈ − b_t) > 0
    held = multiplier * ((at.eom.A @ qdd[..., None])[..., 0] - at.eom.b)
    for k, _, rows in system.may_stick:
        away[:, k] = held[:, rows].sum(-1) < 0.0
    return away


def arrested(
    system: ConstrainedSystem,
    rough: Container[str],
    before: Equations,
    after: Equations,
    closed: Tensor,
    qd: Tensor,
) -> Tensor:
    """Return the velocity `(n, nq)` after a step in which friction stops contacts but does not reverse them.

    Contacts are stopped by an inelastic impact on the tangential rows, q̇ ← q̇ − L A q̇.

    Args:
        rough: names of the contacts with friction.
        before, after: the equations of motion at the start and at the end of the step.
        closed: mask `(n, n_contacts)` of the contacts that are closed at both times.
        qd: velocity `(n, nq)` after the step.
    """
    A, stops = after.A, torch.zeros_like(closed[:, :1])
    for k, contact, rows in system.may_stick:
        old, new = before.contact_points[contact.name], after.contact_points[contact.name]
        if contact.name not in rough or old.sticks is None:
            continue
        turned = (vecdot(old.sliding[1], new.sliding[1]) < 0.0) & ~old.sticks & closed[:, k]
        held = tangent_frame(new.unit_normal).mT @ new.jacobian
        A = A.clone()
        A[:, rows] = torch.where(turned[:, None, None], held, A[:, rows])
        stops = stops | turned[:, None]
    if not bool(stops.any()):
        return qd
    return torch.where(stops, project_velocity(dataclasses.replace(after, A=A), qd), qd)
