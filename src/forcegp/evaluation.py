"""How good the predicted accelerations of a model are: errors, coverage, density, constraint residual."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.models.base import Model
from forcegp.models.structured_gp import StructuredGP

CHUNK_STATES = 2000
"""States predicted at a time, which bounds the memory."""
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Probabilities of the central intervals whose coverage is counted."""


@dataclass(frozen=True)
class Errors:
    """Differences between predicted means and accelerations [rad/s², m/s²].

    Attributes:
        mae: mean absolute error over samples and joints.
        rmse: root mean square error over samples and joints.
        mae_by_joint, rmse_by_joint: the same, one a joint.
    """

    mae: float
    rmse: float
    mae_by_joint: tuple[float, ...]
    rmse_by_joint: tuple[float, ...]

    @classmethod
    def of(cls, error: Tensor) -> Errors:
        """From differences `(n, nq)`."""
        return cls(
            mae=float(error.abs().mean()),
            rmse=float((error**2).mean().sqrt()),
            mae_by_joint=tuple(error.abs().mean(0).tolist()),
            rmse_by_joint=tuple((error**2).mean(0).sqrt().tolist()),
        )


@dataclass(frozen=True)
class Evaluation:
    """The predictions of a model held against a data set.

    Attributes:
        kind: of the model.
        samples: how many were predicted.
        joint_names: the joints, in the order of what is given by joint.
        noisy: errors against the measured accelerations.
        clean: errors against the noise-free ones, `None` where they are not logged.
        coverage_noisy: share of measured accelerations within ±2 standard deviations, noise included.
        coverage_clean: share of noise-free ones within ±2 standard deviations of the prediction.
        calibration: share of measured accelerations in the central interval of each level of `LEVELS`.
        nlpd: mean negative log predictive density of one measured joint acceleration [nats].
        residual, residual_max: mean and largest |A q̈ − b| of the predicted mean over closed contacts [m/s²].
        noise_std: taken for the measured accelerations, one a joint.
        seconds_per_state: time to predict, with the covariance where there is one.

    What needs a covariance, a contact or noise-free accelerations is `None` where there is none.
    """

    kind: str
    samples: int
    joint_names: tuple[str, ...]
    noisy: Errors
    clean: Errors | None
    coverage_noisy: float | None
    coverage_clean: float | None
    calibration: dict[str, float] | None
    nlpd: float | None
    residual: float | None
    residual_max: float | None
    noise_std: tuple[float, ...] | None
    seconds_per_state: float

    @property
    def noisy_mae(self) -> float:
        """Mean absolute error against measured accelerations, the paper's figure."""
        return self.noisy.mae

    @property
    def clean_mae(self) -> float | None:
        """Mean absolute error against noise-free accelerations."""
        return None if self.clean is None else self.clean.mae

    def to_dict(self) -> dict[str, Any]:
        """Everything, as what JSON can hold."""
        return asdict(self)

    def summary(self) -> dict[str, float | int | str | None]:
        """The figures over all joints, by name."""
        return {
            "kind": self.kind,
            "samples": self.samples,
            "noisy_mae": self.noisy.mae,
            "noisy_rmse": self.noisy.rmse,
            "clean_mae": self.clean_mae,
            "clean_rmse": None if self.clean is None else self.clean.rmse,
            "coverage_noisy": self.coverage_noisy,
            "coverage_clean": self.coverage_clean,
            "nlpd": self.nlpd,
            "residual": self.residual,
            "residual_max": self.residual_max,
            "seconds_per_state": self.seconds_per_state,
        }


