"""Poses, Jacobians and bias accelerations of a tree of joints, batched over states.

Spatial vectors are `[angular, linear]`, expressed in world axes about the base origin. With the joint screws
s_j in this form and the ancestor matrix E, the twist of link i is V_i = Σ_j E_ij s_j q̇_j. Therefore, only
the poses require recursion over the depth of the tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp import batchlast
from forcegp.batchlast import batch_first, batch_last, sum_over, take
from forcegp.errors import ShapeError
from forcegp.robot.model import BASE, RobotModel
from forcegp.types import FrameJacobian, JointVector, PointJacobian, Rotation, Vector3

Anchor = tuple[str, Sequence[float]]
"""A frame, and a point in the coordinates of that frame [m]."""


@dataclass(frozen=True)
class LinkPoses:
    """Poses of the links relative to the base origin, and the screws of their joints, in world axes.

    Attributes:
        batch: batch shape; B is the total number of states.
        R: `(3, 3, nq, B)` link axes.
        p: `(3, nq, B)` link origins [m].
        angular, linear: `(3, nq, B)` angular and linear parts of the joint screws s_j.
    """

    batch: torch.Size
    R: Tensor
    p: Tensor
    angular: Tensor
    linear: Tensor

    @property
    def rotation(self) -> Tensor:
        """Orientations of the links `(*batch, nq, 3, 3)`."""
        return batch_first(self.R, self.batch).movedim(-1, -3)

    @property
    def position(self) -> Tensor:
        """Origins of the links `(*batch, nq, 3)` [m]."""
        return batch_first(self.p, self.batch).mT


@dataclass(frozen=True)
class LinkMotion:
    """First-order motion of the links at a state (q, q̇).

    Attributes:
        omega, velocity: `(3, nq, B)` twists V_i [rad/s], [m/s].
        alpha, acceleration: `(3, nq, B)` spatial accelerations at q̈ = 0 [rad/s²], [m/s²].
    """

    omega: Tensor
    velocity: Tensor
    alpha: Tensor
    acceleration: Tensor


class PointMotion(NamedTuple):
    """Motion, in world axes, of a point fixed in a frame of the robot.

    Attributes:
        rotation: `(*batch, 3, 3)` orientation of the frame.
        position: `(*batch, 3)` position of the point [m].
        twist: `(*batch, 6)` [ω; ṗ] [rad/s], [m/s].
        jacobian: J `(*batch, 6, nq)` such that [ω; ṗ] = J q̇.
        bias: J̇ q̇ `(*batch, 6)`, the acceleration [ω̇; p̈] at q̈ = 0.
    """

    rotation: Tensor
    position: Tensor
    twist: Tensor
    jacobian: Tensor
    bias: Tensor

    @classmethod
    def of(cls, blocks: Sequence[Tensor], qd: Tensor) -> PointMotion:
        """Construct the motion from q̇ and the rotation, position, J and J̇ q̇ given by a compiled kernel."""
        rotation, position, J, bias = blocks
        return cls(rotation, position, vecdot(J, qd[..., None, :]), J, bias)


def skew(v: Vector3) -> Rotation:
    """Return the skew-symmetric matrix [v]×, which satisfies [v]× w = v × w."""
    return batchlast.skew(v.movedim(-1, 0)).movedim((0, 1), (-2, -1))


def common_states(robot: RobotModel, **states: Tensor) -> tuple[Tensor, ...]:
    """Check joint-space arguments and broadcast their batch shapes; raise `ShapeError` on a mismatch."""
    robot.check_state(**states)
    if len({value.shape for value in states.values()}) == 1:
        return tuple(states.values())
    try:
        return torch.broadcast_tensors(*states.values())
    except RuntimeError:
        shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in states.items())
        text = f"the batch shapes of {', '.join(states)} do not broadcast"
        expected = f"batch shapes that broadcast, each followed by {robot.nq}"
        raise ShapeError(text, expected=expected, got=shapes) from None


def _local_poses(robot: RobotModel, q: Tensor) -> Tensor:
    """Return the pose [R p] of each link relative to its parent, `(3, 4, nq, B)`, by Rodrigues' formula.

    R = P a aᵀ + sin(q) P K + cos(q) (P − P a aᵀ), with the constant axis a, K = [a]× and the placement P.
    """
    q, P, a = batch_last(q, 1), robot.placement_rotation, robot.axis[:, None, :]
    slide = (P * a).sum(-1)
    along = slide[..., None] * a
    # The fourth column contains the position of the joint, which does not rotate.
    still = torch.cat([along, robot.placement_position[..., None]], dim=-1)
    sine = torch.nn.functional.pad(torch.linalg.cross(P, a.expand_as(P)), (0, 1))
    cosine = torch.nn.functional.pad(P - along, (0, 1))
    still, sine, cosine = (x.permute(1, 2, 0)[..., None] for x in (still, sine, cosine))
    if "prismatic" not in robot.joint_types:
        return torch.addcmul(torch.addcmul(still, sine, torch.sin(q)), cosine, torch.cos(q))
    turns = robot.revolute[:, None]
    angle = q * turns
    slides = torch.nn.functional.pad(slide[..., None], (3, 0)).permute(1, 2, 0)[..., None]
    turned = torch.addcmul(torch.addcmul(still, sine, torch.sin(angle)), cosine, torch.cos(angle))
    return torch.addcmul(turned, slides, q * (1.0 - turns))


def _chain(robot: RobotModel, levels: Sequence[Sequence[int]], q: JointVector) -> Tensor:
    """Return R_parent [R p]_local of every link, `(3, 4, nq, B)`, processing one tree level at a time."""
    local = _local_poses(robot, q)
    turned, parents = robot.base_rotation[..., None, None], [BASE]
    blocks, order = [], []
    for level in levels:
        slots = [parents.index(robot.parents[i]) for i in level]
        turned = batchlast.product(take(turned[:, :3], slots), take(local, level))
        blocks.append(turned)
        order += [*level]
        parents = list(level)
    return take(torch.cat(blocks, dim=2), [order.index(i) for i in range(robot.nq)])


def link_poses(robot: RobotModel, q: JointVector) -> LinkPoses:
    """Return the poses R_i = R_parent R_i^local of all links, and the joint screws, at q in world axes.

    Raises:
        ShapeError: q has the wrong shape for the robot.
    """
    robot.check_state(q=q)
    T = _chain(robot, robot.levels, q)
    R, p = T[:, :3], sum_over(robot.ancestors, T[:, 3])
    z = batchlast.apply(R, robot.axis.T[..., None])
    if "prismatic" not in robot.joint_types:
        return LinkPoses(q.shape[:-1], R, p, z, batchlast.cross(p, z))
    turns = robot.revolute[:, None]
    return LinkPoses(q.shape[:-1], R, p, turns * z, turns * batchlast.cross(p, z) + (1.0 - turns) * z)


def link_motion(robot: RobotModel, poses: LinkPoses, qd: JointVector) -> LinkMotion:
    """Return the twists V = E(s q̇) and the accelerations E(ṡ q̇) at q̈ = 0, with ṡ_j = V_j × s_j."""
    rate, E = batch_last(qd.expand(*poses.batch, robot.nq), 1), robot.ancestors
    turning, sliding = poses.angular * rate, poses.linear * rate
    omega, velocity = sum_over(E, turning), sum_over(E, sliding)
    alpha = sum_over(E, batchlast.cross(omega, turning))
    turned = batchlast.cross(omega, sliding) + batchlast.cross(velocity, turning)
    return LinkMotion(omega, velocity, alpha, sum_over(E, turned))


def _frame_in_base(robot: RobotModel, poses: LinkPoses, index: int) -> tuple[Tensor, Tensor]:
    """Return rotation `(3, 3, B)` and position `(3, B)` of a frame relative to the base, in world axes."""
    parent, R, p = robot.frame_parents[index], robot.frame_rotation[index], robot.frame_position[index]
    if parent == BASE:
        B, base = poses.p.shape[-1], robot.base_rotation
        return (base @ R)[..., None].expand(3, 3, B), (base @ p)[:, None].expand(3, B)
    link = poses.R[:, :, parent]
    return batchlast.product(link, R[..., None]), poses.p[:, parent] + batchlast.apply(link, p[:, None])


def pose_of_frame(robot: RobotModel, poses: LinkPoses, index: int) -> tuple[Rotation, Vector3]:
    """Return the rotation `(*batch, 3, 3)` and position `(*batch, 3)` [m] of a frame relative to the base."""
    rotation, position = _frame_in_base(robot, poses, index)
    return batch_first(rotation, poses.batch), batch_first(position, poses.batch)


def as_point(robot: RobotModel, point: object) -> Vector3:
    """Convert a point `(3,)`, given as a tuple or tensor, to the robot's precision and device."""
    return torch.as_tensor(point, dtype=robot.dtype, device=robot.device)


