"""What a structured Gaussian process is made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.forces.inertia import Inertia, inertia_of
from forcegp.forces.learn import Problem
from forcegp.forces.measurements import Training
from forcegp.forces.noise import Noise, state_std_of
from forcegp.forces.observations import (
    Observation,
    observations_of,
    states_noise,
)
from forcegp.forces.priors.base import ForcePrior
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
from forcegp.gp.ornstein_uhlenbeck import OrnsteinUhlenbeck
from forcegp.storage.options import StructuredOptions

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


@dataclass(frozen=True, eq=False)
class Specification:
    """What a structured Gaussian process is made of before it sees data.

    Attributes:
        system: robot and contacts.
        mean: prior mean of Q.
        priors: on the unknown forces.
        noise: of measured accelerations, torques and states.
        analytical_parameters: module whose `forward()` gives the robot at θ_A, or `None`.
        automatic: whether the data choose the priors among `SETS`.
        options: plain values.
    """

    system: ConstrainedSystem
    mean: AnalyticalMean
    priors: tuple[ForcePrior, ...]
    noise: Noise
    analytical_parameters: nn.Module | None = None
    automatic: bool = False
    options: StructuredOptions = field(default_factory=StructuredOptions)

    def for_data(self, data: Dataset | Sequence[Observation]) -> Specification:
        """The specification with the noise that was left to the data.

        The noise of accelerations is learned with that of the torque, or to compare sets of priors, if nobody
        states it.
        """
        learns = self.noise.learns_torque or self.automatic
        if learns and self.noise.acceleration is None and not states_noise(observations_of(data)):
            return dataclasses.replace(self, noise=dataclasses.replace(self.noise, learn=True))
        return self

    def with_options(self, **changed: Any) -> Specification:
        """The specification with other options."""
        return dataclasses.replace(self, options=self.options.model_copy(update=changed))

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
            self.options.inertia == "auto"
            and "actuation" in self.mean.terms
            and self.analytical_parameters is None
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


def constant_inputs(problem: Problem) -> tuple[str, ...]:
    """Inputs of priors that do not vary in the training data."""
    pairs = zip(problem.priors, problem.training.scales, strict=True)
    return tuple(f"{prior.name}.{name}" for prior, scale in pairs for name in scale.constant)
