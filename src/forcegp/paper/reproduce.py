"""The main job: simulate, select, fit all models, evaluate them, and write a page."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from forcegp.destination import check_destination
from forcegp.files import write_text
from forcegp.gp.likelihood import MATRICES_TO_LEARN
from forcegp.paper.figures import all_figures
from forcegp.paper.fits import Fit, noise_std_of, score_fit
from forcegp.paper.jobs import fits_of, models_of, run_ahead, splits_of
from forcegp.paper.motion import write_motion
from forcegp.paper.page import render_markdown, render_page
from forcegp.paper.profiles import Profile, profile_of
from forcegp.paper.results import Results, Score
from forcegp.paper.stages import Progress, Stages, silent
from forcegp.paper.task import SCENE, Task, make_task
from forcegp.resources import announce_memory
from forcegp.scene import load_scene

PAGE, RESULTS, MARKDOWN = "report.html", "results.json", "results.md"
PACKAGES = ("forcegp", "torch", "numpy", "scipy", "pybullet", "mujoco", "matplotlib")


@dataclass(frozen=True)
class Reproduction:
    """The outcome of a reproduction.

    Attributes:
        page: the page to open.
        results: its numbers.
        reused: number of stages taken from an earlier run.
        stages: number of all stages.
    """

    page: Path
    results: Results
    reused: int
    stages: int

    def summary(self) -> dict[str, object]:
        """The main numbers by name, the page last."""
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


def run(
    profile: str | Profile = "quick",
    out: str | Path = "out",
    *,
    seed: int = 0,
    processes: int = 1,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda _: None,
) -> Reproduction:
    """Reproduce the paper's experiments; finished stages in `out` that have not changed are not run again.

    Args:
        profile: `"quick"`, `"paper"`, or your own sizes.
        out: folder for the page and everything it is made from.
        seed: of the first simulated run; the others follow.
        processes: how many stages are run at the same time; with more than one, each has one thread.
        progress: opens a progress bar with a description and a total.
        say: called with one line for every stage that ends.

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
    _announce(sizes)
    folder = root / "stages"
    made = run_ahead(folder, sizes, seed, processes, progress, say) if processes > 1 else set()
    stages = Stages(folder, progress, say, made)
    tasks = [make_task(stages, sizes, seed + i) for i in range(sizes.seeds)]
    fits = []
    for i, task in enumerate(tasks):
        fits += _fits(stages, sizes, task, splits_of(sizes, i))
    scores = [score_fit(stages, sizes, fit) for fit in fits]
    figures = all_figures(stages, sizes, tasks, fits)
    results = _results(sizes, tasks, scores, stages)
    write_text(root / RESULTS, results.to_json())
    write_text(root / MARKDOWN, render_markdown(results, figures))
    write_text(root / PAGE, render_page(results, figures, write_motion(root, tasks[0], fits)))
    done = stages.done.values()
    return Reproduction(root / PAGE, results, sum(stage.reused for stage in done), len(done))


def _announce(sizes: Profile) -> None:
    """Announce the memory of the largest fit before anything is computed."""
    system, points = load_scene(SCENE).system(), max(sizes.sizes)
    needed = int(MATRICES_TO_LEARN * 8 * (points * system.robot.nq) ** 2)
    announce_memory(needed, f"the largest fit, to {points} samples,")


def _fits(stages: Stages, sizes: Profile, task: Task, splits: list[str]) -> list[Fit]:
    """Every model on the given splits: baselines at one size, GP models at all sizes, smaller ones first."""
    return [
        fit
        for split in splits
        for name in dict.fromkeys(name for name, _ in models_of(sizes, split))
        for fit in fits_of(stages, sizes, task, split, name)
    ]


def _results(sizes: Profile, tasks: list[Task], scores: list[Score], stages: Stages) -> Results:
    return Results(
        profile=sizes.name,
        seeds=[task.seed for task in tasks],
        main_points=sizes.main,
        noise_std=noise_std_of(tasks[0]),
        settings={name: str(value) for name, value in asdict(sizes).items()},
        versions=_versions(),
        machine=f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads",
        seconds=stages.seconds,
        simulations={str(task.seed): task.summary for task in tasks},
        scores=scores,
    )


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
