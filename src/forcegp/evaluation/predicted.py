"""Predictions at all samples of a data set, in chunks to limit memory use, and scores of the multiplier."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.unilateral import normal_rows
from forcegp.data import Dataset
from forcegp.evaluation.scores import share
from forcegp.models.base import Predictor
from forcegp.models.sensed import force_from_sensor, has_sensor, sensed_force
from forcegp.models.structured_fit import StructuredFit

CHUNK_STATES = 2000
"""Number of states predicted at a time."""
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Predicted:
    """Acceleration predictions of a model at all samples of a data set.

    Attributes:
        mean, variance: mean and variance, `(n, nq)`. The variance is `None` if the model has no covariance.
        noise_std: assumed noise in measured accelerations, including torque noise, `(n, nq)`, or `None`.
        residual: |A q̈ − b| for all constraint rows of closed contacts, `(k,)`.
        seconds: computation time.
    """

    mean: Tensor
    variance: Tensor | None
    noise_std: Tensor | None
    residual: Tensor
    seconds: float


Moments = tuple[Tensor, Tensor | None]
"""Mean, and variance or standard deviation if available."""


def in_chunks(
    predict: Callable[[Dataset], Moments], data: Dataset, progress: Progress | None = None
) -> Moments:
    """Call `predict` on all samples, `CHUNK_STATES` at a time, and concatenate the results."""
    parts = []
    for first in range(0, len(data), CHUNK_STATES):
        parts.append(predict(data[first : first + CHUNK_STATES]))
        if progress is not None:
            progress(min(first + CHUNK_STATES, len(data)), len(data))
    means, spreads = zip(*parts, strict=True)
    return torch.cat(means), None if spreads[0] is None else torch.cat(spreads)


def predict_all(
    model: Predictor, data: Dataset, system: ConstrainedSystem, progress: Progress | None
) -> Predicted:
    """Predict the accelerations for a data set, and their residuals in the constraints of a system."""
    residuals, seconds = [], []

    def predict(part: Dataset) -> Moments:
        active, began = part.active(model.system.contact_names), time.perf_counter()
        predicted = model.predict(part.q, part.qd, part.tau, active=active)
        seconds.append(time.perf_counter() - began)
        # |A q̈ − b| in the rows of closed contacts
        closed, qdd = part.active(system.contact_names), predicted.mean
        eom = system.equations(part.q, part.qd, closed)
        residual = ((eom.A @ qdd[..., None])[..., 0] - eom.b).abs()
        residuals.append(residual[system.active_rows(closed, qdd.shape[:-1])].detach())
        return predicted.mean, predicted.variance

    mean, variance = in_chunks(predict, data, progress)
    return Predicted(mean, variance, _noise_std(model, data), torch.cat(residuals), sum(seconds))


def _noise_std(model: Predictor, data: Dataset) -> Tensor | None:
    """Return the acceleration noise `(n, nq)` that the model assumes, or that the data state."""
    if isinstance(model, StructuredFit):
        active = data.active(model.system.contact_names)
        return model.noise_variance(data.q, data.qd, data.tau, active=active).sqrt()
    noise = getattr(model, "noise_std", None)
    noise = data.header.noise_std if noise is None else noise
    if noise is None:
        return None
    return torch.as_tensor(noise, dtype=data.dtype, device=data.device).expand(len(data), data.nq)


@dataclass(frozen=True)
class MultiplierScore:
    """Comparison of the predicted and logged multiplier λ of one contact over samples in contact.

    Attributes:
        contact: name of the contact.
        samples: number of samples in contact.
        bias, spread, level: mean and standard deviation of predicted minus logged λ, and mean logged λ [N].
        correlation: correlation between predicted and logged λ, or `None` if either is constant.
        coverage: fraction of logged values within ±2σ, where σ includes torque noise, or `None` if unknown.
    """

    contact: str
    samples: int
    bias: float
    spread: float
    correlation: float | None
    coverage: float | None
    level: float

    def text(self) -> str:
        """Describe the comparison in words."""
        held = "" if self.coverage is None else f", ±2σ coverage {100.0 * self.coverage:.0f} %"
        error = math.hypot(self.bias, self.spread)
        return f"the force at {self.contact!r} is off by {error:.2g} N (mean force {self.level:.3g} N){held}"


@torch.no_grad()
def multiplier_scores(model: Predictor, data: Dataset) -> tuple[MultiplierScore, ...]:
    """Compare λ with values from a simulator or sensor for each contact with at least two samples."""
    if not logged_forces(model, data):
        return ()
    return _scores(model, data, *in_chunks(lambda part: predicted_forces(model, part), data))


@torch.no_grad()
def predicted_forces(model: Predictor, data: Dataset) -> Moments:
    """Return the normal force at each contact `(n, contacts)`, and its σ including torque noise."""
    states, active = (data.q, data.qd, data.tau), data.active(model.system.contact_names)
    predicted = model.predict(*states, "multiplier", active=active)
    mean, variance = predicted.mean, predicted.variance
    if variance is not None and isinstance(model, StructuredFit):
        variance = variance + model.noise_variance(*states, "multiplier", active, sensor=False)
    mean = normal_rows(model.system, mean)
    return mean, None if variance is None else normal_rows(model.system, variance).clamp(min=0.0).sqrt()


def logged_forces(model: Predictor, data: Dataset) -> dict[str, Tensor]:
    """Return the logged normal forces `(n,)` at contacts closed in training, or else the sensor force."""
    never = model.result.never_closed if isinstance(model, StructuredFit) else ()
    names = [name for name in model.system.contact_names if name not in never]
    logged = data.contact_extras.get("multiplier", {})
    forces = {name: logged[name] for name in names if name in logged}
    if not forces and len(names) == 1 and has_sensor(data, model.system):
        return {names[0]: sensed_force(data, model.system)}
    return forces


@torch.no_grad()
def sensed_scores(model: Predictor, data: Dataset) -> tuple[MultiplierScore, ...]:
    """Return the scores of predictions that use the logged force sensor, if any, at each state."""
    if not isinstance(model, StructuredFit) or "multiplier" not in model.noise:
        return ()
    if not has_sensor(data, model.system) or "multiplier" not in data.contact_extras:
        return ()

    def predict(part: Dataset) -> Moments:
        mean, std = force_from_sensor(model, part)
        return mean[:, None], std[:, None]

    return _scores(model, data, *in_chunks(predict, data))


def _scores(model: Predictor, data: Dataset, mean: Tensor, std: Tensor | None) -> tuple[MultiplierScore, ...]:
    """Return the scores of λ `(n, contacts)` over the samples at which each contact is closed."""
    names = model.system.contact_names
    scores, logged, active = [], logged_forces(model, data), data.active(names)
    for i, (name, rows) in enumerate(zip(names, active.T, strict=True)):
        if name not in logged or int(rows.sum()) < 2 or bool(mean[rows, i].isnan().any()):
            continue
        both = torch.stack([mean[rows, i], logged[name][rows]])
        error, varies = both[0] - both[1], bool((both.std(1) > 0.0).all())
        correlation = float(torch.corrcoef(both)[0, 1]) if varies else None
        coverage = None if std is None else share(error.abs() <= 2.0 * std[rows, i])
        bias, spread = float(error.mean()), float(error.std())
        level = float(logged[name][rows].mean())
        scores.append(MultiplierScore(name, len(error), bias, spread, correlation, coverage, level))
    return tuple(scores)
