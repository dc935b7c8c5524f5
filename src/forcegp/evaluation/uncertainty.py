"""Whether the predicted uncertainty is right: coverage and density."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

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
        within = None if clean is None else share((clean - mean).abs() <= 2.0 * variance.sqrt())
        return cls(
            coverage_noisy=share(deviation <= 2.0),
            coverage_clean=within,
            coverage_by_joint=tuple((deviation <= 2.0).to(mean.dtype).mean(0).tolist()),
            calibration={f"{level:g}": share(deviation <= half_width(level)) for level in LEVELS},
            nlpd=nlpd(measured - mean, (variance + noise_std**2).sqrt()),
        )


def nlpd(error: Tensor, std: Tensor) -> float:
    """Mean negative log density of errors under a centred normal distribution [nats]."""
    return float((0.5 * (error / std) ** 2 + std.log() + 0.5 * math.log(2.0 * math.pi)).mean())


def half_width(level: float) -> float:
    """Half width of the central interval of a standard normal variable with a given probability."""
    return math.sqrt(2.0) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))


def share(inside: Tensor) -> float:
    """Share of what is true."""
    return float(inside.to(torch.float64).mean())
