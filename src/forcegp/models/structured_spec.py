"""What a structured Gaussian process is made of, and its form in saved files."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import UnknownNameError
from forcegp.forces.inertia import Inertia, inertia_of
from forcegp.forces.learn import Problem, analytical_parameters
from forcegp.forces.measurements import Training
from forcegp.forces.noise import Noise, state_std_of
from forcegp.forces.observations import (
    Observation,
    observations_of,
    plain,
    states_noise,
)
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ANALYTICAL, ForcePrior
from forcegp.forces.priors.contact import ContactForcePrior, NormalForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import (
    AnalyticalMean,
    CoregionalPrior,
    DisturbancePrior,
    JointForcePrior,
    JointFrictionPrior,
)
from forcegp.forces.priors.sets import PriorSet
from forcegp.gp import kernels
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.inducing import LIMIT
from forcegp.gp.ornstein_uhlenbeck import OrnsteinUhlenbeck
from forcegp.gp.sparse_tensors import tensors_of_posterior
from forcegp.models.fit_result import Compared, FitResult
from forcegp.robot.parameters import AnalyticalParameters
from forcegp.storage.descriptions import encode
from forcegp.storage.model_file import Settings
from forcegp.storage.system import robot_tensors

CLASSES: dict[str, type] = {
    "squared_exponential": kernels.SquaredExponential,
    "matern32": kernels.Matern32,
    "matern52": kernels.Matern52,
    "linear": kernels.Linear,
    "sum": kernels.Sum,
    "product": kernels.Product,
    "constant": kernels.Constant,
    "ornstein_uhlenbeck": OrnsteinUhlenbeck,
    "joint": JointForcePrior,
    "joint_friction": JointFrictionPrior,
    "disturbance": DisturbancePrior,
    "coregional": CoregionalPrior,
    "inertial": InertialPrior,
    "normal": NormalForcePrior,
    "payload": PayloadPrior,
    "contact": ContactForcePrior,
    "sliding_friction": SlidingFrictionPrior,
}
"""What can be saved, by the name in the file."""
Stated = NonNegativeFloat | tuple[NonNegativeFloat, ...]
"""A noise that may be zero, as one number or one per joint."""
INERTIAS = ("file", "auto")
"""Where the inertia of the robot is from."""
COLUMNS = ("q", "qd", "tau", "active", "values")
"""What is kept of each measurement."""
IN_TIME = ("segment", "t")
"""What is kept beside it where a prior is a function of time."""


@dataclass(frozen=True, eq=False)
class Specification:
    """What a structured Gaussian process is made of before it sees data.

    Attributes:
        system: robot and contacts.
        mean: prior mean of Q.
        priors: on the unknown forces.
        noise: of measured accelerations, torques and states.
        analytical_parameters: module whose `forward()` gives the robot at θ_A, or `None`.
        inference: `"auto"`, `"exact"` or `"sparse"`.
        inducing_points: maximum number of inducing points of one prior.
        automatic: whether the data choose the priors among `SETS`.
        inertia: `"file"`, or `"auto"` where the log may show another one; `None` leaves that to the data
            if they choose the priors, and is `"file"` elsewhere.
        standardize: whether the inputs of kernels are standardized.
    """

    system: ConstrainedSystem
    mean: AnalyticalMean
    priors: tuple[ForcePrior, ...]
    noise: Noise
    analytical_parameters: nn.Module | None = None
    inference: str = "auto"
    inducing_points: int = LIMIT
    automatic: bool = False
    inertia: str | None = None
    standardize: bool = True

    def for_data(self, data: Dataset | Sequence[Observation]) -> Specification:
        """The specification with the noise that was left to the data.

        The noise of accelerations is learned with that of the torque, or to compare sets of priors, if nobody
        states it.
        """
        learns = self.noise.learns_torque or self.automatic
        if learns and self.noise.acceleration is None and not states_noise(observations_of(data)):
            return dataclasses.replace(self, noise=dataclasses.replace(self.noise, learn=True))
        return self

    def with_set(self, chosen: PriorSet) -> Specification:
        """The specification with a set of priors, and the noise of the torque that goes with it."""
        priors, noise = chosen.priors(self.system), self.noise
        if isinstance(noise.torque, str) and noise.torque == "auto":
            noise = noise.for_priors(priors)
        return dataclasses.replace(self, priors=priors, noise=noise, automatic=False)

    def inertia_of(self, training: Training) -> Inertia:
        """The robot that the training samples ask for, where the model is to find it."""
        friction = next((prior for prior in self.priors if isinstance(prior, JointFrictionPrior)), None)
        asks = (
            self.inertia == "auto" and "actuation" in self.mean.terms and self.analytical_parameters is None
        )
        if friction is None or not asks or any(isinstance(prior, InertialPrior) for prior in self.priors):
            return Inertia(self.system.robot)
        return inertia_of(self.system, friction, self.mean, training)

    def problem(self, training: Training) -> Problem:
        """The learning problem of training data."""
        robot, noise = self.system.robot, self.noise
        std = None
        if noise.torque is not None and not isinstance(noise.torque, str):
            std = torch.as_tensor(noise.torque, dtype=robot.dtype, device=robot.device).expand(robot.nq)
        state_std, theta = state_std_of(noise.state, robot), self.analytical_parameters
        return Problem(self.system, self.priors, self.mean, training, theta, std, state_std=state_std)


def check_inertia(inertia: str | None) -> str | None:
    """Where the inertia of the robot is from.

    Raises:
        UnknownNameError: neither "file" nor "auto".
    """
    if inertia is not None and inertia not in INERTIAS:
        raise UnknownNameError("inertia", inertia, INERTIAS)
    return inertia


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
    inference: str = ""
    samples: NonNegativeInt | None = None
    learned_on: NonNegativeInt | None = None
    basis_functions: NonNegativeInt | None = None
    determined: float | None = None
    missed: float | None = None
    more_points_would_help: bool | None = None
    comparison: tuple[Compared, ...] = ()


class NoiseSettings(Settings):
    """Fields of `Noise`."""

    acceleration: PositiveFloat | tuple[PositiveFloat, ...] | None
    learn: bool
    torque: PositiveFloat | tuple[PositiveFloat, ...] | Literal["learn"] | None
    state: tuple[Stated, Stated] | None
    degrees_of_freedom: float | None = Field(gt=2.0)


class StructuredSettings(Settings):
    """What is kept of a structured Gaussian process besides its tensors."""

    mean: tuple[str, ...]
    noise: NoiseSettings
    inference: Literal["auto", "exact", "sparse"]
    inducing_points: PositiveInt = LIMIT
    standardize: bool = True
    inertia: Literal["file", "auto"] | None = None
    power: float = Field(gt=0.0, le=1.0)
    correlation_time: float = Field(default=0.0, ge=0.0)
    priors: tuple[dict[str, Any], ...]
    measured: tuple[str, ...]
    constant: tuple[tuple[str, ...], ...]
    analytical_parameters: dict[str, tuple[str, ...]] | None
    result: ResultSettings


def pack(
    spec: Specification,
    problem: Problem,
    hyperparameters: Mapping[str, Tensor],
    posterior: ForcePosterior,
    result: FitResult,
) -> tuple[StructuredSettings, dict[str, Tensor]]:
    """A fit as settings and tensors; an exact posterior keeps its data, a sparse one its sums over them.

    Args:
        spec: what was fitted.
        problem: what it is conditioned on.
        hyperparameters: all learned tensors.
        posterior: over the forces.
        result: how the fit went.

    Raises:
        ModelError: a prior or kernel is Python code.
    """
    own = spec.analytical_parameters if isinstance(spec.analytical_parameters, AnalyticalParameters) else None
    tensors = {f"hyper.{key}": value for key, value in _kept(hyperparameters, own).items()}
    tensors |= {f"pinned.{name}": value for name, value in problem.pinned.items()}
    if problem.torque_std is not None:
        tensors["torque_std"] = problem.torque_std
    if problem.correlation is not None:
        tensors["torque_correlation"] = problem.correlation
    tensors |= _conditioned_on(spec, problem.training, posterior)
    start = own.start if own is not None else spec.system.robot
    tensors |= {f"start.{name}": getattr(start, name) for name in robot_tensors(start)}
    for prior, scale in zip(spec.priors, problem.training.scales, strict=True):
        tensors |= {f"scale.{prior.name}.mean.{key}": value for key, value in scale.mean.items()}
        tensors |= {f"scale.{prior.name}.std.{key}": value for key, value in scale.std.items()}
    return _settings_of(spec, problem, isinstance(posterior.latent, ExactPosterior), own, result), tensors


def _settings_of(
    spec: Specification, problem: Problem, exact: bool, own: AnalyticalParameters | None, result: FitResult
) -> StructuredSettings:
    """What is kept of a fit besides tensors."""
    noise = spec.noise
    return StructuredSettings(
        mean=spec.mean.terms,
        noise=NoiseSettings(
            acceleration=plain(noise.acceleration),
            learn=noise.learn,
            torque=plain(noise.torque),
            state=None if noise.state is None else tuple(map(plain, noise.state)),  # pyright: ignore[reportArgumentType]
            degrees_of_freedom=noise.degrees_of_freedom,
        ),
        inference=spec.inference,  # pyright: ignore[reportArgumentType]
        inducing_points=spec.inducing_points,
        standardize=spec.standardize,
        inertia=spec.inertia,  # pyright: ignore[reportArgumentType]
        power=problem.power,
        priors=tuple(encode(prior, CLASSES) for prior in problem.priors),
        measured=problem.training.quantities if exact else (),
        constant=tuple(scale.constant for scale in problem.training.scales),
        analytical_parameters=None if own is None else own.joints,
        result=ResultSettings(**{name: getattr(result, name) for name in ResultSettings.model_fields}),
    )


def _conditioned_on(spec: Specification, training: Training, posterior: ForcePosterior) -> dict[str, Tensor]:
    """The data of an exact posterior, or the sums over them of a sparse one."""
    latent = posterior.latent
    if isinstance(latent, ExactPosterior):
        return {"alpha": latent.alpha, **_tensors_of(training, any(p.in_time for p in spec.priors))}
    return {f"sparse.{name}": value for name, value in tensors_of_posterior(latent).items()}
    return tensors


def _tensors_of(training: Training, in_time: bool) -> dict[str, Tensor]:
    """The data of an exact posterior, with their times where a prior reads them."""
    tensors = {}
    for i, (m, std) in enumerate(zip(training.measurements, training.noise_std, strict=True)):
        tensors |= {f"data.{i}.{name}": getattr(m, name) for name in COLUMNS + (IN_TIME if in_time else ())}
        tensors[f"data.{i}.noise_std"] = std
        if training.weights is not None:
            tensors[f"data.{i}.weight"] = training.weights[i]
        if training.slopes is not None and (G := training.slopes[i]) is not None:
            tensors[f"data.{i}.slope"] = G
    return tensors


def _kept(hyper: Mapping[str, Tensor], own: AnalyticalParameters | None) -> dict[str, Tensor]:
    """The hyperparameters without θ_A of a module that cannot be saved, which the robot contains."""
    left_out = analytical_parameters(hyper) if own is None else {}
    return {k: v for k, v in hyper.items() if k.removeprefix(f"{ANALYTICAL}.") not in left_out}
