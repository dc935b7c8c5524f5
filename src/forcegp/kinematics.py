"""Poses, Jacobians and bias accelerations of a tree of joints, batched over states.

Convention, stated once: spatial vectors are `[angular, linear]`, in world axes, about the origin of the
base. With the joint screws s_j so expressed and the ancestor matrix E, the twist of link i is
V_i = Σ_j E_ij s_j q̇_j, so only the poses need a recursion, over the depth of the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.robot.model import BASE, RobotModel
from forcegp.types import FrameJacobian, JointVector, PointJacobian, Rotation, Vector3


class LinkPoses(NamedTuple):
    """Poses of the links and the screws of their joints.

    Attributes:
        rotation: `(*batch, nq, 3, 3)` link axes in the world.
        position: `(*batch, nq, 3)` link origin relative to the base origin, world axes [m].
        angular, linear: `(*batch, nq, 3)` the joint screws s_j.
    """

    rotation: Tensor
    position: Tensor
    angular: Tensor
    linear: Tensor


class LinkMotion(NamedTuple):
    """First-order motion of the links at a state (q, q̇).

    Attributes:
        omega, velocity: `(*batch, nq, 3)` twists V_i [rad/s], [m/s].
        alpha, acceleration: `(*batch, nq, 3)` spatial accelerations at q̈ = 0 [rad/s²], [m/s²].
    """

    omega: Tensor
    velocity: Tensor
    alpha: Tensor
    acceleration: Tensor


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Vector product over the last dimension, broadcasting."""
    a, b = torch.broadcast_tensors(a, b)
    return torch.linalg.cross(a, b)


def skew(v: Vector3) -> Rotation:
    """The matrix [v]× with [v]× w = v × w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def _joint_poses(robot: RobotModel, q: JointVector) -> tuple[Tensor, Tensor]:
    """Pose of each link in its parent link at q (Rodrigues' formula about a constant axis)."""
    angle = (q * robot.revolute)[..., None, None]
    K = skew(robot.axis)
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    turn = eye + torch.sin(angle) * K + (1.0 - torch.cos(angle)) * (K @ K)
    rotation = robot.placement_rotation @ turn
    slide = (robot.placement_rotation @ robot.axis[..., None])[..., 0]
    position = robot.placement_position + (q * (1.0 - robot.revolute))[..., None] * slide
    return rotation, position


def link_poses(robot: RobotModel, q: JointVector) -> LinkPoses:
    """Poses of all links, R_i = R_parent R_i^local, and the joint screws in world axes.

    Args:
        robot: the robot.
        q: `(*batch, nq)` joint positions [rad, m].

    Raises:
        ShapeError: q does not fit the robot.
    """
    robot.check_state(q=q)
    local_rotation, local_position = _joint_poses(robot, q)
    rotation: list[Tensor] = [local_rotation[..., 0, :, :]] * robot.nq
    position: list[Tensor] = [local_position[..., 0, :]] * robot.nq
    for level in robot.levels:
        for i in level:
            parent = robot.parents[i]
            R, p = local_rotation[..., i, :, :], local_position[..., i, :]
            if parent == BASE:
                rotation[i] = robot.base_rotation @ R
                position[i] = p @ robot.base_rotation.mT
            else:
                rotation[i] = rotation[parent] @ R
                position[i] = position[parent] + (rotation[parent] @ p[..., None])[..., 0]
    R, p = torch.stack(rotation, dim=-3), torch.stack(position, dim=-2)
    z = (R @ robot.axis[..., None])[..., 0]
    turns = robot.revolute[:, None]
    return LinkPoses(R, p, turns * z, turns * cross(p, z) + (1.0 - turns) * z)


def link_motion(robot: RobotModel, poses: LinkPoses, qd: JointVector) -> LinkMotion:
    """Twists V = E(s q̇) and the accelerations E(ṡ q̇) that remain at q̈ = 0, with ṡ_j = V_j × s_j."""
    rate, E = qd[..., None], robot.ancestors
    omega, velocity = E @ (poses.angular * rate), E @ (poses.linear * rate)
    alpha = E @ (cross(omega, poses.angular) * rate)
    turned = cross(omega, poses.linear) + cross(velocity, poses.angular)
    return LinkMotion(omega, velocity, alpha, E @ (turned * rate))


def _frame_in_base(robot: RobotModel, poses: LinkPoses, index: int) -> tuple[Tensor, Tensor]:
    """Rotation and position of a frame relative to the base origin, world axes."""
    parent, R, p = robot.frame_parents[index], robot.frame_rotation[index], robot.frame_position[index]
    if parent == BASE:
        batch = poses.rotation.shape[:-3]
        rotation = (robot.base_rotation @ R).expand(*batch, 3, 3)
        return rotation, (robot.base_rotation @ p).expand(*batch, 3)
    link = poses.rotation[..., parent, :, :]
    return link @ R, poses.position[..., parent, :] + (link @ p[..., None])[..., 0]


def _movers(robot: RobotModel, index: int) -> Tensor:
    """`(nq,)` 1 for the joints that move a frame."""
    parent = robot.frame_parents[index]
    return torch.zeros_like(robot.revolute) if parent == BASE else robot.ancestors[parent]


def point_of_poses(robot: RobotModel, poses: LinkPoses, index: int, point: Tensor) -> Vector3:
    """Position relative to the base origin `(*batch, 3)` [m] of a point fixed in a frame, world axes."""
    rotation, position = _frame_in_base(robot, poses, index)
    return position + (rotation @ point[..., None])[..., 0]


def as_point(robot: RobotModel, point: object) -> Vector3:
    """A point `(3,)` given as a tuple or tensor, in the robot's precision and on its device."""
    return torch.as_tensor(point, dtype=robot.dtype, device=robot.device)


def frame_pose(robot: RobotModel, q: JointVector, frame: str) -> tuple[Rotation, Vector3]:
    """Pose of a named frame in the world.

    Args:
        robot: the robot.
        q: `(*batch, nq)` joint positions [rad, m].
        frame: name of a link or fixed frame.

    Returns:
        Rotation `(*batch, 3, 3)` and position `(*batch, 3)` [m].

    Raises:
        UnknownNameError: no such frame.
        ShapeError: q does not fit the robot.
    """
    rotation, position = _frame_in_base(robot, link_poses(robot, q), robot.frame_index(frame))
    return rotation, position + robot.base_position


def point_position(robot: RobotModel, q: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)) -> Vector3:
    """World position `(*batch, 3)` [m] of a point fixed in a frame (coordinates in that frame)."""
    R, p = frame_pose(robot, q, frame)
    return p + (R @ as_point(robot, point)[..., None])[..., 0]


