"""Inverse kinematics: joint positions that put the tool at a pose."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.control.task_space import orientation_error, task_rows
from forcegp.errors import NumericalError
from forcegp.robot.model import RobotModel
from forcegp.types import JointVector, Rotation, Vector3

POSE_TOLERANCE = 1e-10
"""A pose is reached when no component is off by more (metres, or the sine of an angle)."""
ITERATIONS = 150
"""Steps from each start; those that reach the pose at all do so in about thirty."""
MAX_STEP = 0.3
"""Largest turn of a joint in one step [rad]; the linear model of the pose is not good for more."""
DAMPING = 0.1
"""Damping of the squares in proportion to the squared error, so that it fades as the pose is reached."""
LEANING = 0.1
"""Share of the way to the preferred joint positions that a step takes in the null space of the pose."""


def inverse_kinematics(
    robot: RobotModel,
    frame: str,
    point: Sequence[float],
    position: Vector3,
    rotation: Rotation,
    starts: Tensor,
    near: JointVector,
) -> JointVector:
    """Joint positions that put a point of a frame at a pose, by damped least squares from many starts.

    Each step is Jᵀ(J Jᵀ + μ I)⁻¹ e; the first half of them also move to `near` in the null space of J. An
    arm with fewer than six joints is asked for the position alone.

    Args:
        robot: the robot.
        frame, point: the tool point, fixed in a frame.
        position: `(3,)` wanted in the world [m].
        rotation: `(3, 3)` wanted axes of the frame in the world.
        starts: `(k, nq)` where to start from.
        near: `(nq,)` of the solutions found, the one next to this is taken.

    Returns:
        `(nq,)` [rad, m].

    Raises:
        NumericalError: no start leads to the pose within the joint limits.
    """
    index, x = robot.frame_index(frame), kinematics.as_point(robot, point)
    q = starts.clamp(robot.lower, robot.upper)
    for k in range(ITERATIONS):
        error, J, _ = _pose_error(robot, q, index, x, position, rotation)
        # Leaning against a joint limit would keep the pose from being reached, so the last steps do not.
        leaning = LEANING * (near - q) if k < ITERATIONS // 2 else torch.zeros_like(q)
        q = q + _damped_step(J, error, leaning).clamp(-MAX_STEP, MAX_STEP)
        q = q.clamp(robot.lower, robot.upper)
    error, _, aligned = _pose_error(robot, q, index, x, position, rotation)
    found = q[(error.abs().amax(-1) < POSE_TOLERANCE) & aligned]
    if len(found) == 0:
        raise NumericalError(
            f"no joint positions put {frame} of robot {robot.name!r} at the pose",
            expected=f"tool point at {[round(v, 4) for v in position.tolist()]} m, normal to the surface",
            got=f"{len(starts)} starts, of which none leads there",
            hint="move the rectangle into the workspace of the robot",
        )
    return found[(found - near).abs().sum(-1).argmin()]


def _pose_error(
    robot: RobotModel, q: Tensor, index: int, x: Tensor, position: Tensor, rotation: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Pose error `(k, 6)`, or of the position `(k, 3)`, its Jacobian, and whether the axes agree.

    The sine in the orientation error also vanishes half a turn away, where the trace of the relative
    rotation is −1 and not 3.
    """
    poses = kinematics.link_poses(robot, q)
    reached = kinematics.rotation_of_poses(robot, poses, index)
    shift = position - kinematics.point_of_poses(robot, poses, index, x) - robot.base_position
    error = torch.cat([orientation_error(reached, rotation.expand_as(reached)), shift], dim=-1)
    J, rows = kinematics.jacobian_of_poses(robot, poses, index, x), task_rows(robot.nq)
    asked_for = rows.start > 0 or (reached * rotation).sum((-2, -1)) > 1.0
    aligned = torch.as_tensor(asked_for).expand(len(q))
    return error[..., rows], J[..., rows, :], aligned


def _damped_step(J: Tensor, error: Tensor, leaning: Tensor) -> Tensor:
    """Jᵀ(J Jᵀ + μ I)⁻¹(e − J l) + l."""
    damping = DAMPING * (error * error).sum(-1) + torch.finfo(error.dtype).eps
    missing = (error - (J @ leaning[..., None])[..., 0])[..., None]
    damped = damping[..., None, None] * torch.eye(min(J.shape[-2:]), dtype=J.dtype)
    if J.shape[-1] < J.shape[-2]:
        return leaning + torch.linalg.solve(J.mT @ J + damped, J.mT @ missing)[..., 0]
    return leaning + (J.mT @ torch.linalg.solve(J @ J.mT + damped, missing))[..., 0]


def tool_rotation(normal: Vector3, ahead: Vector3, tool_axis: Vector3) -> Rotation:
    """Axes `(3, 3)` of a frame whose tool axis points into the surface, turned by π about the side axis.

    Args:
        normal: `(3,)` unit normal out of the surface.
        ahead: `(3,)` unit tangent.
        tool_axis: `(3,)` unit axis of the tool in its frame; the z axis for most arms.
    """
    z = torch.tensor([0.0, 0.0, 1.0], dtype=normal.dtype)
    down = torch.stack([-ahead, torch.linalg.cross(normal, ahead), -normal], dim=-1)
    return down @ _shortest_turn(tool_axis, z)


def _shortest_turn(a: Vector3, b: Vector3) -> Rotation:
    """The rotation that takes the unit vector a to the z axis b on the shortest way (Rodrigues' formula)."""
    if float(a @ b) < -1.0 + POSE_TOLERANCE:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=a.dtype))
    K = kinematics.skew(torch.linalg.cross(a, b))
    return torch.eye(3, dtype=a.dtype) + K + K @ K / (1.0 + a @ b)
