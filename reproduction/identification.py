"""Identification (main paper): mass and offset of the last link, learned alongside the unknown friction."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor, nn

from forcegp import report
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.files import Header, Record
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.sets import contact_priors, default_priors
from forcegp.gp.optimise import LearningOptions, minimise
from forcegp.learning.specification import WITH_PARAMETERS
from forcegp.models.structured_gp import StructuredGP
from forcegp.robot.model import RobotModel
from reproduction.stages import write_data
from reproduction.statements import Statement
from reproduction.task import Task

WRONG_MASS = 2.5
"""Initial mass of the last link [kg]; the truth is 2.0."""
WRONG_OFFSET = 0.05
"""Initial error of the last joint's position along each axis [m]."""
MASS_RANGE = 1.0
"""Range of masses shown around the truth [kg]; the first steps of the optimiser exceed it."""
MASS_TOLERANCE, OFFSET_TOLERANCE = 0.02, 1e-3
WIDTH = 4.6


class LastLink(nn.Module):
    """θ_A = (log mass of the last link, shift of the last joint).

    The shift is learned in centimetres, which keeps the optimiser's steps small in terms of posture.
    """

    def __init__(self, start: RobotModel) -> None:
        super().__init__()
        self.start = start
        self.log_mass = nn.Parameter(start.mass[-1].log())
        self.shift_cm = nn.Parameter(start.placement_position.new_zeros(3))

    def forward(self) -> RobotModel:
        position = self.start.placement_position[-1] + 0.01 * self.shift_cm
        last = torch.tensor([self.start.nq - 1])
        return self.start.replace(
            mass=self.start.mass.index_copy(0, last, self.log_mass.exp()[None]),
            placement_position=self.start.placement_position.index_copy(0, last, position[None]),
        )


def wrong_parameters(robot: RobotModel) -> LastLink:
    """Return θ_A of a robot with a last link that is too heavy and a misplaced last joint."""
    mass, position = robot.mass.clone(), robot.placement_position.clone()
    mass[-1] = WRONG_MASS
    position[-1] += WRONG_OFFSET
    return LastLink(robot.replace(mass=mass, placement_position=position))


class IdentificationRun(Record):
    """Analytical parameters over the iterations of one model.

    Attributes:
        model: name of the model.
        seed: seed for the data.
        mass: mass of the last link [kg].
        offset: error of the last joint's position, by axis [m].
    """

    model: str
    seed: int
    mass: report.Series
    offset: list[report.Series]

    def off(self, i: int, true_mass: float) -> tuple[float, float]:
        """Return the errors of mass [kg] and offset (largest axis) [m] at an evaluation."""
        return abs(self.mass[i] - true_mass), max(abs(axis[i]) for axis in self.offset)


class IdentificationData(Header):
    """Mass and offset identified alongside the unknown friction.

    Attributes:
        true_mass: [kg].
        points: training points.
        runs: one per model and seed.
    """

    FORMAT: ClassVar[str] = "forcegp-identification"
    VERSION: ClassVar[int] = 1

    true_mass: float
    points: int
    runs: list[IdentificationRun]


class Trace:
    """θ_A at the best evaluation so far, one entry per evaluation.

    An evaluation may call the module several times with the same parameters, so an entry is only made when
    the evaluation is reported.
    """

    def __init__(self, theta: LastLink) -> None:
        self.best: list[tuple[Tensor, Tensor]] = []
        self.least = float("inf")
        theta.register_forward_hook(self._look)

    def _look(self, _: nn.Module, __: object, robot: RobotModel) -> None:
        self.last = robot.mass[-1].detach().clone(), robot.placement_position[-1].detach().clone()

    def evaluated(self, objective: float) -> None:
        """Note that an evaluation ended with a value of the objective."""
        improved = objective < self.least or not self.best
        self.best.append(self.last if improved else self.best[-1])
        self.least = min(self.least, objective)

    def run(self, truth: RobotModel, model: str, seed: int) -> IdentificationRun:
        """Return the parameters over the evaluations, with the true values."""
        mass, position = (torch.stack(values) for values in zip(*self.best, strict=True))
        offset = report.columns(position - truth.placement_position[-1])
        return IdentificationRun(model=model, seed=seed, mass=report.series(mass), offset=offset)


def make_identification(folder: Path, run: Path, rows: Path, *, points: int, evaluations: int) -> None:
    """Write the data of one run: the analytical model alone, then with two priors on the friction."""
    task = Task.read(run, rows)
    system, train, seed = task.system, task.train("stretches", points), task.seed
    runs = [identify_alone(system, train, seed=seed, evaluations=evaluations)]
    for name, priors in (
        ("sgp-mean", default_priors(system, "analytical")),
        ("sgp-contact", contact_priors(system)),
    ):
        options = {"noise_std": task.noise_std, "seed": seed, "evaluations": evaluations}
        runs.append(identify_structured(system, train, priors, name=name, **options))
    true_mass = float(system.robot.mass[-1])
    write_data(folder, IdentificationData(true_mass=true_mass, points=points, runs=runs))


def identify_structured(
    system: ConstrainedSystem,
    data: Dataset,
    force_priors: Sequence[ForcePrior],
    *,
    name: str,
    noise_std: float,
    seed: int,
    evaluations: int,
) -> IdentificationRun:
    """Learn θ_A with the hyperparameters of the unknown forces, by maximum a posteriori.

    Args:
        system: the true system.
        data: training samples.
        force_priors: on the unknown forces.
        name: name of the model, for the plot.
        noise_std: standard deviation of the accelerations [rad/s²].
        seed: seed for the data, for the plot.
        evaluations: number of evaluations of the objective.
    """
    theta = wrong_parameters(system.robot)
    trace = Trace(theta)
    # The model starts from a robot other than the logged one on purpose.
    data = data.replace(header=data.header.model_copy(update={"robot_fingerprint": None}))
    model = StructuredGP(
        system.with_robot(theta.start),
        mean="analytical",
        force_priors=force_priors,
        noise=noise_std,
        analytical_parameters=theta,
    )
    model.fit(data, options=_options(evaluations), progress=lambda _, __, value: trace.evaluated(value))
    return trace.run(system.robot, name, seed)