def frame_pose(robot: RobotModel, q: JointVector, frame: str) -> tuple[Rotation, Vector3]:
    """Return the rotation `(*batch, 3, 3)` and position `(*batch, 3)` [m] of a named frame in the world.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> q = torch.zeros(5, 2, dtype=torch.float64)
        >>> rotation, position = frame_pose(robot, q, robot.frame_names[-1])
        >>> rotation.shape, position.shape
        (torch.Size([5, 3, 3]), torch.Size([5, 3]))

    Raises:
        UnknownNameError: the frame does not exist.
        ShapeError: q has the wrong shape for the robot.
    """
    rotation, position = pose_of_frame(robot, link_poses(robot, q), robot.frame_index(frame))
    return rotation, position + robot.base_position


def point_position(robot: RobotModel, q: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)) -> Vector3:
    """Return the world position `(*batch, 3)` [m] of a point given in the coordinates of a frame."""
    R, p = frame_pose(robot, q, frame)
    return p + (R @ as_point(robot, point)[..., None])[..., 0]


def point_jacobian(
    robot: RobotModel, q: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> PointJacobian:
    """Return J `(*batch, 3, nq)` of a point fixed in a frame, such that ṗ = J q̇ (see `frame_jacobian`)."""
    return frame_jacobian(robot, q, frame, point)[..., 3:, :]


def frame_jacobian(
    robot: RobotModel, q: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> FrameJacobian:
    """Return J `(*batch, 6, nq)` of a point fixed in a frame, such that [ω; ṗ] = J q̇ in world axes.

    Raises:
        UnknownNameError: the frame does not exist.
        ShapeError: q has the wrong shape for the robot.
    """
    index = robot.frame_index(frame)
    return jacobian_of_poses(robot, link_poses(robot, q), index, as_point(robot, point))


def point_motion(
    robot: RobotModel,
    poses: LinkPoses,
    motion: LinkMotion,
    qd: JointVector,
    frame: str,
    point: object = (0.0, 0.0, 0.0),
) -> PointMotion:
    """Return the motion of a point fixed in a frame, computed from the motion of the links.

    Raises:
        UnknownNameError: the frame does not exist.
    """
    index, local = robot.frame_index(frame), as_point(robot, point)
    rotation, origin = _frame_in_base(robot, poses, index)
    x = origin + batchlast.apply(rotation, local[:, None])
    J, bias = _jacobian(robot, poses, index, x), _bias(robot, poses, motion, index, x)
    blocks = rotation, x + robot.base_position[:, None], J, bias
    return PointMotion.of([batch_first(block, poses.batch) for block in blocks], qd)


def jacobian_of_poses(robot: RobotModel, poses: LinkPoses, index: int, point: Tensor) -> FrameJacobian:
    """Return the Jacobian of `frame_jacobian`, computed from known poses."""
    rotation, origin = _frame_in_base(robot, poses, index)
    x = origin + batchlast.apply(rotation, point[:, None])
    return batch_first(_jacobian(robot, poses, index, x), poses.batch)


def _jacobian(robot: RobotModel, poses: LinkPoses, index: int, x: Tensor) -> Tensor:
    """Return J `(6, nq, B)` of a point at x `(3, B)` that is fixed in a frame."""
    linear = poses.linear + batchlast.cross(poses.angular, x[:, None])
    parent = robot.frame_parents[index]
    moving = torch.zeros_like(robot.revolute) if parent == BASE else robot.ancestors[parent]
    return torch.cat([poses.angular, linear]) * moving[:, None]


def point_velocity(
    robot: RobotModel, q: JointVector, qd: JointVector, frame: str, point: object = (0.0, 0.0, 0.0)
) -> Vector3:
    """Return the world velocity ṗ = J q̇ `(*batch, 3)` [m/s] of a point fixed in a frame."""
    return (point_jacobian(robot, q, frame, point) @ qd[..., None])[..., 0]


def _bias(robot: RobotModel, poses: LinkPoses, motion: LinkMotion, index: int, x: Tensor) -> Tensor:
    """Return [α; a + α × x + ω × (v + ω × x)] `(6, B)` for a point at x `(3, B)` that is fixed in a frame."""
    parent = robot.frame_parents[index]
    if parent == BASE:
        return poses.p.new_zeros(6, poses.p.shape[-1])
    omega, alpha = motion.omega[:, parent], motion.alpha[:, parent]
    velocity = motion.velocity[:, parent] + batchlast.cross(omega, x)
    turned = batchlast.cross(alpha, x) + batchlast.cross(omega, velocity)
    return torch.cat([alpha, motion.acceleration[:, parent] + turned])
