"""Identification (main paper): mass and offset of the last link, learned alongside the unknown friction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.files import Header
from forcegp.forces.priors.base import ForcePrior
from forcegp.gp.optimise import LearningOptions, minimise
from forcegp.models.structured_gp import StructuredGP
from forcegp.models.structured_learning import WITH_PARAMETERS
from forcegp.paper.last_link import WRONG_MASS, WRONG_OFFSET, LastLink, wrong_parameters
from forcegp.report.html import Block, Finding
from forcegp.report.style import AXES, INK, Picture, colour, draw, label
from forcegp.report.values import Part, Series, columns, series
from forcegp.robot.model import RobotModel

MASS_RANGE = 1.0
"""How far from the truth a mass is shown [kg]; the optimiser's first steps go further."""
MASS_TOLERANCE, OFFSET_TOLERANCE = 0.02, 1e-3
WIDTH = 4.6


class IdentificationRun(Part):
    """Analytical parameters over the iterations of one model.

    Attributes:
        model: name of the model.
        seed: of the data.
        mass: of the last link [kg].
        offset: error of the last joint's position, by axis [m].
    """

    model: str
    seed: int
    mass: Series
    offset: list[Series]

    def off(self, i: int, true_mass: float) -> tuple[float, float]:
        """Errors of mass [kg] and offset (largest axis) [m] at an evaluation."""
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

    An evaluation may call the module several times with the same parameters, so an entry is made when the
    evaluation is reported, from the last call before.
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
        """The parameters over the evaluations, beside the truth."""
        mass, position = (torch.stack(values) for values in zip(*self.best, strict=True))
        offset = columns(position - truth.placement_position[-1])
        return IdentificationRun(model=model, seed=seed, mass=series(mass), offset=offset)


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
    """Learn θ_A with the hyperparameters of the unknown forces, by maximum a posteriori.

    Args:
        system: the true system.
        data: training samples.
        force_priors: on the unknown forces; a joint force prior by default.
        name: of the model, for the plot.
        noise_std: of the accelerations [rad/s²].
        seed: of the data, for the plot.
        evaluations: of the objective.
        progress: called after each evaluation.
    """
    theta = wrong_parameters(system.robot)
    trace = Trace(theta)
    # The model starts from a robot other than the logged one on purpose.
    data = data.replace(header=data.header.model_copy(update={"robot_fingerprint": None}))

    def evaluated(done: int, most: int, objective: float) -> None:
        trace.evaluated(objective)
        if progress is not None:
            progress(done, most, objective)

    model = StructuredGP(
        system.with_robot(theta.start),
        mean="analytical",
        force_priors=force_priors,
        noise=noise_std,
        analytical_parameters=theta,
    )
    model = model.fit(data, options=_options(evaluations), progress=evaluated)
    return trace.run(system.robot, name, seed)


def identify_alone(
    system: ConstrainedSystem, data: Dataset, *, seed: int, evaluations: int
) -> IdentificationRun:
    """θ_A of the analytical model alone, without a model of the friction, by least squares."""
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


def identification_block(data: IdentificationData) -> Block:
    """The figure under its caption."""
    return Block(
        "Identification (main paper)",
        f"Mass of the last link, started at {WRONG_MASS} kg, and error of the last joint's position, started "
        f"{WRONG_OFFSET} m off along each axis, learned from {data.points} points together with the unknown "
        "friction; beside them the analytical model alone, which cannot represent the friction. Each curve "
        "shows "
        f"the best parameters so far; masses further than {MASS_RANGE:g} kg from the truth are cut off. The "
        "dotted line marks 1 mm.",
        (draw_mass(data), draw_offset(data)),
        "stages/figures/identification/",
    )


def draw_mass(data: IdentificationData) -> Picture:
    """The last link's mass over the evaluations."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.axhline(data.true_mass, color=INK, linewidth=0.9, linestyle=":", label="true")
        for run in data.runs:
            axes.plot(run.mass, color=colour(run.model), label=label(run.model))
        axes.set_xlabel("evaluation")
        axes.set_ylabel("mass of the last link [kg]")
        axes.set_ylim(data.true_mass - MASS_RANGE, data.true_mass + MASS_RANGE)
        _legend(figure, axes, columns=2)

    ends = "; ".join(f"{label(run.model)} {run.mass[-1]:.3f} kg" for run in data.runs)
    alt = f"Mass over evaluations, true {data.true_mass:g} kg; last: {ends}."
    return draw(paint, (WIDTH, 4.1), alt, "Mass")


def draw_offset(data: IdentificationData) -> Picture:
    """The error of the last joint's offset over the evaluations, by axis."""
    names = list(dict.fromkeys(run.model for run in data.runs))

    def paint(figure: Figure) -> None:
        rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(rows, names, strict=True):
            for run in (r for r in data.runs if r.model == name):
                for axis, letter in enumerate("xyz"):
                    axes.plot([1e3 * abs(v) for v in run.offset[axis]], color=AXES[axis], label=letter)
            axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=":")
            axes.set_yscale("log")
            axes.set_title(label(name), loc="left")
            axes.set_ylabel("|error| [mm]")
        rows[-1].set_xlabel("evaluation")
        _legend(figure, rows[0], columns=3)

    ends = (f"{label(run.model)} {1e3 * run.off(-1, data.true_mass)[1]:.2g} mm" for run in data.runs)
    alt = f"Error of the offset by axis; largest at the end: {'; '.join(ends)}."
    return draw(paint, (WIDTH, 4.1), alt, "Offset")


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    unique = {name: handle for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(unique.values(), unique.keys(), loc="outside upper center", ncols=min(columns, len(unique)))


def identification_finding(data: IdentificationData) -> Finding | None:
    """Whether mass and offset are found."""
    words, good = [], []
    for model in dict.fromkeys(run.model for run in data.runs):
        runs = [run for run in data.runs if run.model == model]
        mass, offset = (max(pair) for pair in zip(*(r.off(-1, data.true_mass) for r in runs), strict=True))
        ok = mass <= MASS_TOLERANCE and offset <= OFFSET_TOLERANCE
        good += [ok] if model != "analytical" else []
        words.append(
            f"{label(model)}: mass off by {mass:.4f} kg, offset by {1e3 * offset:.2f} mm"
            + (f", within tolerance from evaluation {max(_settled(r, data) for r in runs)} on" if ok else "")
        )
    text = f"After learning from {data.points} points without knowing the friction (worst seed): "
    return Finding("Identification", all(good), text + "; ".join(words) + ".") if data.runs else None


def _settled(run: IdentificationRun, data: IdentificationData) -> int:
    """The evaluation from which on mass and offset stay within tolerance."""
    errors = [run.off(i, data.true_mass) for i in range(len(run.mass))]
    outside = [i for i, (m, o) in enumerate(errors) if m > MASS_TOLERANCE or o > OFFSET_TOLERANCE]
    return max(outside, default=-1) + 1
