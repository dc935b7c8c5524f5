"""What a fit is doubtful about: undetermined multipliers, inflated noise, forces that are not told apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.identifiability import force_correlation
from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import CONTACT, JOINT, ForcePrior
from forcegp.forces.quantities import affine_map
from forcegp.gp.sparse import SparsePosterior

CORRELATION_STATES = 50
"""Training states at which the correlation of Q and Q_z is evaluated after a fit."""
UNDETERMINED = 10.0
"""Standard deviations of the multiplier per its size from which a fit warns."""
LARGE_JITTER = 0.01
"""Jitter, relative to unit noise, from which a fit warns: the noise grows by half of it."""


def inference_of(posterior: ForcePosterior) -> dict[str, Any]:
    """Which inference a posterior has, and what a sparse one loses by its inducing points, by field of the
    result of a fit."""
    latent = posterior.latent
    if not isinstance(latent, SparsePosterior):
        return {"inference": "exact"}
    found = latent.diagnostics
    return {
        "inference": "sparse",
        "basis_functions": found.size,
        "determined": found.learned,
        "missed": found.missed,
        "more_points_would_help": found.more_points_would_help,
    }


def _doubts_on_inducing_points(posterior: ForcePosterior) -> tuple[str, ...]:
    """A warning where inducing points miss much of what the data could tell."""
    latent = posterior.latent
    if not isinstance(latent, SparsePosterior) or not latent.diagnostics.more_points_would_help:
        return ()
    found = latent.diagnostics
    return (
        f"more inducing points would help: {found.size} basis functions miss a variance of "
        f"{found.missed:.3g} in units of the noise, where noise leaves {found.learned:.3g}; raise "
        "inducing_points",
    )


def constant_inputs(priors: Sequence[ForcePrior], training: Training) -> tuple[str, ...]:
    """Inputs that do not vary in the training data, by prior."""
    pairs = zip(priors, training.scales, strict=True)
    return tuple(f"{prior.name}.{name}" for prior, scale in pairs for name in scale.constant)


def doubts(
    posterior: ForcePosterior, system: ConstrainedSystem, training: Training, jitter: float
) -> tuple[str, ...]:
    """Warnings about a fit, each with a remedy."""
    found = _doubts_on_multiplier(posterior, system, training) + _doubts_on_inducing_points(posterior)
    if jitter >= LARGE_JITTER:
        found += (
            f"the covariance was factorised with a jitter of {jitter:.2g} times the noise variance: "
            "drop duplicated rows, or state a larger noise",
        )
    return found


def _doubts_on_multiplier(
    posterior: ForcePosterior, system: ConstrainedSystem, training: Training
) -> tuple[str, ...]:
    """A warning where the multiplier is so uncertain that it is not determined by the data."""
    few = training.thinned(min(CORRELATION_STATES, training.samples)).measurements if training.samples else ()
    means, spreads = [], []
    for m in _in_contact(few):
        at = m.at(system)
        z = affine_map(system, at, "multiplier")
        rows = system.active_rows(m.active, m.active.shape[:-1])
        means.append(posterior.read_mean(system, at, z)[rows])
        spreads.append(
            posterior.read_covariance(system, at, z).diagonal(dim1=-2, dim2=-1).clamp(min=0.0)[rows]
        )
    if not means:
        return ()
    size, spread = (float(torch.cat(x).sqrt().median()) for x in ([m**2 for m in means], spreads))
    if spread <= UNDETERMINED * max(size, 1e-12):
        return ()
    return (
        f"the multiplier is not determined by these data: its standard deviation is {spread:.3g} N at a "
        f"median of {size:.3g} N; use the analytical mean, measure a force, or leave out priors that act "
        "along the normal",
    )


def mean_correlation(
    posterior: ForcePosterior, system: ConstrainedSystem, training: Training
) -> float | None:
    """Mean correlation of Q and Q_z over some of the training states, where both have priors."""
    targets = {prior.target for prior in posterior.priors}
    if not {JOINT, CONTACT} <= targets:
        return None
    few = training.thinned(min(CORRELATION_STATES, training.samples)).measurements
    parts = [force_correlation(posterior, system, m.at(system)) for m in _in_contact(few)]
    return float(torch.cat(parts).mean()) if parts else None


def _in_contact(measurements: Sequence[Measurement]) -> list[Measurement]:
    """The samples in which a contact is closed; elsewhere Q_z is zero."""
    closed = [m[m.active.any(-1).nonzero()[:, 0]] for m in measurements]
    return [m for m in closed if len(m.q)]
