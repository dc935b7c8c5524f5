"""Derivatives of the constrained acceleration and of the multiplier with respect to state and force.

Differentiating M q̈ − Q_C − Q_G − Q_D − Aᵀλ = Q and A q̈ = b at fixed q̈ and λ leaves the residuals

    r_f = ∂Q − ∂ID + ∂Q_D + ∂(Aᵀ)λ,    r_c = ∂b − ∂A q̈,

from which ∂q̈ = H r_f + L r_c and ∂λ = (A M⁻¹ Aᵀ)⁺(r_c − A M⁻¹ r_f). The derivatives of inverse dynamics are
in closed form; those of the few constraint rows come from autograd. The pseudo-inverse itself is not
differentiated, so redundant constraints of constant rank do no harm.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.constraints.gauss import Equations
from forcegp.derivatives import inverse_dynamics_derivatives
from forcegp.robot.model import RobotModel
from forcegp.types import ConstraintMatrix, ConstraintVector, JointMatrix, JointVector


class Linearization(NamedTuple):
    """q̈ and λ at a state with their Jacobians, row = component of q̈ or λ.

    Attributes:
        qdd: `(*batch, nq)` constrained acceleration.
        dq, dqd, dforce: `(*batch, nq, nq)` ∂q̈/∂q, ∂q̈/∂q̇ and ∂q̈/∂Q = H.
        multiplier: `(*batch, m)` λ.
        multiplier_dq, multiplier_dqd, multiplier_dforce: `(*batch, m, nq)`. For redundant constraints, which
            determine only Aᵀλ, these are the Jacobians of least norm.
    """

    qdd: JointVector
    dq: JointMatrix
    dqd: JointMatrix
    dforce: JointMatrix
    multiplier: ConstraintVector
    multiplier_dq: ConstraintMatrix
    multiplier_dqd: ConstraintMatrix
    multiplier_dforce: ConstraintMatrix


def linearize(
    robot: RobotModel,
    eom: Equations,
    rows: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    q: JointVector,
    qd: JointVector,
    force: JointVector,
) -> Linearization:
    """The linearization at states whose equations of motion are known.

    Args:
        robot: the robot.
        eom: its equations of motion at (q, q̇).
        rows: A and b as a function of (q, q̇).
        q, qd: `(*batch, nq)` joint positions and velocities.
        force: `(*batch, nq)` motor torques and all other forces that the robot file does not know [N m, N].
    """
    with torch.no_grad():
        Q_bar = eom.Q_K + force
        qdd, multiplier = eom.acceleration(Q_bar), eom.multiplier(Q_bar)
        inverse = inverse_dynamics_derivatives(robot, q, qd, qdd)
    (g_q, g_qd), (h_q, _), damping = _residuals(robot, rows, q, qd, qdd, multiplier)
    with torch.no_grad():
        residual = {
            "dq": (h_q - inverse.dq, g_q),
            "dqd": (torch.diag_embed(damping) - inverse.dqd, g_qd),
        }
        M_inv_A = eom.M_inv_At.mT
        found = {name: eom.H @ r_f + eom.L @ r_c for name, (r_f, r_c) in residual.items()}
        carried = {
            name: eom.constraint_inertia @ (r_c - M_inv_A @ r_f) for name, (r_f, r_c) in residual.items()
        }
        return Linearization(
            qdd, found["dq"], found["dqd"], eom.H,
            multiplier, carried["dq"], carried["dqd"], -eom.L.mT,
        )  # fmt: skip


def _residuals(
    robot: RobotModel,
    rows: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    q: Tensor,
    qd: Tensor,
    qdd: Tensor,
    multiplier: Tensor,
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], Tensor]:
    """Jacobians of b − A q̈ and of Aᵀλ by q and q̇, and the diagonal of ∂Q_D/∂q̇, at fixed q̈ and λ."""
    with torch.enable_grad():
        q, qd = q.detach().clone().requires_grad_(), qd.detach().clone().requires_grad_()
        A, b = rows(q, qd)
        along = b - (A @ qdd[..., None])[..., 0]
        force = (A.mT @ multiplier[..., None])[..., 0]
        damping = dynamics.damping_force(robot, qd)
        return _jacobians(along, q, qd), _jacobians(force, q, qd), _diagonal(damping, qd)


def _jacobians(value: Tensor, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
    """∂value/∂q and ∂value/∂q̇ of samples that do not depend on each other, `(*batch, d, nq)`."""
    if value.shape[-1] == 0 or not value.requires_grad:
        empty = q.new_zeros(*value.shape, q.shape[-1])
        return empty, empty
    pairs = [
        torch.autograd.grad(component.sum(), (q, qd), retain_graph=True, materialize_grads=True)
        for component in value.unbind(-1)
    ]
    return torch.stack([by_q for by_q, _ in pairs], -2), torch.stack([by_qd for _, by_qd in pairs], -2)


def _diagonal(value: Tensor, qd: Tensor) -> Tensor:
    """Derivative of each component by its own velocity."""
    if not value.requires_grad:
        return torch.zeros_like(qd)
    return torch.autograd.grad(value.sum(), qd, materialize_grads=True)[0]
