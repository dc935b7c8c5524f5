"""The data of all figures, one stage each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import torch

from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.files import Header, write_text
from forcegp.forces.priors.default import contact_priors
from forcegp.models.structured_gp import StructuredGP
from forcegp.paper.covariance import covariance_blocks
from forcegp.paper.fits import Fit, noise_std_of
from forcegp.paper.identification import identify_alone, identify_structured
from forcegp.paper.multiplier import predicted_multiplier
from forcegp.paper.profiles import Profile
from forcegp.paper.rollouts import rollouts
from forcegp.paper.stages import Advance, Stages
from forcegp.paper.task import Task
from forcegp.paper.task_space import task_space_motion
from forcegp.paper.window import predicted_window
from forcegp.report.data import (
    PAPER_KERNELS,
    CovarianceData,
    IdentificationData,
    MultiplierData,
    TaskSpaceData,
    WindowData,
)
from forcegp.report.page import FigureData

DATA = "data.json"
COVARIANCE_STATES = 6
"""States of figure 1: the first training points."""
MULTIPLIER_STEP = 4
"""Every fourth sample of figure 2 is predicted."""
HeaderT = TypeVar("HeaderT", bound=Header)


def all_figures(stages: Stages, sizes: Profile, tasks: Sequence[Task], fits: Sequence[Fit]) -> FigureData:
    """The data of every figure; those over time are of the first run and its held-out stretches."""
    task = tasks[0]
    shown = [
        f
        for f in fits
        if f.task is task
        and f.split == "stretches"
        and f.points in (sizes.main, sizes.baseline_points)
        and f.name not in PAPER_KERNELS
    ]
    return FigureData(
        covariance=_covariance(stages, task, next(f for f in shown if f.name == "sgp-zero")),
        multiplier=_multiplier(stages, sizes, task, [f for f in shown if f.name.startswith("sgp")]),
        task_space=_task_space(stages, sizes, task),
        windows=[_window(stages, task, fit) for fit in shown],
        identification=_identification(stages, sizes, tasks),
        rollouts=rollouts(stages, sizes, task, shown),
    )


def _read(path: Path, kind: type[HeaderT]) -> HeaderT:
    return kind.from_json(path.read_bytes(), str(path), DataError)


def _stretch(task: Task) -> slice:
    """The first held-out stretch."""
    first, last = task.stretches()[0]
    return slice(first, last)


def _covariance(stages: Stages, task: Task, fit: Fit) -> CovarianceData:
    def make(folder: Path, _: Advance) -> None:
        model = fit.load()
        assert isinstance(model, StructuredGP)
        data = task.train(fit.split, COVARIANCE_STATES)
        write_text(folder / DATA, covariance_blocks(model, data, fit.name).to_json())

    settings = {"states": COVARIANCE_STATES}
    return _read(
        stages.run("figures/covariance", make, settings=settings, inputs=[fit.stage]) / DATA, CovarianceData
    )


def _multiplier(stages: Stages, sizes: Profile, task: Task, fits: Sequence[Fit]) -> MultiplierData:
    def make(folder: Path, _: Advance) -> None:
        models = {}
        for fit in fits:
            model = fit.load()
            assert isinstance(model, StructuredGP)
            models[fit.name] = model
        rows = _around(task, sizes.multiplier_seconds)
        held = torch.zeros(len(task.data), dtype=torch.bool)
        for first, last in task.stretches():
            held[first:last] = True
        found = predicted_multiplier(models, task.data[rows], task.motion["c"][rows, 0], held[rows])
        write_text(folder / DATA, found.to_json())

    settings = {"seconds": sizes.multiplier_seconds, "step": MULTIPLIER_STEP}
    inputs = [task.simulated, *(fit.stage for fit in fits)]
    return _read(
        stages.run("figures/multiplier", make, settings=settings, inputs=inputs) / DATA, MultiplierData
    )


def _around(task: Task, seconds: float) -> slice:
    """Some seconds about the first held-out stretch, thinned."""
    dt = task.data.header.dt
    assert dt is not None
    stretch, wanted = _stretch(task), round(seconds / dt)
    first = max(0, min((stretch.start + stretch.stop - wanted) // 2, len(task.data) - wanted))
    return slice(first, min(first + wanted, len(task.data)), MULTIPLIER_STEP)


def _task_space(stages: Stages, sizes: Profile, task: Task) -> TaskSpaceData:
    def make(folder: Path, _: Advance) -> None:
        around = _around(task, sizes.multiplier_seconds)
        rows = torch.arange(len(task.data))[around.start : around.stop : 2]
        write_text(folder / DATA, task_space_motion(task.data.t, task.motion, rows).to_json())

    settings = {"seconds": sizes.multiplier_seconds}
    inputs = [task.simulated, task.selected]
    return _read(
        stages.run("figures/task-space", make, settings=settings, inputs=inputs) / DATA, TaskSpaceData
    )


def _window(stages: Stages, task: Task, fit: Fit) -> WindowData:
    def make(folder: Path, _: Advance) -> None:
        found = predicted_window(fit.load(), task.data[_stretch(task)], fit.name)
        write_text(folder / DATA, found.to_json())

    return _read(
        stages.run(f"figures/window/{fit.name}", make, settings={}, inputs=[fit.stage]) / DATA, WindowData
    )


def _identification(stages: Stages, sizes: Profile, tasks: Sequence[Task]) -> IdentificationData:
    most = sizes.identification_evaluations

    def runs(task: Task, train: Dataset, advance: Advance) -> list:
        found = [identify_alone(task.system, train, seed=task.seed, evaluations=most)]
        for i, (name, priors) in enumerate(_unknown_forces(task).items()):

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

    parts = []
    for task in tasks:

        def make(folder: Path, advance: Advance, task: Task = task) -> None:
            data = IdentificationData(
                true_mass=float(task.system.robot.mass[-1]),
                points=sizes.identification_points,
                runs=runs(task, task.train("stretches", sizes.identification_points), advance),
            )
            write_text(folder / DATA, data.to_json())

        stage = stages.run(
            f"figures/identification/seed-{task.seed}",
            make,
            settings={"points": sizes.identification_points, "evaluations": most},
            inputs=[task.simulated, task.selected],
        )
        parts.append(_read(stage / DATA, IdentificationData))
    return parts[0].model_copy(update={"runs": [r for part in parts for r in part.runs]})


def _unknown_forces(task: Task) -> dict[str, list | None]:
    """Priors on the friction that the identification does not know."""
    return {"sgp-mean": None, "sgp-contact": list(contact_priors(task.system))}
