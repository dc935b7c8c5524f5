"""The analytical model: the equations of motion with learned figures of the robot, and no contact friction.

q̈ = L b + H(Q_C + Q_G + Q_D + Q_u) (eqs. 2 and 4, with Q_z = 0), trained by mean squared error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.forces.mean import AnalyticalMean
from forcegp.forces.measurements import Observation, measurement_of
from forcegp.forces.projection import Measurement, prior_mean
from forcegp.forces.quantities import affine_map
from forcegp.forces.states import states
from forcegp.gp.optimise import Learned, LearningOptions, minimise
from forcegp.models.base import FitProgress, FitResult, ForceField, Model, Prediction
from forcegp.models.flat import flat_states
from forcegp.models.minibatch import BatchOptions, Loss, train
from forcegp.robot.parameters import AnalyticalParameters

LearnedFigures = Mapping[str, Sequence[str] | Literal["all"]]
EVERY_LINK: LearnedFigures = {"inertia": "all", "damping": "all"}
"""Mass, centre of mass and rotational inertia of every link, and the viscous friction of every joint."""
ADAM = BatchOptions(epochs=30, batch=128, learning_rate=0.05, patience=10)
CHUNK_STATES = 4096
"""States predicted at a time, which bounds the memory."""


@dataclass(frozen=True)
class Window:
    """How far from the robot file's figures learning starts.

    Args:
        relative: half width for logarithms of masses, moments and friction; 0.5 is a factor of 0.37 to
            2.7 for the mass of a link, and of 0.61 to 1.65 for friction.
        length: half width for centres of mass and other lengths [m].
        angle: half width for turns [rad].
    """

    relative: float = 0.5
    length: float = 0.05
    angle: float = 0.1


class AnalyticalModel(Model):
    """The constrained equations of motion, with the robot's figures θ_A learned from accelerations.

    Without `fit` it predicts with the robot file's figures. Learned figures stay physical, since θ_A
    are coordinates of physical bodies only.

    Args:
        system: robot and contacts.
        learn: joint names by quantity, as for `AnalyticalParameters`.
        window: how far from the file's figures learning starts.
        seed: of the start.

    Raises:
        UnknownNameError, ModelError, InertiaError: `learn` does not fit the robot.
    """

    kind = "analytical"

    def __init__(
        self,
        system: ConstrainedSystem,
        learn: LearnedFigures = EVERY_LINK,
        window: Window | None = None,
        seed: int = 0,
    ) -> None:
        self.system = system
        self.window = window or Window()
        self.seed = seed
        self.parameters = AnalyticalParameters(system.robot, learn)

    def fit(
        self,
        data: Dataset,
        *,
        options: BatchOptions | LearningOptions | None = None,
        progress: FitProgress | None = None,
    ) -> FitResult:
        """Minimise the mean squared error of the accelerations, from a random start in the window.

        Args:
            data: states and measured accelerations.
            options: ADAM on batches with early stopping by default; `LearningOptions` minimise over all
                samples at once, by L-BFGS or ADAM.
            progress: called after each epoch, or evaluation.

        Raises:
            ModelError, DataError: the data do not fit the model.
        """
        options = options or ADAM
        measured, _ = measurement_of(Observation(data, noise_std=1.0), self.system, 1.0)
        generator, width = torch.Generator().manual_seed(self.seed), self.window
        self.parameters.reset(generator, relative=width.relative, length=width.length, angle=width.angle)
        start = {name: value.detach().clone() for name, value in self.parameters.named_parameters()}

        def loss(tensors: Mapping[str, Tensor], rows: Tensor) -> Tensor:
            robot = torch.func.functional_call(self.parameters, dict(tensors), ())
            return _mean_squared_error(self.system.with_robot(robot), measured, rows)

        if isinstance(options, BatchOptions):
            learned = train(loss, start, len(measured.q), options, generator, progress)
        else:
            learned = self._minimise(loss, start, len(measured.q), options, progress)
        self._adopt(learned)
        return FitResult(
            converged=learned.converged,
            evaluations=learned.evaluations,
            seconds=learned.seconds,
            objective=learned.value,
            message=learned.message,
            history=tuple(learned.history),
        )

    @staticmethod
    def _minimise(
        loss: Loss,
        start: dict[str, Tensor],
        samples: int,
        options: LearningOptions,
        progress: FitProgress | None,
    ) -> Learned:
        """Minimise over all samples at once."""
        rows = torch.arange(samples, device=next(iter(start.values())).device)

        def report(evaluations: int, value: float, _: dict[str, Tensor]) -> None:
            if progress is not None:
                progress(evaluations, options.max_evaluations, value)

        return minimise(lambda tensors: loss(tensors, rows), start, options, progress=report)

    def _adopt(self, learned: Learned) -> None:
        self.parameters.load_state_dict(learned.tensors)
        with torch.no_grad():
            self.system = self.system.with_robot(self.parameters())

    @torch.no_grad()
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str | Sequence[str] = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
    ) -> Prediction:
        """A quantity by the equations of motion; there is no covariance.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: a name of `QUANTITIES`, or several.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            covariance: without effect, since the model knows no uncertainty.

        Returns:
            The values `(*batch, d)` as the mean.

        Raises:
            UnknownNameError: no such quantity.
            ShapeError: a state does not fit the robot.
        """
        flat = flat_states(self.system, q, qd, tau, active)
        names = [quantity] if isinstance(quantity, str) else list(quantity)
        values: list[Tensor] = []
        parts: dict[str, slice] = {}
        for first in range(0, max(len(flat.q), 1), CHUNK_STATES):
            rows = slice(first, first + CHUNK_STATES)
            at = states(self.system, flat.q[rows], flat.qd[rows], flat.tau[rows], flat.active[rows])
            by_name = [
                prior_mean(self.system, at, affine_map(self.system, at, name), AnalyticalMean())
                for name in names
            ]
            values.append(torch.cat(by_name, dim=-1))
            parts = _parts(names, [x.shape[-1] for x in by_name])
        mean = torch.cat(values)
        return Prediction(mean.reshape(*flat.batch, mean.shape[-1]), None, parts)

    def force_field(self) -> ForceField:
        return AnalyticalMean()

    def save(self, path: str | Path) -> None:
        """Write the model as a folder; `forcegp.load_model` reads it back exactly."""
        from forcegp.models.baseline_files import save_analytical

        save_analytical(self, path)


def _mean_squared_error(system: ConstrainedSystem, measured: Measurement, rows: Tensor) -> Tensor:
    eom = system.equations(measured.q[rows], measured.qd[rows], measured.active[rows])
    return ((eom.acceleration(eom.Q_K + measured.tau[rows]) - measured.values[rows]) ** 2).mean()


def _parts(names: Sequence[str], widths: Sequence[int]) -> dict[str, slice]:
    """The slice of each quantity among several side by side."""
    parts, first = {}, 0
    for name, width in zip(names, widths, strict=True):
        parts[name], first = slice(first, first + width), first + width
    return parts
