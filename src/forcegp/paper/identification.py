"""Mass of the last link and offset of the last joint, identified alongside the unknown friction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.forces.priors.base import ForcePrior
from forcegp.gp.optimise import LearningOptions, minimise
from forcegp.models.structured_gp import WITH_PARAMETERS, StructuredGP
from forcegp.report.data import IdentificationRun, columns, series
from forcegp.robot.model import RobotModel

WRONG_MASS = 2.5
"""Where the mass of the last link starts [kg]; the truth is 2.0."""
WRONG_OFFSET = 0.05
"""By how much the position of the last joint is off at the start, each axis [m]."""


class LastLink(nn.Module):
    """θ_A = (log mass of the last link, shift of the last joint), remembering where it was evaluated.

    The shift is learned in centimetres, so that a step of the optimiser is no leap into another posture.
    """

    def __init__(self, start: RobotModel) -> None:
        super().__init__()
        self.start = start
        self.log_mass = nn.Parameter(start.mass[-1].log())
        self.shift_cm = nn.Parameter(start.placement_position.new_zeros(3))
        self.mass: list[Tensor] = []
        self.position: list[Tensor] = []

    def forward(self) -> RobotModel:
        mass = self.log_mass.exp()
        position = self.start.placement_position[-1] + 0.01 * self.shift_cm
        self.mass.append(mass.detach())
        self.position.append(position.detach())
        last = torch.tensor([self.start.nq - 1])
        return self.start.replace(
            mass=self.start.mass.index_copy(0, last, mass[None]),
            placement_position=self.start.placement_position.index_copy(0, last, position[None]),
        )


def wrong_parameters(robot: RobotModel) -> LastLink:
    """θ_A of a robot whose last link is too heavy and whose last joint is misplaced."""
    mass, position = robot.mass.clone(), robot.placement_position.clone()
    mass[-1] = WRONG_MASS
    position[-1] += WRONG_OFFSET
    return LastLink(robot.replace(mass=mass, placement_position=position))


def identify_structured(
    system: ConstrainedSystem,
    data: Dataset,
    force_priors: list[ForcePrior] | None,
    *,
    name: str,
    noise_std: float,
    seed: int,
    evaluations: int,
    progress: Callable[[int, int, float], None] | None = None,
) -> IdentificationRun:
    """θ_A learned together with the hyperparameters of the unknown forces, by maximum a posteriori.

    Args:
        system: the true system.
        data: training samples.
        force_priors: on the unknown forces; a joint force prior by default.
        name: of the model, for the figure.
        noise_std: of the accelerations [rad/s²].
        seed: of the data, for the figure.
        evaluations: of the objective.
        progress: called after each evaluation.
    """
    theta = wrong_parameters(system.robot)
    # The model starts from another robot than the one that was logged, on purpose.
    data = data.replace(header=data.header.model_copy(update={"robot_fingerprint": None}))
    model = StructuredGP(
        system.with_robot(theta.start),
        mean="analytical",
        force_priors=force_priors,
        noise_std=noise_std,
        analytical_parameters=theta,
    )
    result = model.fit(data, options=_options(evaluations), progress=progress)
    return _run(theta, result.history, system.robot, name, seed)


def identify_alone(
    system: ConstrainedSystem, data: Dataset, *, seed: int, evaluations: int
) -> IdentificationRun:
    """θ_A of the analytical model alone, without a model of the friction, by least squares."""
    theta = wrong_parameters(system.robot)
    active = data.active(system.contact_names)

    def objective(tensors: dict[str, Tensor]) -> Tensor:
        robot = torch.func.functional_call(theta, tensors, ())
        eom = system.with_robot(robot).equations(data.q, data.qd, active)
        return (eom.acceleration(eom.Q_K + data.tau) - data.qdd).square().mean()

    start = {name: value.detach().clone() for name, value in theta.named_parameters()}
    learned = minimise(objective, start, _options(evaluations))
    return _run(theta, learned.history, system.robot, "analytical", seed)


def _options(evaluations: int) -> LearningOptions:
    return dataclasses.replace(WITH_PARAMETERS, max_evaluations=evaluations)


def _run(
    last: LastLink, history: Sequence[float], truth: RobotModel, name: str, seed: int
) -> IdentificationRun:
    """The parameters at each evaluation; where the objective is worse than before, the best so far."""
    best = [0]
    for i in range(1, len(history)):
        best.append(i if history[i] < history[best[-1]] else best[-1])
    mass = torch.stack([last.mass[i] for i in best])
    position = torch.stack([last.position[i] for i in best])
    return IdentificationRun(
        model=name,
        seed=seed,
        mass=series(mass),
        offset=columns(position - truth.placement_position[-1]),
    )
