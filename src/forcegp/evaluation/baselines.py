"""Predictors that any model should beat: the mean, the robot file alone, and least squares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.evaluation.least_squares import CHUNK_STATES, LeastSquares, identify_rigid

FEWEST = 20
"""Minimum number of samples to fit a baseline to."""


@dataclass(frozen=True)
class Baseline:
    """A trivial predictor of accelerations.

    Attributes:
        name: what it is called.
        system: robot and contacts by whose mass matrix its errors become torques.
        predict: accelerations `(n, nq)` of a data set.
        std: `(nq,)` root-mean-square error on its training data, its constant uncertainty.
    """

    name: str
    system: ConstrainedSystem
    predict: Callable[[Dataset], Tensor]
    std: Tensor


def baselines(system: ConstrainedSystem, train: Dataset) -> list[Baseline]:
    """The trivial predictors, fitted to training data.

    Args:
        system: robot and contacts as known before any learning.
        train: at least `FEWEST` samples.

    Returns:
        The mean, the robot file alone, and least squares.
    """
    mean, nothing = train.qdd.mean(0), train.qdd.new_zeros(3 * train.nq)
    file, identified = LeastSquares(system, nothing), identify_rigid(system, train)
    predictors: dict[str, tuple[ConstrainedSystem, Callable[[Dataset], Tensor]]] = {
        "mean": (system, lambda data: mean.expand_as(data.qdd)),
        "robot file": (system, file.predict),
        "least squares": (identified.system, identified.predict),
    }
    return [
        Baseline(name, own, predict, ((predict(train) - train.qdd) ** 2).mean(0).sqrt())
        for name, (own, predict) in predictors.items()
    ]


def as_torque(system: ConstrainedSystem, q: Tensor, error: Tensor) -> Tensor:
    """Errors of acceleration as torques M(q)(predicted − measured q̈), `(n, nq)` [N m, N]."""
    pairs = zip(q.split(CHUNK_STATES), error.split(CHUNK_STATES), strict=True)
    with torch.no_grad():
        parts = [dynamics.mass_matrix(system.robot, at) @ e[..., None] for at, e in pairs]
    return torch.cat(parts)[..., 0]
