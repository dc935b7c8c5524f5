"""What speaks for a contact in each row: distance to the surface, measured force, or λ of the rigid body."""

from __future__ import annotations

import numpy as np
import torch

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.logs import wrench
from forcegp.logs.mapping import Mapping
from forcegp.logs.signals import Array, Signals

CHUNK = 1 << 12
"""Rows that are computed at a time."""


def distance(signals: Signals, system: ConstrainedSystem, contact: SurfaceContact) -> Array:
    """c(q) `(n,)`: how far the touching point is from the surface [m]."""
    c = np.empty(len(signals))
    for start in range(0, len(signals), CHUNK):
        rows = slice(start, start + CHUNK)
        q = torch.from_numpy(np.ascontiguousarray(signals.vectors["q"][rows]))
        c[rows] = contact.center_surface.value(_tip(system, contact, q)).numpy()
    return c


def normal_force(
    signals: Signals, system: ConstrainedSystem, mapping: Mapping, contact: SurfaceContact
) -> Array:
    """n·F `(n,)`: the sensor's force along the surface's normal [N]."""
    force, _ = wrench.at_sensor(signals, system.robot, mapping)
    along = np.empty(len(signals))
    for start in range(0, len(signals), CHUNK):
        rows = slice(start, start + CHUNK)
        q = torch.from_numpy(np.ascontiguousarray(signals.vectors["q"][rows]))
        normal = contact.surface.gradient(_tip(system, contact, q)).numpy()
        along[rows] = (normal * force[rows]).sum(axis=1)
    return along


def multiplier(signals: Signals, system: ConstrainedSystem, contact: SurfaceContact) -> Array:
    """λ `(n,)` of the rigid-body model [N], zero in free motion where the model is right.

    M q̈ − Q is the generalized force that the known forces do not explain, and
    λ = (A M⁻¹Aᵀ)⁺ A (q̈ − M⁻¹Q) the part of it along the surface's normal.

    Args:
        signals: with `qd`, `qdd` and `tau`.
        system: the robot with its contacts.
        contact: which of them.
    """
    alone = ConstrainedSystem(system.robot, [contact])
    result = np.empty(len(signals))
    for start in range(0, len(signals), CHUNK):
        rows = slice(start, start + CHUNK)
        q, qd, qdd, tau = (
            torch.from_numpy(np.ascontiguousarray(signals.vectors[name][rows]))
            for name in ("q", "qd", "qdd", "tau")
        )
        eom = alone.equations(q, qd)
        rest = qdd - eom.free_acceleration(eom.Q_K + tau)
        result[rows] = (eom.constraint_inertia @ (eom.A @ rest[..., None]))[:, 0, 0].numpy()
    return result


def _tip(system: ConstrainedSystem, contact: SurfaceContact, q: torch.Tensor) -> torch.Tensor:
    return kinematics.point_position(system.robot, q, contact.frame, tuple(contact.point))
