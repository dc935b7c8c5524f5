"""Minimisation of a differentiable objective over named tensors with L-BFGS or, as in the paper, ADAM."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import scipy
import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError, check_name

Objective = Callable[[dict[str, Tensor]], Tensor]
Progress = Callable[[int, float, dict[str, Tensor]], None]
"""Function called after each evaluation with the evaluation count, the objective and the best tensors."""
FitProgress = Callable[[int, int, float], None]
"""Function called with the evaluation count, the maximum number of evaluations, and the objective."""
Bounds = Mapping[str, tuple[float | Tensor, float | Tensor]]
"""Lower and upper bounds on each tensor, either common to all its entries or separate for each entry."""

FIRST_STEP = 2.0
"""Largest change in an entry in the first step of bounded L-BFGS; for logarithms, this is two e-folds."""
STOPPED = ("converged", "stopped at the iteration limit", "the line search found no smaller objective")


@dataclass(frozen=True)
class LearningOptions:
    """Options for learning.

    Args:
        optimizer: `"lbfgs"` or `"adam"`.
        max_evaluations: maximum number of evaluations of the objective.
        tolerance: relative change in the objective below which L-BFGS stops. ADAM stops if the objective does
            not improve by this much within `patience` evaluations.
        learning_rate: learning rate of ADAM for the hyperparameters θ_M.
        analytical_learning_rate: learning rate of ADAM for the analytical parameters θ_A.
        patience: number of evaluations without improvement after which ADAM stops.
        warm_start: number of samples to learn from first, if there are more than twice as many samples. The
            number is then doubled until all are used. If `None`, all samples are used from the start.
        restarts: number of additional random starts; the best result is kept.
        seed: seed for the random starts.
        hyperpriors: whether hyperparameters have weak log-normal priors around their initial values (maximum
            a posteriori estimation). Otherwise, learning maximises the likelihood, as in the paper.

    Example:
        >>> LearningOptions(max_evaluations=50).optimizer
        'lbfgs'
    """

    optimizer: Literal["lbfgs", "adam"] = "lbfgs"
    max_evaluations: int = 300
    tolerance: float = 1e-5
    learning_rate: float = 0.2
    analytical_learning_rate: float = 0.2
    patience: int = 50
    warm_start: int | None = 200
    restarts: int = 0
    seed: int = 0
    hyperpriors: bool = True

    def __post_init__(self) -> None:
        check_name("optimizer", self.optimizer, ("lbfgs", "adam"))
        if self.max_evaluations < 1:
            raise ModelError(
                "learning needs at least one evaluation",
                expected="max_evaluations ≥ 1",
                got=self.max_evaluations,
            )


@dataclass(frozen=True)
class Learned:
    """The result of learning.

    Attributes:
        tensors: the best tensors found.
        value: objective at these tensors.
        converged: whether the tolerance was reached within the allowed number of evaluations.
        evaluations: number of evaluations.
        seconds: duration of learning [s].
        message: reason for stopping.
        history: objective at each evaluation.
        doubts: warnings about the result, each with a suggested remedy.
    """

    tensors: dict[str, Tensor]
    value: float
    converged: bool
    evaluations: int
    seconds: float
    message: str
    history: list[float] = field(default_factory=list)
    doubts: tuple[str, ...] = ()

    @property
    def outcome(self) -> dict[str, Any]:
        """The result of learning as fields of `FitResult`."""
        return {
            "converged": self.converged,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
            "objective": self.value,
            "message": self.message,
            "history": tuple(self.history),
        }


def reported(progress: FitProgress | None, most: int, before: int = 0) -> Progress | None:
    """Adapt a progress function to an optimisation that starts after `before` earlier evaluations."""
    if progress is None:
        return None
    return lambda evaluations, value, _: progress(before + evaluations, most, value)


class _SpentError(Exception):
    """Raised when the allowed number of evaluations is exhausted."""


class _Recorder:
    """Evaluates the objective and its gradient, and keeps the best point."""

    def __init__(self, objective: Objective, start: Mapping[str, Tensor], progress: Progress | None) -> None:
        self.objective, self.progress = objective, progress
        self.best = {key: value.detach().clone() for key, value in start.items()}
        self.value, self.history = float("inf"), []

    def __call__(self, tensors: dict[str, Tensor]) -> tuple[float, dict[str, Tensor]]:
        leaves = {key: value.detach().clone().requires_grad_() for key, value in tensors.items()}
        objective = self.objective(leaves)
        inputs = list(leaves.values())
        grads = torch.autograd.grad(objective, inputs, allow_unused=True, materialize_grads=True)
        value = float(objective.detach())
        self.history.append(value)
        if value < self.value:
            self.value, self.best = value, {key: leaf.detach() for key, leaf in leaves.items()}
        if self.progress is not None:
            self.progress(len(self.history), value, self.best)
        return value, dict(zip(leaves, grads, strict=True))


def minimise(
    objective: Objective,
    start: Mapping[str, Tensor],
    options: LearningOptions,
    analytical: frozenset[str] = frozenset(),
    bounds: Bounds | None = None,
    progress: Progress | None = None,
    first_step: float = FIRST_STEP,
) -> Learned:
    """Minimise an objective over tensors.

    Args:
        objective: differentiable function that maps the tensors to a scalar.
        analytical: names of the analytical parameters θ_A, for which ADAM has a separate learning rate.
        bounds: bounds on each tensor, used by L-BFGS.
        first_step: largest change in an entry in the first step of L-BFGS with bounds.

    Raises:
        NumericalError: the objective is not finite at the initial values.
    """
    began = time.perf_counter()
    recorder = _Recorder(objective, start, progress)
    if options.optimizer == "lbfgs":
        converged, message = _lbfgs(recorder, start, options, bounds or {}, first_step)
    else:
        converged, message = _adam(recorder, start, options, analytical, bounds or {})
    if not np.isfinite(recorder.value):
        raise NumericalError("the objective is not finite at the start", got=recorder.history[:1])
    seconds, history = time.perf_counter() - began, recorder.history
    return Learned(recorder.best, recorder.value, converged, len(history), seconds, message, history)


def _lbfgs(
    recorder: _Recorder,
    start: Mapping[str, Tensor],
    options: LearningOptions,
    bounds: Bounds,
    first_step: float,
) -> tuple[bool, str]:
    def function(x: np.ndarray) -> tuple[float, np.ndarray]:
        # SciPy counts only between iterations, so a line search could exceed the limit.
        if len(recorder.history) >= options.max_evaluations:
            raise _SpentError
        value, grads = recorder(_unflattened(x, start))
        return value, _flattened(grads[key] for key in start)

    x = _flattened(start.values())
    low, high = (_flat_bounds(start, bounds, side) for side in (0, 1))
    x = np.clip(x, low, high)
    first = function(x)
    steepest = np.abs(first[1]).max(initial=0.0)
    if not np.isfinite(first[0]) or not np.isfinite(steepest):
        return False, "not finite at the start"
    # With bounds, L-BFGS-B's first step is the whole gradient, which ends at the bounds if it is steep. In
    # units of √(first step ÷ gradient), the gradient equals the first step.
    unit = min(1.0, math.sqrt(first_step / max(steepest, 1e-300)))

    def scaled(u: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = function(np.clip(x + unit * u, low, high)) if u.any() else first
        return value, unit * gradient

    limits = {"maxfun": options.max_evaluations, "maxiter": options.max_evaluations}
    tolerances = {"ftol": options.tolerance, "gtol": 1e-5 * unit, "maxcor": 30}
    try:
        result = scipy.optimize.minimize(
            scaled,
            np.zeros_like(x),
            jac=True,
            method="L-BFGS-B",
            bounds=scipy.optimize.Bounds((low - x) / unit, (high - x) / unit),  # pyright: ignore[reportArgumentType]
            options=limits | tolerances,
        )
    except _SpentError:
        return False, f"stopped after {options.max_evaluations} evaluations"
    return bool(result.success), STOPPED[min(result.status, 2)]


def _flattened(tensors: Iterable[Tensor]) -> np.ndarray:
    """Concatenate all entries of the tensors into one vector."""
    return torch.cat([x.detach().reshape(-1) for x in tensors]).cpu().double().numpy()


def _unflattened(x: np.ndarray, like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Split a vector into tensors with the same names, shapes and types as `like`."""
    first, tensors = next(iter(like.values())), {}
    flat = torch.as_tensor(x, dtype=first.dtype, device=first.device)
    for key, value in like.items():
        tensors[key], flat = flat[: value.numel()].reshape(value.shape), flat[value.numel() :]
    return tensors