def evaluate(
    model: Model,
    data: Dataset,
    *,
    system: ConstrainedSystem | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Predict the accelerations of a data set and compare.

    Args:
        model: a model that can predict.
        data: states and measured accelerations, and noise-free ones as `qdd_clean` where known.
        system: the constraint that predictions are held against; the model's by default.
        progress: called with the number of states predicted and their number in all.

    Raises:
        DataError: the data are empty, or their joints are not the robot's.
        ModelError: the model has not been fitted.
        UnknownNameError: a contact is not in the data.
    """
    if len(data) == 0:
        raise DataError("there is nothing to evaluate on", expected="at least one sample", got="none")
    data.check_robot(model.system.robot)
    system = system or model.system
    predicted = _predict(model, data, system, progress)
    clean = data.extras.get("qdd_clean")
    noise_std = _noise_std(model, data)
    spread: dict[str, Any] = dict.fromkeys(("coverage_noisy", "coverage_clean", "calibration", "nlpd"))
    if predicted.variance is not None and noise_std is not None:
        spread = _spread(predicted.mean, predicted.variance, noise_std, data.qdd, clean)
    residual = predicted.residual
    return Evaluation(
        kind=model.kind,
        samples=len(data),
        joint_names=data.joint_names,
        noisy=Errors.of(predicted.mean - data.qdd),
        clean=None if clean is None else Errors.of(predicted.mean - clean),
        **spread,
        residual=float(residual.mean()) if len(residual) else None,
        residual_max=float(residual.max()) if len(residual) else None,
        noise_std=None if noise_std is None else tuple(noise_std.tolist()),
        seconds_per_state=predicted.seconds / len(data),
    )


@dataclass(frozen=True)
class _Predicted:
    """Means and variances `(n, nq)`, |A q̈ − b| of all closed rows `(k,)`, and the time prediction took."""

    mean: Tensor
    variance: Tensor | None
    residual: Tensor
    seconds: float


def _predict(
    model: Model, data: Dataset, system: ConstrainedSystem, progress: Callable[[int, int], None] | None
) -> _Predicted:
    """Predict a data set chunk by chunk."""
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
    return _Predicted(torch.cat(means), variance, torch.cat(residuals), seconds)


@torch.no_grad()
def _residual(system: ConstrainedSystem, data: Dataset, rows: slice, qdd: Tensor) -> Tensor:
    """|A q̈ − b| of the rows of closed contacts, `(k,)`."""
    active = data.active(system.contact_names)[rows]
    eom = system.equations(data.q[rows], data.qd[rows], active)
    residual = ((eom.A @ qdd[..., None])[..., 0] - eom.b).abs()
    return residual[system.active_rows(active, qdd.shape[:-1])]


def _noise_std(model: Model, data: Dataset) -> Tensor | None:
    """The noise that the model takes for measured accelerations, or the data's, `(nq,)`."""
    if isinstance(model, StructuredGP):
        return model.fitted.problem.noise_at(model.hyperparameters, 0)
    noise = getattr(model, "noise_std", None)
    noise = data.header.noise_std if noise is None else noise
    return None if noise is None else torch.as_tensor(noise, dtype=data.dtype).expand(data.nq).to(data.device)


def _spread(
    mean: Tensor, variance: Tensor, noise_std: Tensor, measured: Tensor, clean: Tensor | None
) -> dict[str, Any]:
    """What says whether the predicted uncertainty is right."""
    total = variance + noise_std**2
    deviation = (measured - mean) / total.sqrt()
    inside = {
        f"{level:g}": float((deviation.abs() <= _quantile(level)).to(mean.dtype).mean()) for level in LEVELS
    }
    within = None
    if clean is not None:
        within = float(((clean - mean).abs() <= 2.0 * variance.sqrt()).to(mean.dtype).mean())
    return {
        "coverage_noisy": float((deviation.abs() <= 2.0).to(mean.dtype).mean()),
        "coverage_clean": within,
        "calibration": inside,
        "nlpd": float((0.5 * deviation**2 + 0.5 * (2.0 * math.pi * total).log()).mean()),
    }


def _quantile(level: float) -> float:
    """Half width of the central interval of a standard normal variable that holds a given probability."""
    return math.sqrt(2.0) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
