"""The most probable accelerations of samples, given measured accelerations and torques.

Columns of the inertia contain accelerations. If they are measured with noise, least squares underestimates
inertia, and posterior variances are too small. With q̈ as an unknown of each sample, r(δ, q̈) is stationary in
q̈ at the measured acceleration minus its most probable noise,

    q̈ = q̈_m − Σ C⁻¹ (q̈_m − E q̈),   C = Σ + B S Bᵀ,

and a Gauss–Newton step for δ has its columns there (errors in variables; Fuller, *Measurement Error Models*,
1987, section 3.2). In directions that closed contacts determine, the measured acceleration is kept. Only the
estimate of δ uses these columns; the posterior has the measured accelerations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.forces.measurements import Training
from forcegp.forces.problem import PIECE_SAMPLES, Problem, force_posterior
from forcegp.forces.quantities import affine_map
from forcegp.learning.scales import residuals_of, variances


@torch.no_grad()
def with_likely_accelerations(problem: Problem, values: Mapping[str, Tensor], training: Training) -> Training:
    """Return training data with the most probable accelerations under the forces of a learned problem.

    Args:
        problem: the problem, whose robot includes what was learned of links and drives.
        values: its hyperparameters.
        training: the measurements.
    """
    posterior, system, values = force_posterior(problem, values), problem.system, dict(values)
    noise, measurements = variances(problem, values), list(training.measurements)
    for i in [i for i, quantity in enumerate(training.quantities) if quantity == "qdd"]:
        likely = []
        for piece in training.pieces(PIECE_SAMPLES):
            part, m = dataclasses.replace(problem, training=piece), piece.measurements[i]
            at, std = m.at(system), part.noise_at(values, i)
            mean = posterior.read_mean(system, at, affine_map(system, at, "qdd"))
            rows = residuals_of(part, values, i, (m.values - mean) / std)
            likely.append(m.values - std * rows.noise(*noise))
        measurements[i] = dataclasses.replace(measurements[i], qdd=torch.cat(likely))
    return dataclasses.replace(training, measurements=tuple(measurements))
