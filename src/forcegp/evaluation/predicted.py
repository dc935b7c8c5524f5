"""Predictions at all samples of a data set, in chunks that bound the memory.

The predicted multiplier is compared with a logged one, without and with the log's force sensor as a
measurement.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.evaluation.scores import share
from forcegp.models.base import Predictor
from forcegp.models.sensed import force_from_sensor, has_sensor
from forcegp.models.structured_fit import StructuredFit

CHUNK_STATES = 2000
"""States predicted at a time."""
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Predicted:
    """The predictions of a model at all samples of a data set.

    Attributes:
        mean, variance: `(n, nq)`; no variance for a model without a covariance.
        noise_std: `(n, nq)` assumed for measured accelerations, if known; noise of the torque included.
        residual: `(k,)` |A q̈ − b| of all rows of closed contacts.
        seconds: time taken.
    """

    mean: Tensor
    variance: Tensor | None
    noise_std: Tensor | None
    residual: Tensor
    seconds: float


def predict_all(
    model: Predictor, data: Dataset, system: ConstrainedSystem, progress: Progress | None
) -> Predicted:
    """Predict a data set chunk by chunk.

    Args:
        model: a fitted model.
        data: the states.
        system: the constraint that predictions are held against.
        progress: called with the number of states predicted and their total number.
    """
    active = data.active(model.system.contact_names)
    means, variances, residuals, seconds = [], [], [], 0.0
    for first in range(0, len(data), CHUNK_STATES):
        rows = slice(first, first + CHUNK_STATES)
        began = time.perf_counter()
        part = model.predict(data.q[rows], data.qd[rows], data.tau[rows], active=active[rows])
        seconds += time.perf_counter() - began
        means.append(part.mean)
        variances += [] if part.variance is None else [part.variance]
        residuals.append(_residual(system, data, rows, part.mean))
        if progress is not None:
            progress(min(first + CHUNK_STATES, len(data)), len(data))
    variance = torch.cat(variances) if variances else None
    return Predicted(torch.cat(means), variance, _noise_std(model, data), torch.cat(residuals), seconds)


@torch.no_grad()
def _residual(system: ConstrainedSystem, data: Dataset, rows: slice, qdd: Tensor) -> Tensor:
    """|A q̈ − b| of the rows of closed contacts, `(k,)`."""
    active = data.active(system.contact_names)[rows]
    eom = system.equations(data.q[rows], data.qd[rows], active)
    residual = ((eom.A @ qdd[..., None])[..., 0] - eom.b).abs()
    return residual[system.active_rows(active, qdd.shape[:-1])]


def _noise_std(model: Predictor, data: Dataset) -> Tensor | None:
    """The noise that the model assumes for measured accelerations, or the data's, `(n, nq)`."""
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
    """The predicted multiplier λ of one contact against a logged one, over samples in contact.

    Attributes:
        contact: name.
        samples: in contact.
        bias, spread: mean and standard deviation of predicted less logged λ [N].
        correlation: of predicted and logged λ, `None` if either is constant.
        coverage: share of logged values within ±2σ, noise of the torque included; `None` without a
            covariance.
    """

    contact: str
    samples: int
    bias: float
    spread: float
    correlation: float | None
    coverage: float | None


@torch.no_grad()
def multiplier_scores(model: Predictor, data: Dataset, chunk: int) -> tuple[MultiplierScore, ...]:
    """Compare λ with what a simulator or another sensor logged as `multiplier`, contact by contact.

    Args:
        model: a fitted model that predicts forces.
        data: with `multiplier` of some contacts of the model that have one row each.
        chunk: states predicted at a time.

    Returns:
        One score per contact with a logged multiplier and at least two samples in contact.
    """
    names = model.system.contact_names
    if not _comparable(model, data):
        return ()
    active, means, stds = data.active(names), [], []
    for i in range(0, len(data), chunk):
        part, closed = data[i : i + chunk], active[i : i + chunk]
        states = part.q, part.qd, part.tau
        predicted = model.predict(*states, "multiplier", active=closed)
        means.append(predicted.mean)
        variance = predicted.variance
        if variance is not None and isinstance(model, StructuredFit):
            variance = variance + model.noise_variance(*states, "multiplier", closed, sensor=False)
        stds += [] if variance is None else [variance.clamp(min=0.0).sqrt()]
    return _scores(data, names, torch.cat(means), torch.cat(stds) if stds else None)


@torch.no_grad()
def sensed_scores(model: Predictor, data: Dataset, chunk: int) -> tuple[MultiplierScore, ...]:
    """The same where the log's force sensor is a measurement at the predicted states too.

    Args:
        model, data, chunk: see `multiplier_scores`.

    Returns:
        Nothing for a model that was not fitted to a sensor, or a log without one.
    """
    if not isinstance(model, StructuredFit) or "multiplier" not in model.noise:
        return ()
    if not _comparable(model, data) or not has_sensor(data, model.system):
        return ()
    parts = [force_from_sensor(model, data[i : i + chunk]) for i in range(0, len(data), chunk)]
    mean, std = (torch.cat(part) for part in zip(*parts, strict=True))
    return _scores(data, model.system.contact_names, mean[:, None], std[:, None])


def _comparable(model: Predictor, data: Dataset) -> bool:
    """Whether λ has one row per contact and was logged for one of them."""
    logged, names = data.contact_extras.get("multiplier", {}), model.system.contact_names
    return model.system.m == len(names) and any(name in logged for name in names)


def _scores(
    data: Dataset, names: tuple[str, ...], mean: Tensor, std: Tensor | None
) -> tuple[MultiplierScore, ...]:
    """Scores of λ `(n, contacts)` over the samples in which each contact is closed."""
    logged, active = data.contact_extras["multiplier"], data.active(names)
    return tuple(
        _score(name, mean[rows, i], None if std is None else std[rows, i], logged[name][rows])
        for i, (name, rows) in enumerate(zip(names, active.T, strict=True))
        if name in logged and int(rows.sum()) >= 2
    )


def _score(contact: str, mean: Tensor, std: Tensor | None, logged: Tensor) -> MultiplierScore:
    error = mean - logged
    varies = float(mean.std()) > 0.0 and float(logged.std()) > 0.0
    return MultiplierScore(
        contact=contact,
        samples=len(error),
        bias=float(error.mean()),
        spread=float(error.std()),
        correlation=float(torch.corrcoef(torch.stack([mean, logged]))[0, 1]) if varies else None,
        coverage=None if std is None else share(error.abs() <= 2.0 * std),
    )
