"""Closed-form derivatives of inverse and forward dynamics with respect to the state and the force.

Differentiating M q̈ − Q_C − Q_G = τ gives ∂q̈ = M⁻¹(∂τ − ∂ID), where ∂ID is taken at constant q̈ (Carpentier
& Mansard, *Analytical derivatives of rigid body dynamics algorithms*, RSS 2018). ∂ID is computed in world
axes from composite quantities of the subtrees (Singh, Russell & Wensing, *Efficient analytical derivatives of
rigid-body dynamics using spatial vector algebra*, RA-L 2022).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp import batchlast, dynamics
from forcegp.batchlast import apply, batch_first, batch_last, cross, dot, sum_over
from forcegp.kinematics import LinkMotion, LinkPoses, common_states, link_motion, link_poses
from forcegp.robot.model import RobotModel
from forcegp.types import JointMatrix, JointVector


class InverseDynamicsDerivatives(NamedTuple):
    """Jacobians ∂ID/∂q, ∂ID/∂q̇ and ∂ID/∂q̈ = M, each `(*batch, nq, nq)`, with one row per joint."""

    dq: JointMatrix
    dqd: JointMatrix
    dqdd: JointMatrix


class ForwardDynamicsDerivatives(NamedTuple):
    """Jacobians ∂q̈/∂q, ∂q̈/∂q̇ and ∂q̈/∂force = M⁻¹, each `(*batch, nq, nq)`, with one row per joint."""

    dq: JointMatrix
    dqd: JointMatrix
    dforce: JointMatrix


def _pairs(robot: RobotModel, up: Tensor, down: Tensor) -> Tensor:
    """Return D with D_ij = up_ij if joint j moves link i, and D_ij = down_ij if joint i moves link j."""
    E = robot.ancestors[..., None]
    strictly = torch.tril(robot.ancestors, -1).mT[..., None]
    return up * E + down * strictly


def _gyration(links: dynamics.LinkInertia, omega: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return N = 2 ω×I − tr(I) ω× − 2 h×v×, and the linear momentum l, for each link."""
    w = batchlast.skew(omega)
    trace = links.inertia.diagonal(dim1=0, dim2=1).sum(-1)
    N = 2.0 * batchlast.product(w, links.inertia) - trace * w
    N = N - 2.0 * batchlast.product(batchlast.skew(links.moment), batchlast.skew(v))
    return N, links.mass * v - cross(links.moment, omega)


def _inverse_derivatives(
    robot: RobotModel, poses: LinkPoses, links: dynamics.LinkInertia, motion: LinkMotion, qdd: Tensor
) -> tuple[Tensor, Tensor]:
    """Return ∂ID/∂q and ∂ID/∂q̇ `(nq, nq, B)`, with the batch dimension last.

    The subtree of joint i has the composite inertia I, the linear momentum l and the force F, and 2B = [[N,
    0], [−2 l×, 0]] with N from `_gyration`. Let Ṡ = V×S and S̈ = a×S + V×Ṡ for each joint. If j moves i, then
    ∂τ_i/∂q_j = S_i·(2B Ṡ_j + I S̈_j). If i moves j, then ∂τ_i/∂q_j = S_i·(2B Ṡ_j + I S̈_j + S_j ×* F),
    evaluated for the subtree of j. In ∂τ/∂q̇, S and 2 Ṡ replace Ṡ and S̈, and the term with F is absent.
    """
    Et, z, l, omega, v = robot.ancestors.mT, poses.angular, poses.linear, motion.omega, motion.velocity
    alpha, a = dynamics.accelerations(robot, poses, motion, qdd)
    torque, force = dynamics.link_force(links, motion, alpha, a)

    N, momentum = (sum_over(Et, x) for x in _gyration(links, omega, v))
    torque, force = sum_over(Et, torque), sum_over(Et, force)
    whole = dynamics.LinkInertia(Et @ links.mass, sum_over(Et, links.moment), sum_over(Et, links.inertia))

    def weigh(angular: Tensor, linear: Tensor) -> Tensor:
        return torch.cat(dynamics.momentum(whole, angular, linear))

    rate = torch.cat([cross(omega, z), cross(omega, l) + cross(v, z)])
    bend_z = cross(alpha, z) + cross(omega, rate[:3])
    bend_l = cross(alpha, l) + cross(a, z) + cross(omega, rate[3:]) + cross(v, rate[:3])
    bend = torch.cat([bend_z, bend_l])
    S = torch.cat([z, l])
    row = apply(N.transpose(0, 1), z) + 2.0 * cross(momentum, l)
    weight = weigh(z, l)

    def turned(x: Tensor) -> Tensor:
        return torch.cat([apply(N, x), 2.0 * cross(x, momentum)])

    carried = torch.cat([cross(z, torque) + cross(l, force), cross(z, force)])
    column_q = turned(rate[:3]) + weigh(bend_z, bend_l) + carried
    column_v = turned(z) + 2.0 * weigh(rate[:3], rate[3:])

    def each(left: Tensor, right: Tensor) -> Tensor:
        return dot(left.unsqueeze(2), right.unsqueeze(1))

    dq = _pairs(robot, each(row, rate[:3]) + each(weight, bend), each(S, column_q))
    return dq, _pairs(robot, each(row, z) + 2.0 * each(weight, rate), each(S, column_v))


def inverse_dynamics_derivatives(
    robot: RobotModel, q: JointVector, qd: JointVector, qdd: JointVector
) -> InverseDynamicsDerivatives:
    """Return the Jacobians of `inverse_dynamics` with respect to q, q̇ and q̈ `(*batch, nq)`.

    Raises:
        ShapeError: an argument has the wrong shape for the robot.
    """
    q, qd, qdd = common_states(robot, q=q, qd=qd, qdd=qdd)
    poses = link_poses(robot, q)
    links, motion = dynamics.link_inertia(robot, poses), link_motion(robot, poses, qd)
    dq, dqd = _inverse_derivatives(robot, poses, links, motion, batch_last(qdd, 1))
    M = dynamics.mass_matrix_of(robot, poses, links)
    return InverseDynamicsDerivatives(*(batch_first(x, poses.batch) for x in (dq, dqd, M)))


def forward_dynamics_derivatives(
    robot: RobotModel, q: JointVector, qd: JointVector, force: JointVector
) -> ForwardDynamicsDerivatives:
    """Return the Jacobians of `forward_dynamics` with respect to q, q̇ and the force, which are −M⁻¹ ∂ID/∂q,
    −M⁻¹ ∂ID/∂q̇ and M⁻¹. ∂ID is evaluated at the resulting q̈.

    Raises:
        ShapeError: an argument has the wrong shape for the robot.
    """
    q, qd, force = common_states(robot, q=q, qd=qd, force=force)
    poses = link_poses(robot, q)
    links, motion = dynamics.link_inertia(robot, poses), link_motion(robot, poses, qd)
    M, needed = dynamics.equation_of_motion(robot, poses, links, motion)
    eye = torch.eye(robot.nq, dtype=q.dtype, device=q.device)[..., None]
    inverse = batchlast.solve_spd(M, eye.expand_as(M))
    qdd = apply(inverse, batch_last(force, 1) - needed)
    dq, dqd = _inverse_derivatives(robot, poses, links, motion, qdd)
    jacobians = -batchlast.product(inverse, dq), -batchlast.product(inverse, dqd), inverse
    return ForwardDynamicsDerivatives(*(batch_first(x, poses.batch) for x in jacobians))
