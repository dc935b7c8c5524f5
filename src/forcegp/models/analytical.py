"""The analytical model: equations of motion with learned robot parameters and no contact friction.

q̈ = L b + H(Q_C + Q_G + Q_D + Q_u) (eqs. 2 and 4, with Q_z = 0). The parameters minimise the mean squared
error of the accelerations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.files import Record
from forcegp.forces.measurements import Observation, measurement_of
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.forces.quantities import FlatStates, ForceField, affine_maps, hidden_forces
from forcegp.gp.optimise import LearningOptions
from forcegp.models.base import FitProgress, FittedModel, Model
from forcegp.models.fit_result import FitResult
from forcegp.models.minibatch import BatchOptions, train
from forcegp.models.prediction import Answer, Query
from forcegp.options import Window
from forcegp.robot.parameters import AnalyticalParameters
from forcegp.storage.model_file import ModelHeader
from forcegp.storage.system import take, take_robot

KIND = "analytical"
LearnedParameters = Mapping[str, Sequence[str] | Literal["all"]]
EVERY_LINK: LearnedParameters = {"inertia": "all", "damping": "all"}
"""The mass, centre of mass and rotational inertia of every link, and the viscous friction of every joint."""
ADAM = BatchOptions(epochs=30, batch=128, learning_rate=0.05, patience=10)


class AnalyticalSettings(Window):
    """Saved settings of an analytical model. The robot in the file has the learned parameters."""

    analytical_parameters: dict[str, tuple[str, ...]]
    seed: int


class AnalyticalModel(Model["AnalyticalFit"]):
    """The constrained equations of motion with robot parameters θ_A learned from accelerations.

    `nominal()` predicts with the parameters from the robot file. Learned parameters are always physically
    consistent, since every θ_A describes a physical body.

    Args:
        system: the robot and its contacts.
        analytical_parameters: the parameters to learn, given as joint names for each quantity (see
            `AnalyticalParameters`).
        window: interval around the parameters in the file from which initial values are drawn.
        seed: random seed for the initial values.

    Raises:
        UnknownNameError, ModelError, InertiaError: `analytical_parameters` do not match the robot.
    """

    kind = KIND

    def __init__(
        self,
        system: ConstrainedSystem,
        analytical_parameters: LearnedParameters = EVERY_LINK,
        window: Window | None = None,
        seed: int = 0,
    ) -> None:
        self._keep(locals())
        self.system = system
        self.window = window or Window()
        self.seed = seed
        self.parameters = AnalyticalParameters(system.robot, analytical_parameters)

    def fit(
        self,
        data: Dataset,
        *,
        options: BatchOptions | LearningOptions | None = None,
        progress: FitProgress | None = None,
    ) -> AnalyticalFit:
        """Minimise the mean squared acceleration error, starting from random parameters in the window.

        Args:
            data: states and measured accelerations.
            options: learning options. `BatchOptions` (the default) select ADAM on batches with early
                stopping. `LearningOptions` select L-BFGS or ADAM on all samples.
            progress: a function called after each epoch or evaluation.

        Raises:
            ModelError, DataError: the data are incompatible with the model.
        """
        measured, _ = measurement_of(Observation(data, noise_std=1.0), self.system)
        generator = torch.Generator().manual_seed(self.seed)
        theta = AnalyticalParameters(self.parameters.start, self.parameters.joints)
        theta.reset(generator, **dict(self.window))
        start = {name: value.detach().clone() for name, value in theta.named_parameters()}

        def loss(tensors: Mapping[str, Tensor], rows: Tensor) -> Tensor:
            system = self.system.with_robot(torch.func.functional_call(theta, dict(tensors), ()))
            part = measured[rows]
            eom = system.equations(part.q, part.qd, part.active)
            return ((eom.acceleration(eom.Q_K + part.tau) - part.values) ** 2).mean()

        learned = train(loss, start, len(measured.q), options or ADAM, generator, progress)
        theta.load_state_dict(learned.tensors)
        with torch.no_grad():
            system = self.system.with_robot(theta())
        return AnalyticalFit(system, theta, self.window, self.seed, FitResult(**learned.outcome))

    def nominal(self) -> AnalyticalFit:
        """Return the equations of motion with the parameters from the robot file, without learning."""
        result = FitResult(True, 0, 0.0, 0.0, message="parameters of the robot file, nothing learned")
        return AnalyticalFit(self.system, self.parameters, self.window, self.seed, result)


@dataclass(frozen=True, eq=False, repr=False)
class AnalyticalFit(FittedModel):
    """Equations of motion of a robot with learned parameters.

    Attributes:
        system: the robot and its contacts.
        parameters: the learned coordinates of the robot parameters.
        window, seed: interval and random seed for the initial values.
        result: the result of the fit.
    """

    system: ConstrainedSystem
    parameters: AnalyticalParameters
    window: Window
    seed: int
    result: FitResult

    kind = KIND

    @property
    def specified(self) -> ConstrainedSystem:
        """System before the fit, with the initial parameters of the robot."""
        return self.system.with_robot(self.parameters.start)

    def described(self) -> list[tuple[str, object]]:
        return [(name, getattr(self.system.robot, name)) for name in ("mass", "damping")]

    def at(self, flat: FlatStates, query: Query) -> Answer:
        system = query.system or self.system
        here = flat.with_equations(system)
        z, parts = affine_maps(system, here, query.quantity)
        mean = z.o + (z.B_Q @ AnalyticalMean()(system, here)[..., None])[..., 0]
        hidden = hidden_forces(system, here, parts)
        if hidden is None:
            return (mean, None, None, torch.ones_like(mean, dtype=torch.bool)), parts, ()
        return (hidden.applied(mean, None)[0], None, None, ~hidden.whole), parts, hidden.doubts

    def force_field(self) -> ForceField:
        """Return the force field Q_C + Q_G + Q_D + Q_u."""
        return AnalyticalMean()

    @classmethod
    def restored(
        cls, header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
    ) -> AnalyticalFit:
        settings = header.settings_as(AnalyticalSettings, source)
        original = system.with_robot(take_robot(tensors, "start.", system.robot, source))
        window = Window(relative=settings.relative, length=settings.length, angle=settings.angle)
        with ModelError.within(f"{source}: field 'settings.analytical_parameters'"):
            model = AnalyticalModel(original, settings.analytical_parameters, window, settings.seed)
        theta = model.parameters
        old = theta.state_dict()
        state = {key: take(tensors, key, tuple(x.shape), x.dtype, source) for key, x in old.items()}
        theta.load_state_dict(state)
        result = FitResult(True, 0, 0.0, 0.0, message="loaded")
        return cls(system, theta, window, settings.seed, result)

    def record(self) -> tuple[Record, dict[str, Tensor]]:
        theta = self.parameters
        settings = AnalyticalSettings(**dict(self.window), analytical_parameters=theta.joints, seed=self.seed)
        start = {f"start.{name}": value for name, value in theta.start.tensors.items()}
        return settings, dict(theta.state_dict()) | start