def identify_alone(
    system: ConstrainedSystem, data: Dataset, *, seed: int, evaluations: int
) -> IdentificationRun:
    """Return θ_A of the analytical model alone, without a model of the friction, by least squares."""
    theta = wrong_parameters(system.robot)
    trace, active = Trace(theta), data.active(system.contact_names)

    def objective(tensors: dict[str, Tensor]) -> Tensor:
        robot = torch.func.functional_call(theta, tensors, ())
        eom = system.with_robot(robot).equations(data.q, data.qd, active)
        return (eom.acceleration(eom.Q_K + data.tau) - data.qdd).square().mean()

    start = {name: value.detach().clone() for name, value in theta.named_parameters()}
    minimise(objective, start, _options(evaluations), progress=lambda _, value, __: trace.evaluated(value))
    return trace.run(system.robot, "analytical", seed)


def _options(evaluations: int) -> LearningOptions:
    return dataclasses.replace(WITH_PARAMETERS, max_evaluations=evaluations)


def identification_block(data: IdentificationData) -> report.PictureBlock:
    """Return the figure with its caption."""
    return report.PictureBlock(
        "Identification (main paper)",
        f"Mass of the last link, started at {WRONG_MASS} kg, and error of the last joint's position, "
        f"started {WRONG_OFFSET} m off along each axis, learned from {data.points} points together with the "
        "unknown friction; beside them the analytical model alone, which cannot represent the friction. "
        f"Each curve shows the best parameters so far; masses further than {MASS_RANGE:g} kg from the truth "
        "are cut off. The dotted line marks 1 mm.",
        (draw_mass(data), draw_offset(data)),
        "stages/figures/identification/",
    )


def draw_mass(data: IdentificationData) -> report.Picture:
    """Return the last link's mass over the evaluations."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.axhline(data.true_mass, color=report.INK, linewidth=0.9, linestyle=":", label="true")
        for run in data.runs:
            axes.plot(run.mass, color=report.colour(run.model), label=report.label(run.model))
        axes.set_xlabel("evaluation")
        axes.set_ylabel("mass of the last link [kg]")
        axes.set_ylim(data.true_mass - MASS_RANGE, data.true_mass + MASS_RANGE)
        _legend(figure, axes, columns=2)

    ends = "; ".join(f"{report.label(run.model)} {run.mass[-1]:.3f} kg" for run in data.runs)
    alt = f"Mass over evaluations, true {data.true_mass:g} kg; last: {ends}."
    return report.draw(paint, (WIDTH, 4.1), alt, "Mass")


def draw_offset(data: IdentificationData) -> report.Picture:
    """Return the error of the last joint's offset over the evaluations, by axis."""
    names = list(dict.fromkeys(run.model for run in data.runs))

    def paint(figure: Figure) -> None:
        rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(rows, names, strict=True):
            for run in (r for r in data.runs if r.model == name):
                for axis, letter in enumerate("xyz"):
                    axes.plot([1e3 * abs(v) for v in run.offset[axis]], color=report.AXES[axis], label=letter)
            axes.axhline(1.0, color=report.INK, linewidth=0.7, linestyle=":")
            axes.set_yscale("log")
            axes.set_title(report.label(name), loc="left")
            axes.set_ylabel("|error| [mm]")
        rows[-1].set_xlabel("evaluation")
        _legend(figure, rows[0], columns=3)

    ends = (f"{report.label(run.model)} {1e3 * run.off(-1, data.true_mass)[1]:.2g} mm" for run in data.runs)
    alt = f"Error of the offset by axis; largest at the end: {'; '.join(ends)}."
    return report.draw(paint, (WIDTH, 4.1), alt, "Offset")


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    unique = {name: handle for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(unique.values(), unique.keys(), loc="outside upper center", ncols=min(columns, len(unique)))


def identification_finding(data: IdentificationData) -> Statement | None:
    """Return whether mass and offset are found."""
    words, good = [], []
    for model in dict.fromkeys(run.model for run in data.runs):
        runs = [run for run in data.runs if run.model == model]
        mass, offset = (max(pair) for pair in zip(*(r.off(-1, data.true_mass) for r in runs), strict=True))
        ok = mass <= MASS_TOLERANCE and offset <= OFFSET_TOLERANCE
        good += [ok] if model != "analytical" else []
        words.append(
            f"{report.label(model)}: mass off by {mass:.4f} kg, offset by {1e3 * offset:.2f} mm"
            + (f", within tolerance from evaluation {max(_settled(r, data) for r in runs)} on" if ok else "")
        )
    text = f"After learning from {data.points} points without knowing the friction (worst seed): "
    return Statement("Identification", all(good), text + "; ".join(words) + ".") if data.runs else None


def _settled(run: IdentificationRun, data: IdentificationData) -> int:
    """Return the evaluation from which on mass and offset stay within tolerance."""
    errors = [run.off(i, data.true_mass) for i in range(len(run.mass))]
    outside = [i for i, (m, o) in enumerate(errors) if m > MASS_TOLERANCE or o > OFFSET_TOLERANCE]
    return max(outside, default=-1) + 1
