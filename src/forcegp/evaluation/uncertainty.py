"""Whether the predicted uncertainty is right: coverage, density, and the multiplier against a sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.models.base import Predictor
from forcegp.models.structured_gp import StructuredGP

LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Probabilities of the central intervals whose coverage is counted."""


@dataclass(frozen=True)
class Uncertainty:
    """Coverage and density of predicted accelerations.

    Attributes:
        coverage_noisy: share of measured accelerations within ±2σ, noise included.
        coverage_clean: share of noise-free ones within ±2σ of the prediction, `None` if not logged.
        coverage_by_joint: `coverage_noisy`, one per joint.
        calibration: share of measured accelerations in the central interval of each level of `LEVELS`.
        nlpd: mean negative log predictive density of one measured joint acceleration [nats].
    """

    coverage_noisy: float
    coverage_clean: float | None
    coverage_by_joint: tuple[float, ...]
    calibration: dict[str, float]
    nlpd: float

    @classmethod
    def of(
        cls, mean: Tensor, variance: Tensor, noise_std: Tensor, measured: Tensor, clean: Tensor | None
    ) -> Uncertainty:
        """From predictions and accelerations `(n, nq)` and the noise `(nq,)`."""
        deviation = (measured - mean).abs() / (variance + noise_std**2).sqrt()
        within = None if clean is None else _share((clean - mean).abs() <= 2.0 * variance.sqrt())
        return cls(
            coverage_noisy=_share(deviation <= 2.0),
            coverage_clean=within,
            coverage_by_joint=tuple((deviation <= 2.0).to(mean.dtype).mean(0).tolist()),
            calibration={f"{level:g}": _share(deviation <= half_width(level)) for level in LEVELS},
            nlpd=nlpd(measured - mean, (variance + noise_std**2).sqrt()),
        )


def nlpd(error: Tensor, std: Tensor) -> float:
    """Mean negative log density of errors under a centred normal distribution [nats]."""
    return float((0.5 * (error / std) ** 2 + std.log() + 0.5 * math.log(2.0 * math.pi)).mean())


def half_width(level: float) -> float:
    """Half width of the central interval of a standard normal variable with a given probability."""
    return math.sqrt(2.0) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))


def _share(inside: Tensor) -> float:
    return float(inside.to(torch.float64).mean())


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
    """Compare λ with what a sensor or simulator logged as `multiplier`, contact by contact.

    Args:
        model: a fitted model that predicts forces.
        data: with `multiplier` of some contacts of the model that have one row each.
        chunk: states predicted at a time.

    Returns:
        One score per contact with a logged multiplier and at least two samples in contact.
    """
    logged, names = data.contact_extras.get("multiplier", {}), model.system.contact_names
    if model.system.m != len(names) or not any(name in logged for name in names):
        return ()
    active, means, stds = data.active(names), [], []
    for i in range(0, len(data), chunk):
        part, closed = data[i : i + chunk], active[i : i + chunk]
        predicted = model.predict(part.q, part.qd, part.tau, "multiplier", active=closed)
        means.append(predicted.mean)
        variance = predicted.variance
        if variance is not None and isinstance(model, StructuredGP):
            states = part.q, part.qd, part.tau
            variance = variance + model.fitted.noise_variance(*states, "multiplier", closed)
        stds += [] if variance is None else [variance.clamp(min=0.0).sqrt()]
    mean, std = torch.cat(means), torch.cat(stds) if stds else None
    found = []
    for i, name in enumerate(names):
        rows = active[:, i]
        if name in logged and int(rows.sum()) >= 2:
            own = None if std is None else std[rows, i]
            found.append(_multiplier_score(name, mean[rows, i], own, logged[name][rows]))
    return tuple(found)


def _multiplier_score(contact: str, mean: Tensor, std: Tensor | None, logged: Tensor) -> MultiplierScore:
    error = mean - logged
    varies = float(mean.std()) > 0.0 and float(logged.std()) > 0.0
    return MultiplierScore(
        contact=contact,
        samples=len(error),
        bias=float(error.mean()),
        spread=float(error.std()),
        correlation=float(torch.corrcoef(torch.stack([mean, logged]))[0, 1]) if varies else None,
        coverage=None if std is None else _share(error.abs() <= 2.0 * std),
    )
