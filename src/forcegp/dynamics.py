"""Mass matrix, bias and gravity forces, inverse dynamics and forward dynamics of a tree of rigid links.

All forces appear on the right-hand side: M q̈ = Q_C + Q_G + Q_D + Q_u. The composite rigid-body algorithm and
the recursive Newton-Euler algorithm (Featherstone, *Rigid Body Dynamics Algorithms*, ch. 5 and 6) are
formulated in world axes, so that sums over subtrees become products with the ancestor matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp import batchlast
from forcegp.batchlast import apply, batch_first, batch_last, cross, dot, sum_over
from forcegp.kinematics import LinkMotion, LinkPoses, common_states, link_motion, link_poses
from forcegp.robot.model import RobotModel
from forcegp.types import JointMatrix, JointVector


@dataclass(frozen=True)
class LinkInertia:
    """Spatial inertias of the links about the base origin, in world axes.

    Attributes:
        mass: `(nq, 1)` [kg].
        moment: `(3, nq, B)` first moment of mass m c [kg m].
        inertia: `(3, 3, nq, B)` rotational inertia about the base origin [kg m²].
    """

    mass: Tensor
    moment: Tensor
    inertia: Tensor


def link_inertia(robot: RobotModel, poses: LinkPoses) -> LinkInertia:
    """Return the inertia of each link about the base origin, I_o = R I_c Rᵀ + m(cᵀc 1 − c cᵀ)."""
    R, mass = poses.R, robot.mass[:, None]
    c = poses.p + apply(R, robot.com.T[..., None])
    moment = mass * c
    turned = batchlast.product(R, robot.inertia.permute(1, 2, 0)[..., None])
    inertia = batchlast.product(turned, R.transpose(0, 1))
    inertia = torch.addcmul(inertia, c[:, None], moment, value=-1)
    eye = torch.eye(3, dtype=mass.dtype, device=mass.device)[..., None, None]
    return LinkInertia(mass, moment, torch.addcmul(inertia, eye, dot(c, moment)))


def mass_matrix_of(robot: RobotModel, poses: LinkPoses, links: LinkInertia) -> Tensor:
    """Return M `(nq, nq, B)`, with M_ij = s_iᵀ (Eᵀ I)_j s_j for ancestors i of j, plus the armature."""
    E, S, L = robot.ancestors, poses.angular, poses.linear
    whole = LinkInertia(E.mT @ links.mass, sum_over(E.mT, links.moment), sum_over(E.mT, links.inertia))
    angular, linear = momentum(whole, S, L)
    M = dot(torch.cat([S, L]).unsqueeze(2), torch.cat([angular, linear]).unsqueeze(1))
    strictly = torch.tril(E, -1)
    upper = torch.addcmul(robot.drive_inertia[..., None], M, E.mT[..., None])
    return torch.addcmul(upper, M.transpose(0, 1), strictly[..., None])


def _gravity_force(robot: RobotModel, poses: LinkPoses, links: LinkInertia) -> Tensor:
    """Return Q_G = sᵀ Eᵀ [m c × g; m g] `(nq, B)`, with the batch dimension last."""
    Et, g = robot.ancestors.mT, robot.gravity[:, None, None]
    torque = cross(sum_over(Et, links.moment), g)
    return dot(poses.angular, torque) + dot(poses.linear, (Et @ links.mass) * g)


def momentum(links: LinkInertia, w: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return the momentum for a motion vector [w; v]: I w + h × v and m v − h × w, each `(3, nq, B)`."""
    return apply(links.inertia, w) + cross(links.moment, v), links.mass * v - cross(links.moment, w)


