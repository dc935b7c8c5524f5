"""The main job: simulate, select, fit all models, evaluate them, and write a page."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from forcegp import report
from forcegp.destination import check_destination
from forcegp.files import write_text
from forcegp.gp.exact import MATRICES_TO_LEARN
from forcegp.models.load import load_model
from forcegp.resources import announce_memory, free_memory
from forcegp.robot.shapes import shapes_of
from forcegp.scene import load_scene
from forcegp.view.motion import of_log, sampled_rollout, with_rollout
from forcegp.view.page import write_view
from reproduction.covariance import CovarianceData, make_covariance
from reproduction.fits import MODEL, Fit, fits_of
from reproduction.identification import IdentificationData, make_identification
from reproduction.multiplier import MultiplierData, make_multiplier
from reproduction.page import FigureData, render_markdown, render_page
from reproduction.profiles import Profile, profile_of
from reproduction.results import PAPER_KERNELS, SPLITS, Results
from reproduction.stages import Say, Stage, run_stages, version_of, write_data
from reproduction.task import SCENE, Task, simulate_task, summary_of, task_stages
from reproduction.task_space import TaskSpaceData, make_task_space
from reproduction.trajectories import make_rollouts, together

PAGE, RESULTS, MARKDOWN, VIEW = "report.html", "results.json", "results.md", "view.html"
PACKAGES = ("forcegp", "torch", "numpy", "scipy", "pybullet", "mujoco", "matplotlib")
OTHER_MOTION = 1000
"""Offset from the first seed for the motion that is not used for training."""
VIEW_SAMPLES, VIEW_AHEAD, VIEW_SECONDS = 8, 1.0, 5.0
"""Number of function samples in the view, their duration [s], and the duration of the motion [s]."""


@dataclass(frozen=True)
class Reproduction:
    """The outcome of a reproduction.

    Attributes:
        page: the page to open.
        results: results of the reproduction.
        reused: number of stages taken from an earlier run.
        stages: number of all stages.
    """

    page: Path
    results: Results
    reused: int
    stages: int

    def summary(self) -> dict[str, object]:
        """Return the main numbers by name, the page last."""
        numbers: dict[str, object] = {
            "profile": self.results.profile,
            "stages": f"{self.stages} ({self.reused} done before)",
            "computing_time_s": round(self.results.seconds, 1),
        }
        held = [s for s in self.results.scores if s.split == "stretches"]
        for name in dict.fromkeys(s.model for s in held):
            last = max((s for s in held if s.model == name), key=lambda s: s.points)
            numbers[f"{name}_noisy_error_rad_s2"] = round(last.noisy_mae, 4)
        return numbers | {"report": str(self.page)}


@dataclass(frozen=True)
class Plan:
    """The stages of a reproduction.

    Attributes:
        tasks: two stages for each simulated run.
        identification: one stage for each simulated run.
        fits: fits of every model on its splits.
        covariance, multiplier, task_space: data of figures 1 to 3.
        windows: windows of figures 4 and 5, one for each model.
        unseen: a run with other waypoints.
        rollouts: trajectories on that run, one stage for each model.
        view: the motion in 3D, or `None`.
    """

    tasks: list[tuple[Stage, Stage]]
    identification: list[Stage]
    fits: list[Fit]
    covariance: Stage
    multiplier: Stage
    task_space: Stage
    windows: list[Stage]
    unseen: Stage
    rollouts: list[Stage]
    view: list[Stage]

    def stages(self) -> list[Stage]:
        """Return all stages, the longest first."""
        fits = [fit.stage for fit in sorted(self.fits, key=lambda fit: -fit.points)]
        figures = [self.covariance, self.multiplier, self.task_space, *self.windows, *self.view]
        tasks = [stage for task in self.tasks for stage in task]
        return [*tasks, self.unseen, *self.identification, *fits, *self.rollouts, *figures]

    def figures(self) -> FigureData:
        """Return the data of all figures, available once the stages are finished."""
        runs = [stage.data(IdentificationData) for stage in self.identification]
        together_of = runs[0].model_copy(update={"runs": [run for part in runs for run in part.runs]})
        return FigureData(
            covariance=self.covariance.data(CovarianceData),
            multiplier=self.multiplier.data(MultiplierData),
            task_space=self.task_space.data(TaskSpaceData),
            windows=[stage.data(report.WindowData) for stage in self.windows],
            identification=together_of,
            rollouts=together([stage.data(report.RolloutData) for stage in self.rollouts]),
        )


def run(
    profile: str | Profile = "quick",
    out: str | Path = "out",
    *,
    seed: int = 0,
    processes: int = 1,
    say: Say = lambda *_: None,
) -> Reproduction:
    """Reproduce the paper's experiments; finished stages in `out` that have not changed are not run again.

    Args:
        profile: `"quick"`, `"paper"`, or a custom profile.
        out: folder for the page and all data.
        seed: seed for the first simulated run; the others follow.
        processes: maximum number of stages to run in parallel, limited by memory; see `run_stages`.
        say: called when a stage ends.

    Returns:
        The path of the page, and its numbers.

    Raises:
        UnknownNameError: no such profile.
        DestinationError: the folder cannot be written.
        MemoryLimitError: the largest fit needs more memory than is free.
    """
    sizes = profile_of(profile) if isinstance(profile, str) else profile
    root = Path(out)
    check_destination(root, folder=True)
    processes = min(processes, _fits_at_once(sizes))
    plan = plan_of(root / "stages", sizes, seed)
    ran = run_stages(plan.stages(), processes, say)
    results, figures = _results(sizes, plan), plan.figures()
    write_text(root / RESULTS, results.to_json())
    write_text(root / MARKDOWN, render_markdown(results, figures))
    for stage in plan.view:
        write_text(root / VIEW, (stage.folder / VIEW).read_text(encoding="utf-8"))
    write_text(root / PAGE, render_page(results, figures, VIEW if plan.view else None))
    names = {stage.name for stage in plan.stages()}
    return Reproduction(root / PAGE, results, len(names - ran), len(names))


def _fits_at_once(sizes: Profile) -> int:
    """Return how many of the largest fits fit into memory, with a warning before any computation."""
    system, points = load_scene(SCENE).system(), max(sizes.sizes)
    needed = int(MATRICES_TO_LEARN * 8 * (points * system.robot.nq) ** 2)
    announce_memory(needed, f"the largest fit, to {points} samples,")
    return max(1, (free_memory() or needed) // needed)


def plan_of(root: Path, sizes: Profile, seed: int) -> Plan:
    """Return the stages of a reproduction.

    Args:
        root: folder of the stages.
        sizes: sizes of the reproduction.
        seed: seed for its first simulated run.
    """
    tasks, fits, identified = [], [], []
    most = max(sizes.baseline_points, *sizes.sizes)
    settings: dict[str, object]
    for i in range(sizes.seeds):
        task = task_stages(root, sizes.duration, seed + i, most, sizes.stretch)
        tasks.append(task)
        for split in list(SPLITS) if i < sizes.paper_split_seeds else ["stretches"]:
            fits += fits_of(sizes, task, split, seed + i)
        settings = {"points": sizes.identification_points, "evaluations": sizes.identification_evaluations}
        name = f"figures/identification/seed-{seed + i}"
        identified.append(Stage(root, name, make_identification, settings, task))
    first, own = tasks[0], [fit for fit in fits if fit.seed == seed and fit.split == "stretches"]
    over_time = shown(sizes, own)
    structured = [fit for fit in over_time if fit.name.startswith("sgp")]
    zero = next(fit for fit in structured if fit.name == "sgp-zero")
    names, seconds = [fit.name for fit in structured], sizes.multiplier_seconds
    settings = {"duration": sizes.rollout_starts * sizes.rollout_seconds, "seed": seed + OTHER_MOTION}
    unseen = Stage(root, "simulate/rollout", simulate_task, settings)
    settings = {
        "seconds": sizes.rollout_seconds,
        "starts": sizes.rollout_starts,
        "samples": sizes.rollout_samples,
        "stretch": sizes.stretch,
    }

    def figure(name: str, make: Callable[..., None], fits: Sequence[Fit] = (), **settings: object) -> Stage:
        return Stage(root, f"figures/{name}", make, settings, (*first, *(fit.stage for fit in fits)))

    return Plan(
        tasks=tasks,
        identification=identified,
        fits=fits,
        covariance=figure("covariance", make_covariance, [zero], model=zero.name),
        multiplier=figure("multiplier", make_multiplier, structured, models=names, seconds=seconds),
        task_space=figure("task-space", make_task_space, seconds=seconds),
        windows=[figure(f"window/{fit.name}", make_window, [fit], model=fit.name) for fit in over_time],
        unseen=unseen,
        rollouts=[
            Stage(
                root,
                f"figures/rollouts/{fit.name}",
                make_rollouts,
                settings | {"model": fit.name},
                (unseen, *first, fit.stage),
            )
            for fit in over_time
        ],
        view=[figure("view", make_view, [fit]) for fit in viewed(own)],
    )


def shown(sizes: Profile, fits: Sequence[Fit]) -> list[Fit]:
    """Return the fits for the figures over time: each model at its main size."""
    return [
        fit
        for fit in fits
        if fit.points in (sizes.main, sizes.baseline_points) and fit.name not in PAPER_KERNELS.values()
    ]


def viewed(fits: Sequence[Fit]) -> list[Fit]:
    """Return the fit for the view: the largest structured one."""
    fits = [fit for fit in fits if fit.name.startswith("sgp") and fit.name not in PAPER_KERNELS.values()]
    return sorted(fits, key=lambda fit: (fit.points, fit.name == "sgp-mean"))[-1:]


def make_window(folder: Path, run: Path, rows: Path, fit: Path, *, model: str) -> None:
    """Write the predictions of a model over the first held-out stretch."""
    write_data(
        folder, report.predicted_window(load_model(fit / MODEL), Task.read(run, rows).held_out(), model)
    )


def make_view(folder: Path, run: Path, rows: Path, fit: Path) -> None:
    """Write the first held-out stretch in three dimensions, with the predictions of a structured model."""
    task, model = Task.read(run, rows), load_model(fit / MODEL)
    data = task.held_out()
    data = data[data.t <= data.t[0] + VIEW_SECONDS]
    predicted = sampled_rollout(model, data, VIEW_SAMPLES, VIEW_AHEAD)
    motion = with_rollout(of_log(task.system, data, model), predicted)
    write_view(folder / VIEW, motion, shapes_of(task.system.robot), "forcegp: the paper's task")


def _results(sizes: Profile, plan: Plan) -> Results:
    headers = [stage.found() for stage in plan.stages()]
    first = Task.read(*(stage.folder for stage in plan.tasks[0]))
    return Results(
        profile=sizes.name,
        seeds=[task[1].settings["seed"] for task in plan.tasks],
        main_points=sizes.main,
        noise_std=first.noise_std,
        settings={name: str(value) for name, value in asdict(sizes).items()},
        versions={"python": platform.python_version()}
        | {package: version_of(package) or "not installed" for package in PACKAGES},
        machine=f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads",
        seconds=sum(header.seconds for header in headers if header is not None),
        simulations={str(task[1].settings["seed"]): summary_of(task[0].folder) for task in plan.tasks},
        scores=[fit.score() for fit in plan.fits],
    )
