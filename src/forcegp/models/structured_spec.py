"""What a structured Gaussian process is made of, and its form in saved files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.learn import Problem, analytical_parameters
from forcegp.forces.mean import AnalyticalMean
from forcegp.forces.measurements import NoiseStd, Training
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import ContactForcePrior
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.priors.normal_force import NormalForcePrior
from forcegp.forces.priors.sliding_friction import SlidingFrictionPrior
from forcegp.gp import kernels, stationary
from forcegp.models.base import FitResult
from forcegp.robot.parameters import AnalyticalParameters
from forcegp.storage.descriptions import encode
from forcegp.storage.folder import Settings
from forcegp.storage.system import robot_tensors

CLASSES: dict[str, type] = {
    "squared_exponential": stationary.SquaredExponential,
    "matern32": stationary.Matern32,
    "matern52": stationary.Matern52,
    "linear": kernels.Linear,
    "sum": kernels.Sum,
    "product": kernels.Product,
    "joint": JointForcePrior,
    "normal": NormalForcePrior,
    "contact": ContactForcePrior,
    "sliding_friction": SlidingFrictionPrior,
}
"""What can be saved, by the name in the file."""
COLUMNS = ("q", "qd", "tau", "active", "values")
"""What is kept of each measurement."""


@dataclass(frozen=True, eq=False)
class Specification:
    """What a structured Gaussian process is made of before it sees data.

    Attributes:
        system: robot and contacts.
        mean: prior mean of Q.
        priors: on the unknown forces.
        noise_std: of measured accelerations, or `None` for what the log states.
        learn_noise: whether the noise is learned.
        parameters: module whose `forward()` gives the robot at θ_A, or `None`.
    """

    system: ConstrainedSystem
    mean: AnalyticalMean
    priors: tuple[ForcePrior, ...]
    noise_std: NoiseStd | None = None
    learn_noise: bool = False
    parameters: nn.Module | None = None

    def problem(self, training: Training) -> Problem:
        """The learning problem of training data."""
        return Problem(self.system, self.priors, self.mean, training, self.parameters)


class ResultSettings(Settings):
    """How the fit went."""

    converged: bool
    evaluations: NonNegativeInt
    seconds: NonNegativeFloat
    objective: float
    log_marginal_likelihood: float | None
    jitter: NonNegativeFloat
    message: str
    force_correlation: float | None
    warnings: tuple[str, ...]


class StructuredSettings(Settings):
    """What is kept of a structured Gaussian process besides its tensors."""

    mean: tuple[str, ...]
    noise_std: PositiveFloat | tuple[PositiveFloat, ...] | None
    learn_noise: bool
    priors: tuple[dict[str, Any], ...]
    measured: tuple[str, ...]
    constant: tuple[tuple[str, ...], ...]
    analytical: dict[str, tuple[str, ...]] | None
    result: ResultSettings


def pack(
    spec: Specification,
    training: Training,
    hyperparameters: Mapping[str, Tensor],
    alpha: Tensor,
    result: FitResult,
) -> tuple[StructuredSettings, dict[str, Tensor]]:
    """A fit as settings and tensors.

    Args:
        spec: what was fitted.
        training: what it is conditioned on.
        hyperparameters: all learned tensors.
        alpha: weights of the rows.
        result: how the fit went.

    Raises:
        ModelError: a prior or kernel is Python code.
    """
    noise = None if spec.noise_std is None else torch.as_tensor(spec.noise_std).tolist()
    own = spec.parameters if isinstance(spec.parameters, AnalyticalParameters) else None
    settings = StructuredSettings(
        mean=spec.mean.terms,
        noise_std=tuple(noise) if isinstance(noise, list) else noise,
        learn_noise=spec.learn_noise,
        priors=tuple(encode(prior, CLASSES) for prior in spec.priors),
        measured=training.quantities,
        constant=tuple(scale.constant for scale in training.scales),
        analytical=None if own is None else own.joints,
        result=ResultSettings(**{name: getattr(result, name) for name in ResultSettings.model_fields}),
    )
    tensors = {f"hyper.{key}": value for key, value in _kept(hyperparameters, own).items()}
    tensors["alpha"] = alpha
    if own is not None:
        tensors |= {f"start.{name}": getattr(own.start, name) for name in robot_tensors(own.start)}
    for i, (m, std) in enumerate(zip(training.measurements, training.noise_std, strict=True)):
        tensors |= {f"data.{i}.{name}": getattr(m, name) for name in COLUMNS}
        tensors[f"data.{i}.noise_std"] = std
    for prior, scale in zip(spec.priors, training.scales, strict=True):
        tensors |= {f"scale.{prior.name}.mean.{key}": value for key, value in scale.mean.items()}
        tensors |= {f"scale.{prior.name}.std.{key}": value for key, value in scale.std.items()}
    return settings, tensors


def _kept(hyper: Mapping[str, Tensor], own: AnalyticalParameters | None) -> dict[str, Tensor]:
    """The hyperparameters without θ_A of a module that cannot be saved, which the robot contains."""
    left_out = analytical_parameters(hyper) if own is None else {}
    return {k: v for k, v in hyper.items() if k.removeprefix("analytical.") not in left_out}
