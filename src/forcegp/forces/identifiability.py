"""How well data separate the joint force Q from the contact's dissipative force Q_z (remark 3.3).

Accelerations in contact depend on Q + Q_z alone. The two are told apart by where they act (Q_z only in
contact, along the tangent), by their inputs, and by measurements of either. Their posterior correlation
measures the
separation: at −1 only the sum is identifiable, at 0 each is known as well as the data allow.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import CONSTRAINT
from forcegp.forces.quantities import States, affine_map


def force_correlation(posterior: ForcePosterior, system: ConstrainedSystem, at: States) -> Tensor:
    """Posterior correlation of Q and Q_z at each state and joint, `(n, nq)`; 0 where one of them is certain.

    corr_i = Cov(Q_i, Q_z,i) / √(Var Q_i Var Q_z,i). The part of Q along the constraint, which accelerations
    never show, is left out.

    Args:
        posterior: over latent forces.
        system: robot and contacts.
        at: n states.
    """
    z = affine_map(system, at, ("joint_force", "contact_friction"))
    rows = posterior.rows(system, at, z)
    hidden = [prior.target == CONSTRAINT for prior in posterior.priors]
    operators = (torch.zeros_like(W) if own else W for own, W in zip(hidden, rows.operators, strict=True))
    covariance = posterior.covariance_of(dataclasses.replace(rows, operators=tuple(operators)))
    nq = system.robot.nq
    cross = covariance[:, :nq, nq:].diagonal(dim1=-2, dim2=-1)
    own = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0)
    scale = (own[:, :nq] * own[:, nq:]).sqrt()
    return torch.where(scale > 0.0, cross / scale.where(scale > 0.0, 1.0), 0.0).clamp(-1.0, 1.0)