def point_jacobian(
    robot: RobotModel, q: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> PointJacobian:
    """J with ṗ = J q̇ for a point fixed in a frame, `(*batch, 3, nq)`, world axes.

    Raises:
        UnknownNameError: no such frame.
        ShapeError: q does not fit the robot.
    """
    return frame_jacobian(robot, q, frame, point)[..., 3:, :]


def frame_jacobian(
    robot: RobotModel, q: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> FrameJacobian:
    """J with [ω; ṗ] = J q̇ for a frame and a point fixed in it, `(*batch, 6, nq)`, world axes."""
    index = robot.frame_index(frame)
    return jacobian_of_poses(robot, link_poses(robot, q), index, as_point(robot, point))


def jacobian_of_poses(robot: RobotModel, poses: LinkPoses, index: int, point: Tensor) -> FrameJacobian:
    """`frame_jacobian` from poses already known."""
    x = point_of_poses(robot, poses, index, point)
    linear = poses.linear + cross(poses.angular, x[..., None, :])
    screws = torch.cat([poses.angular, linear], dim=-1) * _movers(robot, index)[:, None]
    return screws.mT


def point_velocity(
    robot: RobotModel, q: JointVector, qd: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> Vector3:
    """ṗ = J q̇ of a point fixed in a frame, `(*batch, 3)` [m/s], world axes."""
    return (point_jacobian(robot, q, frame, point) @ qd[..., None])[..., 0]


def point_bias_acceleration(
    robot: RobotModel, q: JointVector, qd: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> Vector3:
    """J̇ q̇, the acceleration of a point fixed in a frame at q̈ = 0, `(*batch, 3)` [m/s²], world axes."""
    return frame_bias_acceleration(robot, q, qd, frame, point)[..., 3:]


def frame_bias_acceleration(
    robot: RobotModel, q: JointVector, qd: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> Tensor:
    """[ω̇; p̈] at q̈ = 0 of a frame and a point fixed in it, `(*batch, 6)` [rad/s²], [m/s²]."""
    robot.check_state(qd=qd)
    poses = link_poses(robot, q)
    motion = link_motion(robot, poses, qd)
    return bias_acceleration_of_motion(robot, poses, motion, robot.frame_index(frame), as_point(robot, point))


def bias_acceleration_of_motion(
    robot: RobotModel, poses: LinkPoses, motion: LinkMotion, index: int, point: Tensor
) -> Tensor:
    """`frame_bias_acceleration` from motion already known: a + α × x + ω × (v + ω × x)."""
    parent = robot.frame_parents[index]
    if parent == BASE:
        return torch.zeros(
            *poses.position.shape[:-2], 6, dtype=poses.position.dtype, device=poses.position.device
        )
    x = point_of_poses(robot, poses, index, point)
    omega, alpha = motion.omega[..., parent, :], motion.alpha[..., parent, :]
    velocity = motion.velocity[..., parent, :] + cross(omega, x)
    acceleration = motion.acceleration[..., parent, :] + cross(alpha, x) + cross(omega, velocity)
    return torch.cat([alpha, acceleration], dim=-1)