def link_force(
    links: LinkInertia, motion: LinkMotion, alpha: Tensor, acceleration: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the torque and force I a + V ×* I V for velocity V and acceleration a, each `(3, nq, B)`."""
    n, l = momentum(links, motion.omega, motion.velocity)
    torque, force = momentum(links, alpha, acceleration)
    torque = torque + cross(motion.omega, n) + cross(motion.velocity, l)
    return torque, force + cross(motion.omega, l)


def _joint_force(robot: RobotModel, poses: LinkPoses, torque: Tensor, force: Tensor) -> Tensor:
    """Return the joint forces sᵀ Eᵀ [torque; force], `(nq, B)`, that balance the forces on the links."""
    Et = robot.ancestors.mT
    return dot(poses.angular, sum_over(Et, torque)) + dot(poses.linear, sum_over(Et, force))


def _bias_force(robot: RobotModel, poses: LinkPoses, links: LinkInertia, motion: LinkMotion) -> Tensor:
    """Return Q_C `(nq, B)`, with the batch dimension last."""
    return -_joint_force(robot, poses, *link_force(links, motion, motion.alpha, motion.acceleration))


def known_terms(
    robot: RobotModel, poses: LinkPoses, motion: LinkMotion, qd: JointVector
) -> tuple[JointMatrix, JointVector, JointVector, JointVector]:
    """Return M, Q_C, Q_G and Q_D from the motion of the links and the parameters in the robot file."""
    links, Q_D = link_inertia(robot, poses), damping_force(robot, qd)
    M, Q_C = mass_matrix_of(robot, poses, links), _bias_force(robot, poses, links, motion)
    Q_G = _gravity_force(robot, poses, links)
    return *(batch_first(x, poses.batch) for x in (M, Q_C, Q_G)), Q_D  # pyright: ignore[reportReturnType]


def accelerations(
    robot: RobotModel, poses: LinkPoses, motion: LinkMotion, qdd: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the spatial accelerations `(3, nq, B)` of links for q̈ `(nq, B)` and base acceleration −g."""
    E = robot.ancestors
    linear = motion.acceleration + sum_over(E, poses.linear * qdd) - robot.gravity[:, None, None]
    return motion.alpha + sum_over(E, poses.angular * qdd), linear


def equation_of_motion(
    robot: RobotModel, poses: LinkPoses, links: LinkInertia, motion: LinkMotion
) -> tuple[Tensor, Tensor]:
    """Return M `(nq, nq, B)` and −(Q_C + Q_G) `(nq, B)` in the equation M q̈ − Q_C − Q_G = force."""
    # Gravity enters as an acceleration of the base, so one pass gives both forces.
    lifted = motion.acceleration - robot.gravity[:, None, None]
    torque, force = link_force(links, motion, motion.alpha, lifted)
    return mass_matrix_of(robot, poses, links), _joint_force(robot, poses, torque, force)


def mass_matrix(robot: RobotModel, q: JointVector) -> JointMatrix:
    """Return the symmetric positive definite mass matrix M(q) `(*batch, nq, nq)` [kg m², kg m, kg].

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> q = torch.zeros(5, 2, dtype=torch.float64)
        >>> mass_matrix(robot, q).shape
        torch.Size([5, 2, 2])

    Raises:
        ShapeError: q has the wrong shape for the robot.
    """
    poses = link_poses(robot, q)
    return batch_first(mass_matrix_of(robot, poses, link_inertia(robot, poses)), poses.batch)


def gravity_force(robot: RobotModel, q: JointVector) -> JointVector:
    """Return the generalized gravity force Q_G(q), `(*batch, nq)` [N m, N].

    Raises:
        ShapeError: q has the wrong shape for the robot.
    """
    poses = link_poses(robot, q)
    return batch_first(_gravity_force(robot, poses, link_inertia(robot, poses)), poses.batch)


def bias_force(robot: RobotModel, q: JointVector, qd: JointVector) -> JointVector:
    """Return the Coriolis and centrifugal force Q_C(q, q̇) on the right-hand side `(*batch, nq)` [N m, N].

    Raises:
        ShapeError: q or qd has the wrong shape for the robot.
    """
    q, qd = common_states(robot, q=q, qd=qd)
    poses = link_poses(robot, q)
    force = _bias_force(robot, poses, link_inertia(robot, poses), link_motion(robot, poses, qd))
    return batch_first(force, poses.batch)


def damping_force(robot: RobotModel, qd: JointVector, slip: JointVector | None = None) -> JointVector:
    """Return the viscous, Coulomb and Stribeck friction of the joints, `(*batch, nq)` [N m, N].

    Q_D = −(d + b |q̇| + c q̇²) q̇ − (f_c + f_s e^{−(q̇/v_s)²}) tanh(q̇/v_0), where tanh smooths friction near
    zero speed. If the sliding direction `slip` `(*batch, nq)` is given, it replaces tanh(q̇/v_0). With coupled
    drives, q̇ are the speeds of the drives. Source: Armstrong-Hélouvry et al., *A survey of models, analysis
    tools and compensation methods for the control of machines with friction* (1994).

    Raises:
        ShapeError: qd has the wrong shape for the robot.
    """
    robot.check_state(qd=qd)
    v = robot.drive_motion(qd)
    dry = robot.friction + robot.stribeck * torch.exp(-((v / robot.stribeck_velocity) ** 2))
    along = torch.tanh(v / robot.friction_velocity) if slip is None else slip
    damping = robot.damping
    if robot.drag is not None:
        damping = damping + robot.drag[:, 0] * v.abs() + robot.drag[:, 1] * v * v
    return robot.joint_torque(-damping * v - dry * along)


def inverse_dynamics(robot: RobotModel, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
    """Return the force Q_D + Q_u = M q̈ − Q_C − Q_G required for a given motion, `(*batch, nq)` [N m, N].

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> q = torch.zeros(5, 2, dtype=torch.float64)
        >>> force = inverse_dynamics(robot, q, 0 * q, 0 * q)  # at rest, only gravity is left
        >>> bool(torch.allclose(force, -gravity_force(robot, q)))
        True

    Raises:
        ShapeError: an argument has the wrong shape for the robot.
    """
    q, qd, qdd = common_states(robot, q=q, qd=qd, qdd=qdd)
    poses = link_poses(robot, q)
    motion, a = link_motion(robot, poses, qd), batch_last(qdd, 1)
    wrench = link_force(link_inertia(robot, poses), motion, *accelerations(robot, poses, motion, a))
    return batch_first(_joint_force(robot, poses, *wrench) + robot.drive_inertia @ a, poses.batch)


def forward_dynamics(robot: RobotModel, q: JointVector, qd: JointVector, force: JointVector) -> JointVector:
    """Return q̈ = M⁻¹(force + Q_C + Q_G) for free motion (eq. 1), `(*batch, nq)` [rad/s², m/s²].

    Args:
        robot: the robot.
        q, qd: `(*batch, nq)` joint positions and velocities.
        force: `(*batch, nq)` generalized force Q_D + Q_u, plus any other impressed force [N m, N].

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> q = torch.zeros(5, 2, dtype=torch.float64)
        >>> qdd = forward_dynamics(robot, q, 0 * q, -gravity_force(robot, q))
        >>> bool((qdd == 0.0).all())
        True

    Raises:
        ShapeError: an argument has the wrong shape for the robot.
    """
    q, qd, force = common_states(robot, q=q, qd=qd, force=force)
    poses = link_poses(robot, q)
    M, needed = equation_of_motion(robot, poses, link_inertia(robot, poses), link_motion(robot, poses, qd))
    Q = batch_last(force, 1) - needed
    return batch_first(batchlast.solve_spd(M, Q.unsqueeze(1)).squeeze(1), poses.batch)
