"""Figure 1: the structured covariance of accelerations, block by block, at real states."""

from __future__ import annotations

import torch

from forcegp.data import Dataset
from forcegp.forces.priors.base import CONSTRAINT
from forcegp.forces.quantities import states
from forcegp.gp.structured_covariance import Block, cross_gram
from forcegp.models.structured_gp import StructuredGP
from forcegp.report.data import CovarianceData, matrix, series

RANK_TOLERANCE = 1e-9
"""Eigenvalues below this share of the largest count as zero."""


@torch.no_grad()
def covariance_blocks(model: StructuredGP, data: Dataset, name: str) -> CovarianceData:
    """H, k_Q and H k_Q Hᵀ (eq. 32) with the learned hyperparameters, at the states of a data set.

    Args:
        model: a fitted model with priors on joint forces.
        data: the states, a few of them.
        name: of the model, for the figure.
    """
    system, fitted = model.system, model.posterior
    at = states(system, data.q, data.qd, data.tau, data.active(system.contact_names))
    # What no acceleration shows, a force along the constraint, is left out of the picture.
    pairs = [pair for pair in zip(fitted.priors, fitted.scales, strict=True) if pair[0].target != CONSTRAINT]
    priors = [prior for prior, _ in pairs]
    features = tuple(scale.apply(prior.features(system, at)) for prior, scale in pairs)
    E = tuple(prior.operator(system, at) for prior in priors)
    force = Block(features, E, torch.zeros_like(at.q))
    acceleration = Block(features, tuple(at.eom.H @ operator for operator in E), torch.zeros_like(at.q))
    k_Q, k_qdd = (
        cross_gram(priors, model.hyperparameters, [block], [block]) for block in (force, acceleration)
    )
    eigenvalues = torch.linalg.eigvalsh(k_qdd)
    return CovarianceData(
        model=name,
        t=series(data.t),
        nq=system.robot.nq,
        operators=[matrix(H) for H in at.eom.H],
        force=matrix(k_Q),
        acceleration=matrix(k_qdd),
        rank=int((eigenvalues > RANK_TOLERANCE * eigenvalues[-1]).sum()),
    )
