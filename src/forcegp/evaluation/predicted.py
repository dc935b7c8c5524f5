"""Predictions at all samples of a data set, in chunks that bound the memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.models.base import Predictor
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
