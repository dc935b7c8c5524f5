"""The torque that the robot file leaves unexplained, without what a labelled contact may contribute.

r = M q̈ − Q_C − Q_G − Q_D − Q_u is Aᵀλ + Q_z = Jᵀ F where a point touches, and zero elsewhere. Projecting r on
the null space of J takes any contact force out, normal and tangential, known or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from forcegp import dynamics, kinematics
from forcegp.checks.log import Log
from forcegp.checks.statistics import Array
from forcegp.constraints import ConstrainedSystem, Constraint, SurfaceContact

CHUNK = 8192
"""Rows whose dynamics are in memory at once."""


@dataclass(frozen=True)
class Residual:
    """Unexplained torque at some rows.

    Attributes:
        r: `(n, nq)` [N m, N].
        J: `(n, k, nq)` Jacobian of the touching points, zero where they do not touch.
    """

    r: Array
    J: Array


def tensors(log: Log, rows: np.ndarray, *names: str) -> list[Tensor]:
    """Columns at some rows, as tensors."""
    return [torch.from_numpy(np.ascontiguousarray(getattr(log, name)[rows])) for name in names]


def residual(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Residual:
    """The unexplained torque at some rows; the robot must be in double precision on the CPU."""
    robot, r, J = system.robot, [], []
    with torch.no_grad():
        for part in np.array_split(rows, max(1, -(-len(rows) // CHUNK))):
            q, qd, qdd, tau = tensors(log, part, "q", "qd", "qdd", "tau")
            needed = dynamics.inverse_dynamics(robot, q, qd, qdd) - dynamics.damping_force(robot, qd)
            r.append((needed - tau).numpy())
            J.append(_contact_jacobian(system, log, part, q, qd))
    return Residual(np.concatenate(r), np.concatenate(J))


def known_contacts(system: ConstrainedSystem, log: Log) -> list[Constraint]:
    """The contacts whose state the log knows."""
    return [c for c in system.contacts if c.name in log.contact]


def takes_friction_out(system: ConstrainedSystem, log: Log) -> bool:
    """Whether enough torques are left once any force at the contacts is taken out, not the normal alone."""
    return 3 * len(known_contacts(system, log)) < log.nq


def _contact_jacobian(system: ConstrainedSystem, log: Log, rows: np.ndarray, q: Tensor, qd: Tensor) -> Array:
    """Rows of J of all contacts, those of the surface normal alone where all of J would leave no torque."""
    known, whole = known_contacts(system, log), takes_friction_out(system, log)
    if not known or not len(rows):
        return np.zeros((len(rows), 0, log.nq))
    parts = []
    for c in known:
        if whole and isinstance(c, SurfaceContact):
            J = kinematics.point_jacobian(system.robot, q, c.frame, c.point).numpy()
        else:
            J = ConstrainedSystem(system.robot, [c]).equations(q, qd).A.numpy()
        parts.append(J * log.contact[c.name][rows][:, None, None])
    return np.concatenate(parts, axis=1)


def projector(J: Array, scale: Array) -> Array:
    """Projector `(n, nq, nq)` on torques r/scale that no force at the touching points can make."""
    J = J * (1.0 / scale)
    eye = np.broadcast_to(np.eye(J.shape[-1]), (len(J), *2 * (J.shape[-1],))).copy()
    touching = (J != 0.0).any(axis=(1, 2))
    if touching.any():
        # Jᵀ = U S Vᵀ; directions beyond the rank do not count.
        U, S, _ = np.linalg.svd(J[touching].transpose(0, 2, 1), full_matrices=False)
        U = U * (1e-9 * S[:, :1] < S)[:, None, :]
        eye[touching] -= U @ U.transpose(0, 2, 1)
    return eye
