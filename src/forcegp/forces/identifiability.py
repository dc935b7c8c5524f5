"""What data do not determine: Q and Q_z that are not told apart (remark 3.3), multipliers, inflated noise.

Accelerations in contact depend on Q + Q_z alone. The two are told apart by where they act (Q_z only in
contact, along the tangent), by their inputs, and by measurements of either. Their posterior correlation
measures the separation: at −1 only the sum is identifiable, at 0 each is known as well as the data allow.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.measurements import Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import CONSTRAINT, CONTACT, JOINT
from forcegp.forces.quantities import States, affine_map

CORRELATION_STATES = 50
"""Training states at which the correlation of Q and Q_z is evaluated after a fit."""
UNDETERMINED = 10.0
"""Standard deviations of the multiplier per its size from which a fit warns."""
LARGE_JITTER = 0.01
"""Jitter, relative to unit noise, from which a fit warns: the noise grows by half of it."""


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
    operators = (torch.zeros_like(W) if hide else W for hide, W in zip(hidden, rows.operators, strict=True))
    covariance = posterior.latent.covariance(dataclasses.replace(rows, operators=tuple(operators)))
    # Cov(Q_i, Q_z,i)/√(Var Q_i Var Q_z,i)
    nq = system.robot.nq
    cross = covariance[:, :nq, nq:].diagonal(dim1=-2, dim2=-1)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    scale = (variance[:, :nq] * variance[:, nq:]).sqrt()
    return torch.where(scale > 0.0, cross / scale.where(scale > 0.0, 1.0), 0.0).clamp(-1.0, 1.0)


@dataclass(frozen=True)
class Doubts:
    """What a fit is doubtful about.

    Attributes:
        correlation: mean correlation of Q and Q_z over some of the training states, where both have priors.
        warnings: each with a remedy.
    """

    correlation: float | None
    warnings: tuple[str, ...]


def doubts_of(posterior: ForcePosterior, system: ConstrainedSystem, training: Training) -> Doubts:
    """What a posterior is doubtful about at some of its training states in contact.

    Args:
        posterior: over latent forces.
        system: robot and contacts.
        training: what the posterior is conditioned on.
    """
    few = training.thinned(min(CORRELATION_STATES, training.samples)).measurements if training.samples else ()
    # Elsewhere Q_z is zero, and there is no multiplier.
    closed = [m[m.active.any(-1).nonzero()[:, 0]] for m in few]
    targets = {prior.target for prior in posterior.priors}
    means, variances, correlations = [], [], []
    for m in (m for m in closed if len(m.q)):
        at = m.at(system)
        mean, covariance = posterior.read(system, at, affine_map(system, at, "multiplier"))
        loaded = system.active_rows(m.active, m.active.shape[:-1])
        means.append(mean[loaded])
        variances.append(covariance.diagonal(dim1=-2, dim2=-1)[loaded])
        if {JOINT, CONTACT} <= targets:
            correlations.append(force_correlation(posterior, system, at))
    correlation = float(torch.cat(correlations).mean()) if correlations else None
    warnings = _on_multiplier(torch.cat(means), torch.cat(variances)) if means else ()
    jitter = posterior.latent.jitter
    if jitter >= LARGE_JITTER:
        warnings += (
            f"the covariance was factorised with a jitter of {jitter:.2g} times the noise variance: "
            "drop duplicated rows, or state a larger noise",
        )
    return Doubts(correlation, warnings)


def _on_multiplier(mean: Tensor, variance: Tensor) -> tuple[str, ...]:
    """A warning where the multiplier is so uncertain that it is not determined by the data."""
    size, spread = float(mean.abs().median()), float(variance.sqrt().median())
    if spread <= UNDETERMINED * max(size, 1e-12):
        return ()
    return (
        f"the multiplier is not determined by these data: its standard deviation is {spread:.3g} N at a "
        f"median of {size:.3g} N; use the analytical mean, measure a force, or leave out priors that act "
        "along the normal",
    )
