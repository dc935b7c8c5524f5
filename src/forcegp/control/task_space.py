"""Task-space inverse-dynamics control, with null-space control of redundant degrees of freedom.

The task is the pose of the tool, or only its position for an arm with fewer than six joints. A redundant arm
moves its elbow in the null space of the task Jacobian. This motion does not affect the error dynamics of the
task (Siciliano et al., *Robotics: Modelling, Planning and Control*, p. 347 and section 3.5.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.kinematics import PointMotion

POSE_ROWS, POSITION_ROWS = 6, 3
SINGULAR = 1e-3
"""Smallest allowed pivot of √(J Jᵀ), below which joint speeds exceed task speeds a thousandfold."""


@dataclass(frozen=True)
class Gains:
    """Feedback gains of the controller, with stiffness k_P [1/s²] and damping k_D [1/s] for each error.

    Critical damping is k_D = 2 √k_P.

    Args:
        position_stiffness, position_damping: gains for the tool position.
        orientation_stiffness, orientation_damping: gains for the tool orientation.
        posture_stiffness, posture_damping: gains for the joints in the null space of the task.
    """

    position_stiffness: float = 100.0
    position_damping: float = 20.0
    orientation_stiffness: float = 100.0
    orientation_damping: float = 20.0
    posture_stiffness: float = 16.0
    posture_damping: float = 8.0


class Target(NamedTuple):
    """Target of the controller at one instant.

    Attributes:
        position, velocity, acceleration: motion of the tool point, `(*batch, 3)` [m], [m/s], [m/s²].
        rotation: constant axes of the tool frame, `(*batch, 3, 3)`.
        posture: preferred joint positions in the null space, `(*batch, nq)` [rad].
        push: desired normal force of the tool on the surface, `(*batch,)` [N].
    """

    position: Tensor
    velocity: Tensor
    acceleration: Tensor
    rotation: Tensor
    posture: Tensor
    push: Tensor


class JointTarget(NamedTuple):
    """Target positions, velocities and accelerations of the joints at one instant, each `(*batch, nq)`."""

    q: Tensor
    qd: Tensor
    qdd: Tensor


def task_rows(nq: int) -> slice:
    """Return the rows of [ω; ṗ] that an arm with nq joints can follow: all if nq ≥ 6, otherwise only ṗ."""
    return slice(0 if nq >= POSE_ROWS else POSITION_ROWS, POSE_ROWS)


def orientation_error(rotation: Tensor, target: Tensor) -> Tensor:
    """Return e_O = ½ Σᵢ rᵢ × rᵢᵈ, sin(angle) times the rotation axis, for frames with axes rᵢ and rᵢᵈ.

    It is the axial vector `(*batch, 3)` of the skew part of R_d Rᵀ in world axes (Siciliano, eq. 3.98).
    """
    E = target @ rotation.mT
    skew = E - E.mT
    return 0.5 * torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


def task_acceleration(tool: PointMotion, target: Target, gains: Gains) -> Tensor:
    """Return [ω̇; p̈] `(*batch, 6)` for which both errors satisfy ë + k_D ė + k_P e = 0."""
    omega, velocity = tool.twist[..., :3], tool.twist[..., 3:]
    turning = gains.orientation_stiffness * orientation_error(tool.rotation, target.rotation)
    moving = target.acceleration + gains.position_damping * (target.velocity - velocity)
    moving = moving + gains.position_stiffness * (target.position - tool.position)
    return torch.cat([turning - gains.orientation_damping * omega, moving], -1)


def joint_acceleration(tool: PointMotion, task: Tensor, posture: Tensor) -> Tensor:
    """Return y = J⁺(a − J̇q̇) + (I − J⁺J) y₀, with the posture acceleration in the null space of the task.

    The task acceleration a has shape `(*batch, 6)`, and the posture acceleration y₀ has shape `(*batch, nq)`.
    J contains the rows of the tool Jacobian that the arm can follow (`task_rows`). If the arm has fewer
    joints than rows, the task is followed in the least-squares sense.

    Raises:
        NumericalError: the arm is in a singular pose.
    """
    nq = tool.jacobian.shape[-1]
    rows = task_rows(nq)
    J = tool.jacobian[..., rows, :]
    Jt = J.mT
    missing = ((task - tool.bias)[..., rows] - (J @ posture[..., None])[..., 0])[..., None]
    few = nq < J.shape[-2]
    factor, failed = torch.linalg.cholesky_ex(Jt @ J if few else J @ Jt)
    if bool(failed.any()) or not float(factor.diagonal(dim1=-2, dim2=-1).min()) >= SINGULAR:
        raise NumericalError(
            "the arm is singular: its joints cannot move the tool in every direction",
            hint="use a smaller rectangle, or one closer to the centre of the workspace",
        )
    solved = torch.cholesky_solve(Jt @ missing if few else missing, factor)
    return posture + (solved if few else Jt @ solved)[..., 0]


def control_torque(
    tool: PointMotion, eom: Any, q: Tensor, qd: Tensor, target: Target, press: Tensor, gains: Gains
) -> Tensor:
    """Return the motor torque Q_u = M y − Q_K − Q_n F of inverse-dynamics control, before limits [N m].

    Args:
        tool: the motion of the tool at the state.
        eom: the equations of motion at the state, with M and Q_K = Q_C + Q_G + Q_D.
        q, qd: positions and velocities, `(*batch, nq)`.
        target: the desired motion, with `push` as F.
        press: Q_n `(*batch, nq)`, the sum of Jᵀn for unit normal forces at the actual contacts of the tool.
            Forces along the normal at the reference would push the tool off a convex surface.
        gains: feedback gains.

    Raises:
        NumericalError: the arm is in a singular pose.
    """
    posture = gains.posture_stiffness * (target.posture - q) - gains.posture_damping * qd
    y = joint_acceleration(tool, task_acceleration(tool, target, gains), posture)
    return (eom.M @ y[..., None])[..., 0] - eom.Q_K - target.push[..., None] * press


def joint_torque(eom: Any, q: Tensor, qd: Tensor, target: JointTarget, gains: Gains) -> Tensor:
    """Return the motor torque M (q̈_d + k_D ė + k_P e) − Q_K, `(*batch, nq)`, using the position gains."""
    y = target.qdd + gains.position_damping * (target.qd - qd) + gains.position_stiffness * (target.q - q)
    return (eom.M @ y[..., None])[..., 0] - eom.Q_K
