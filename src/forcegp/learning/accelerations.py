"""The most probable accelerations of samples, given measured accelerations and torques.

Columns of the inertia contain accelerations. If they are measured with noise, least squares underestimates
inertia, and posterior variances are too small. With q̈ as an unknown of each sample, r(δ, q̈) is stationary in
q̈ at the measured acceleration minus its most probable noise,

    q̈ = q̈_m − Σ C⁻¹ (q̈_m − E q̈),   C = Σ + B S Bᵀ,

and a Gauss–Newton step for δ has its columns there (errors in variables; Fuller, *Measurement Error Models*,
1987, section 3.2). In directions that closed contacts determine, the measured acceleration is kept.
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
    """Return the training data with the most probable accelerations under the forces of a learned problem."""
    posterior, system, values = force_posterior(problem, values), problem.system, dict(values)
    slides, rests = variances(problem, values)
    likely: dict[int, list[Tensor]] = {i: [] for i, q in enumerate(training.quantities) if q == "qdd"}
    for piece in training.pieces(PIECE_SAMPLES):
        part = dataclasses.replace(problem, training=piece)
        for i, each in likely.items():
            m, std = piece.measurements[i], part.noise_at(values, i)
            at = m.at(system)
            r = (m.values - posterior.read_mean(system, at, affine_map(system, at, "qdd"))) / std
            each.append(m.values - std * residuals_of(part, values, i, r).noise(slides, rests))
    measurements = list(training.measurements)
    for i, each in likely.items():
        measurements[i] = dataclasses.replace(measurements[i], qdd=torch.cat(each))
    return dataclasses.replace(training, measurements=tuple(measurements))
