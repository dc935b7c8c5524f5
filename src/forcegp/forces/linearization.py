"""The acceleration and the multiplier that a force field gives, with their derivatives by state and torque.

A system linearized at a fixed force (`constraints/gauss.py`) lacks how the force changes. With
F = Q̄ − Q_C − Q_G − Q_D, the part of the impressed forces that the robot file does not know,

    dq̈/dx = ∂q̈/∂x + H ∂F/∂x,   dλ/dx = ∂λ/∂x − Lᵀ ∂F/∂x   for x = q, q̇, τ.

The mechanics are differentiated in closed form, the force field by autograd.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.quantities import States, flat_states, states


class ForceLinearization(NamedTuple):
    """q̈ and λ at a state with their Jacobians, row = component of q̈ or λ.

    Attributes:
        qdd: `(*batch, nq)` acceleration [rad/s², m/s²].
        dq, dqd, dtau: `(*batch, nq, nq)` dq̈/dq, dq̈/dq̇ and dq̈/dτ.
        multiplier: `(*batch, m)` λ.
        multiplier_dq, multiplier_dqd, multiplier_dtau: `(*batch, m, nq)`.
    """

    qdd: Tensor
    dq: Tensor
    dqd: Tensor
    dtau: Tensor
    multiplier: Tensor
    multiplier_dq: Tensor
    multiplier_dqd: Tensor
    multiplier_dtau: Tensor


def linearize_field(
    force: Callable[[ConstrainedSystem, States], Tensor],
    system: ConstrainedSystem,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    active: Tensor | None = None,
) -> ForceLinearization:
    """Linearize the constrained motion under a force field.

    Args:
        force: the impressed force Q̄ at states, `(n, nq)`.
        system: robot and contacts.
        q, qd, tau: `(*batch, nq)` states.
        active: `(*batch, n_contacts)` bool, which contacts are closed; default all.

    Raises:
        ShapeError: an argument does not fit the system.
    """
    flat = flat_states(system, q, qd, tau, active)
    with torch.enable_grad():
        leaves = [x.detach().clone().requires_grad_() for x in (flat.q, flat.qd, flat.tau)]
        at = states(system, leaves[0], leaves[1], leaves[2], flat.active)
        F = force(system, at) - at.eom.Q_K
        rows = [
            torch.autograd.grad(component.sum(), leaves, retain_graph=True, materialize_grads=True)
            for component in F.unbind(-1)
        ]
    by_q, by_qd, by_tau = (torch.stack(parts, dim=-2) for parts in zip(*rows, strict=True))
    fixed = system.linearize(flat.q, flat.qd, F.detach(), flat.active)
    H, minus_Lt = fixed.dforce, fixed.multiplier_dforce
    found = (
        fixed.qdd,
        fixed.dq + H @ by_q,
        fixed.dqd + H @ by_qd,
        H @ by_tau,
        fixed.multiplier,
        fixed.multiplier_dq + minus_Lt @ by_q,
        fixed.multiplier_dqd + minus_Lt @ by_qd,
        minus_Lt @ by_tau,
    )
    return ForceLinearization(*(x.reshape(*flat.batch, *x.shape[1:]) for x in found))
