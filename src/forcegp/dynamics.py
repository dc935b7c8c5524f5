"""Mass matrix, bias and gravity forces, inverse and forward dynamics of a tree of rigid links.

All forces stand on the right-hand side: M q̈ = Q_C + Q_G + Q_D + Q_u. The algorithms are the composite
rigid-body and the recursive Newton-Euler algorithm (Featherstone, *Rigid Body Dynamics Algorithms*,
ch. 5 and 6), written in world axes so that sums over subtrees are products with the ancestor matrix.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.friction import JointFriction
from forcegp.kinematics import LinkMotion, LinkPoses, cross, link_motion, link_poses, skew
from forcegp.robot.model import RobotModel
from forcegp.types import JointMatrix, JointVector


class LinkInertia(NamedTuple):
    """Spatial inertias of the links about the base origin, world axes.

    Attributes:
        mass: `(*batch, nq)` [kg].
        moment: `(*batch, nq, 3)` first moment m c [kg m].
        inertia: `(*batch, nq, 3, 3)` second moment about the base origin [kg m²].
    """

    mass: Tensor
    moment: Tensor
    inertia: Tensor


def link_inertia(robot: RobotModel, poses: LinkPoses) -> LinkInertia:
    """Inertia of each link, moved to the base origin: I_o = R I_c Rᵀ + m(cᵀc 1 − c cᵀ)."""
    R = poses.rotation
    c = poses.position + (R @ robot.com[..., None])[..., 0]
    C = skew(c)
    inertia = R @ robot.inertia @ R.mT - robot.mass[:, None, None] * (C @ C)
    return LinkInertia(robot.mass.expand(c.shape[:-1]), robot.mass[:, None] * c, inertia)


def mass_matrix_of_poses(robot: RobotModel, poses: LinkPoses, links: LinkInertia) -> JointMatrix:
    """M_ij = s_iᵀ I^c_j s_j for i an ancestor of j, with the composite inertias I^c = Eᵀ I, plus the drives."""
    Et = robot.ancestors.mT
    mass, moment = links.mass @ robot.ancestors, Et @ links.moment
    inertia = (Et @ links.inertia.flatten(-2)).unflatten(-1, (3, 3))
    angular = (inertia @ poses.angular[..., None])[..., 0] + cross(moment, poses.linear)
    linear = mass[..., None] * poses.linear - cross(moment, poses.angular)
    M = (poses.angular @ angular.mT + poses.linear @ linear.mT) * Et
    return M + torch.triu(M, 1).mT + torch.diag_embed(robot.armature)


def gravity_force_of_poses(robot: RobotModel, poses: LinkPoses, links: LinkInertia) -> JointVector:
    """Q_G = sᵀ Eᵀ [m c × g; m g]."""
    Et, g = robot.ancestors.mT, robot.gravity
    torque = cross(Et @ links.moment, g)
    force = (links.mass @ robot.ancestors)[..., None] * g
    return (poses.angular * torque + poses.linear * force).sum(-1)


def _newton_euler(
    robot: RobotModel,
    poses: LinkPoses,
    links: LinkInertia,
    motion: LinkMotion,
    alpha: Tensor,
    acceleration: Tensor,
) -> JointVector:
    """Joint forces sᵀ Eᵀ (I a + V ×* I V) that links moving at V with spatial acceleration a need."""

    def momentum(w: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        turning = (links.inertia @ w[..., None])[..., 0] + cross(links.moment, v)
        return turning, links.mass[..., None] * v - cross(links.moment, w)

    n, l = momentum(motion.omega, motion.velocity)
    torque, force = momentum(alpha, acceleration)
    torque = torque + cross(motion.omega, n) + cross(motion.velocity, l)
    force = force + cross(motion.omega, l)
    Et = robot.ancestors.mT
    return (poses.angular * (Et @ torque) + poses.linear * (Et @ force)).sum(-1)


def bias_force_of_motion(
    robot: RobotModel, poses: LinkPoses, links: LinkInertia, motion: LinkMotion
) -> JointVector:
    """Q_C from link motion already known."""
    return -_newton_euler(robot, poses, links, motion, motion.alpha, motion.acceleration)


def mass_matrix(robot: RobotModel, q: JointVector) -> JointMatrix:
    """Generalized mass matrix M(q), symmetric positive definite.

    Args:
        robot: the robot.
        q: `(*batch, nq)` joint positions [rad, m].

    Returns:
        `(*batch, nq, nq)` [kg m², kg m, kg].

    Raises:
        ShapeError: q does not fit the robot.
    """
    poses = link_poses(robot, q)
    return mass_matrix_of_poses(robot, poses, link_inertia(robot, poses))


def gravity_force(robot: RobotModel, q: JointVector) -> JointVector:
    """Generalized gravity force Q_G(q), `(*batch, nq)` [N m, N].

    Raises:
        ShapeError: q does not fit the robot.
    """
    poses = link_poses(robot, q)
    return gravity_force_of_poses(robot, poses, link_inertia(robot, poses))


def bias_force(robot: RobotModel, q: JointVector, qd: JointVector) -> JointVector:
    """Generalized Coriolis and centrifugal force Q_C(q, q̇) on the right-hand side, `(*batch, nq)` [N m, N].

    Raises:
        ShapeError: q or qd does not fit the robot.
    """
    robot.check_state(qd=qd)
    poses = link_poses(robot, q)
    return bias_force_of_motion(robot, poses, link_inertia(robot, poses), link_motion(robot, poses, qd))


def damping_force(robot: RobotModel, qd: JointVector) -> JointVector:
    """Joint friction Q_D(q̇) of the robot: viscous, Coulomb and Stribeck, `(*batch, nq)` [N m, N].

    Raises:
        ShapeError: qd does not fit the robot.
    """
    robot.check_state(qd=qd)
    return JointFriction.of(robot).force(qd)


def inverse_dynamics(robot: RobotModel, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
    """Force Q_D + Q_u that the motion needs: M q̈ − Q_C − Q_G (recursive Newton-Euler).

    Args:
        robot: the robot.
        q, qd, qdd: `(*batch, nq)` joint positions, velocities, accelerations.

    Returns:
        `(*batch, nq)` [N m, N].

    Raises:
        ShapeError: an argument does not fit the robot.
    """
    robot.check_state(qd=qd, qdd=qdd)
    poses = link_poses(robot, q)
    motion = link_motion(robot, poses, qd)
    E = robot.ancestors
    alpha = motion.alpha + E @ (poses.angular * qdd[..., None])
    acceleration = motion.acceleration + E @ (poses.linear * qdd[..., None]) - robot.gravity
    force = _newton_euler(robot, poses, link_inertia(robot, poses), motion, alpha, acceleration)
    return force + robot.armature * qdd


def forward_dynamics(robot: RobotModel, q: JointVector, qd: JointVector, force: JointVector) -> JointVector:
    """Acceleration of free motion, q̈ = M⁻¹(force + Q_C + Q_G) (eq. 1).

    Args:
        robot: the robot.
        q, qd: `(*batch, nq)` joint positions and velocities.
        force: `(*batch, nq)` generalized force Q_D + Q_u (+ any other impressed force) [N m, N].

    Returns:
        q̈ `(*batch, nq)` [rad/s², m/s²].

    Raises:
        ShapeError: an argument does not fit the robot.
    """
    robot.check_state(qd=qd, force=force)
    poses = link_poses(robot, q)
    links = link_inertia(robot, poses)
    M = mass_matrix_of_poses(robot, poses, links)
    Q_C = bias_force_of_motion(robot, poses, links, link_motion(robot, poses, qd))
    Q = force + Q_C + gravity_force_of_poses(robot, poses, links)
    return torch.cholesky_solve(Q[..., None], torch.linalg.cholesky(M))[..., 0]


def kinetic_energy(robot: RobotModel, q: JointVector, qd: JointVector) -> Tensor:
    """½ q̇ᵀ M q̇, `(*batch,)` [J]."""
    robot.check_state(qd=qd)
    return 0.5 * (qd * (mass_matrix(robot, q) @ qd[..., None])[..., 0]).sum(-1)


def potential_energy(robot: RobotModel, q: JointVector) -> Tensor:
    """−Σ m g·c, relative to the base origin, `(*batch,)` [J]; its gradient is −Q_G."""
    poses = link_poses(robot, q)
    return -(link_inertia(robot, poses).moment @ robot.gravity).sum(-1)