def _flat_bounds(start: Mapping[str, Tensor], bounds: Bounds, side: int) -> np.ndarray:
    """Return the lower or upper bounds of all entries."""
    free = (-math.inf, math.inf)
    return _flattened(torch.zeros_like(value) + bounds.get(key, free)[side] for key, value in start.items())


def _adam(
    recorder: _Recorder,
    start: Mapping[str, Tensor],
    options: LearningOptions,
    analytical: frozenset[str],
    bounds: Bounds,
) -> tuple[bool, str]:
    tensors = {key: value.detach().clone() for key, value in start.items()}
    rates = {False: options.learning_rate, True: options.analytical_learning_rate}
    optimizer = torch.optim.Adam(
        {"params": [x for key, x in tensors.items() if (key in analytical) == is_analytical], "lr": rate}
        for is_analytical, rate in rates.items()
    )
    since = 0
    for _ in range(options.max_evaluations):
        best = recorder.value
        value, grads = recorder(tensors)
        since = 0 if value < best - options.tolerance * abs(best) or not np.isfinite(best) else since + 1
        if since >= options.patience:
            return True, f"no improvement within {options.patience} evaluations"
        for key, tensor in tensors.items():
            tensor.grad = grads[key]
        optimizer.step()
    return False, f"stopped after {options.max_evaluations} evaluations"
