"""The data of every figure of the paper, one stage each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.default import contact_priors
from forcegp.models.structured_gp import StructuredGP
from forcegp.paper.covariance import CovarianceData, covariance_blocks
from forcegp.paper.fits import Fit, noise_std_of
from forcegp.paper.identification import (
    IdentificationData,
    IdentificationRun,
    identify_alone,
    identify_structured,
)
from forcegp.paper.multiplier import MultiplierData, predicted_multiplier
from forcegp.paper.profiles import Profile
from forcegp.paper.results import PAPER_KERNELS
from forcegp.paper.stages import Advance, Stages
from forcegp.paper.task import Task
from forcegp.paper.task_space import TaskSpaceData, task_space_motion
from forcegp.paper.trajectories import trajectories
from forcegp.report.rollout_data import RolloutData
from forcegp.report.window import WindowData, predicted_window

COVARIANCE_STATES = 6
"""States of figure 1: the first training points."""
MULTIPLIER_STEP = 4
"""Every fourth sample of figure 2 is predicted."""


@dataclass(frozen=True)
class FigureData:
    """What the figures of a reproduction are drawn from."""

    covariance: CovarianceData
    multiplier: MultiplierData
    task_space: TaskSpaceData
    windows: list[WindowData]
    identification: IdentificationData
    rollouts: RolloutData


def all_figures(stages: Stages, sizes: Profile, tasks: Sequence[Task], fits: Sequence[Fit]) -> FigureData:
    """The data of every figure; those over time are of the first run and its held-out stretches."""
    task = tasks[0]
    first = shown(sizes, [fit for fit in fits if fit.task is task and fit.split == "stretches"])
    covariance, multiplier, task_space, windows = of_fits(stages, sizes, task, first)
    return FigureData(
        covariance=covariance,
        multiplier=multiplier,
        task_space=task_space,
        windows=windows,
        identification=identification(stages, sizes, tasks),
        rollouts=trajectories(stages, sizes, task, first),
    )


def shown(sizes: Profile, fits: Sequence[Fit]) -> list[Fit]:
    """The fits that the figures over time show: each model at its main size."""
    return [
        fit
        for fit in fits
        if fit.points in (sizes.main, sizes.baseline_points) and fit.name not in PAPER_KERNELS.values()
    ]


def of_fits(
    stages: Stages, sizes: Profile, task: Task, fits: Sequence[Fit]
) -> tuple[CovarianceData, MultiplierData, TaskSpaceData, list[WindowData]]:
    """Figures 1 to 5, of the models at their main size."""
    structured = [fit for fit in fits if fit.name.startswith("sgp")]
    return (
        _covariance(stages, task, next(fit for fit in structured if fit.name == "sgp-zero")),
        _multiplier(stages, sizes, task, structured),
        _task_space(stages, sizes, task),
        [_window(stages, task, fit) for fit in fits],
    )


def _covariance(stages: Stages, task: Task, fit: Fit) -> CovarianceData:
    def make(_: Advance) -> CovarianceData:
        model = fit.load()
        assert isinstance(model, StructuredGP)
        return covariance_blocks(model, task.train(fit.split, COVARIANCE_STATES), fit.name)

    settings = {"states": COVARIANCE_STATES}
    return stages.data("figures/covariance", CovarianceData, make, settings=settings, inputs=[fit.stage])


def _multiplier(stages: Stages, sizes: Profile, task: Task, fits: Sequence[Fit]) -> MultiplierData:
    def make(_: Advance) -> MultiplierData:
        rows = _around(task, sizes.multiplier_seconds, MULTIPLIER_STEP)
        held = torch.zeros(len(task.data), dtype=torch.bool)
        for first, last in task.stretches():
            held[first:last] = True
        models = {fit.name: fit.load() for fit in fits}
        return predicted_multiplier(models, task.data[rows], task.motion["c"][rows, 0], held[rows])

    settings = {"seconds": sizes.multiplier_seconds, "step": MULTIPLIER_STEP}
    inputs = [task.simulated, *(fit.stage for fit in fits)]
    return stages.data("figures/multiplier", MultiplierData, make, settings=settings, inputs=inputs)


def _around(task: Task, seconds: float, step: int) -> slice:
    """Some seconds around the first held-out stretch, thinned."""
    dt = task.data.header.dt
    assert dt is not None
    (start, stop), wanted = task.stretches()[0], round(seconds / dt)
    first = max(0, min((start + stop - wanted) // 2, len(task.data) - wanted))
    return slice(first, min(first + wanted, len(task.data)), step)


def _task_space(stages: Stages, sizes: Profile, task: Task) -> TaskSpaceData:
    def make(_: Advance) -> TaskSpaceData:
        rows = torch.arange(len(task.data))[_around(task, sizes.multiplier_seconds, 2)]
        return task_space_motion(task.data.t, task.motion, rows)

    settings, inputs = {"seconds": sizes.multiplier_seconds}, [task.simulated, task.selected]
    return stages.data("figures/task-space", TaskSpaceData, make, settings=settings, inputs=inputs)


def _window(stages: Stages, task: Task, fit: Fit) -> WindowData:
    def make(_: Advance) -> WindowData:
        return predicted_window(fit.load(), task.data[slice(*task.stretches()[0])], fit.name)

    return stages.data(f"figures/window/{fit.name}", WindowData, make, settings={}, inputs=[fit.stage])


def identification(stages: Stages, sizes: Profile, tasks: Sequence[Task]) -> IdentificationData:
    """Mass and offset of the last link, learned from each simulated run."""
    points, most = sizes.identification_points, sizes.identification_evaluations
    parts = []
    for task in tasks:

        def make(advance: Advance, task: Task = task) -> IdentificationData:
            runs = _identification_runs(task, points, most, advance)
            return IdentificationData(true_mass=float(task.system.robot.mass[-1]), points=points, runs=runs)

        part = stages.data(
            f"figures/identification/seed-{task.seed}",
            IdentificationData,
            make,
            settings={"points": points, "evaluations": most},
            inputs=[task.simulated, task.selected],
        )
        parts.append(part)
    return parts[0].model_copy(update={"runs": [run for part in parts for run in part.runs]})


def _identification_runs(task: Task, points: int, most: int, advance: Advance) -> list[IdentificationRun]:
    """The analytical model alone, then with a prior on every joint force, then on the contact's friction."""
    train = task.train("stretches", points)
    found = [identify_alone(task.system, train, seed=task.seed, evaluations=most)]
    unknown: Mapping[str, list[ForcePrior] | None]
    unknown = {"sgp-mean": None, "sgp-contact": list(contact_priors(task.system))}
    for i, (name, priors) in enumerate(unknown.items()):

        def progress(done: int, _: int, objective: float, before: int = i * most) -> None:
            advance(before + done, 2 * most, f"objective {objective:.6g}")

        found.append(
            identify_structured(
                task.system,
                train,
                priors,
                name=name,
                noise_std=noise_std_of(task),
                seed=task.seed,
                evaluations=most,
                progress=progress,
            )
        )
    return found
