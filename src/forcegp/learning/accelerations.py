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
from forcegp.forces.problem import Problem, force_posterior
from forcegp.forces.quantities import affine_map
from forcegp.learning.scales import residuals_of, variances


@torch.no_grad()
def with_likely_accelerations(problem: Problem, values: Mapping[str, Tensor], training: Training) -> Training:
    """Return the training data with the most probable accelerations under the forces of a learned problem."""
    posterior, system, measurements = force_posterior(problem, values), problem.system, []
    whole = dataclasses.replace(problem, training=training)
    slides, rests = variances(problem, dict(values))
    for i, m in enumerate(training.measurements):
        if m.quantity == "qdd":
            at = m.at(system)
            mean = posterior.read_mean(system, at, affine_map(system, at, "qdd"))
            std = whole.noise_at(dict(values), i).expand_as(m.values)
            rows = residuals_of(whole, values, i, (m.values - mean) / std)
            m = dataclasses.replace(m, qdd=m.values - std * rows.noise(slides, rests))
        measurements.append(m)
    return dataclasses.replace(training, measurements=tuple(measurements))
