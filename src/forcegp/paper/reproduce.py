"""The main job: simulate, select, train all models, evaluate, draw, and write a page."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from forcegp.files import write_text
from forcegp.paper.figures import all_figures
from forcegp.paper.fits import Fit, fit_model, noise_std_of, score_fit
from forcegp.paper.profiles import Profile, profile_of
from forcegp.paper.stages import Progress, Stages, silent
from forcegp.paper.task import Task, make_task
from forcegp.report.data import GP_MODELS, PAPER_KERNELS, SPLITS, Results, Score
from forcegp.report.markdown import results_markdown
from forcegp.report.page import write_page

PAGE, RESULTS, MARKDOWN = "report.html", "results.json", "results.md"
LARGE = 400
"""Fits of structured GPs to so many points or more are where those to yet more points begin."""
PACKAGES = ("forcegp", "torch", "numpy", "scipy", "pybullet", "mujoco", "matplotlib")


@dataclass(frozen=True)
class Reproduction:
    """What a reproduction left.

    Attributes:
        page: the page to open.
        results: its numbers.
        reused: stages that were found done.
        stages: in all.
    """

    page: Path
    results: Results
    reused: int
    stages: int

    def summary(self) -> dict[str, object]:
        """The main figures, by name, the page last."""
        figures: dict[str, object] = {
            "profile": self.results.profile,
            "stages": f"{self.stages} ({self.reused} done before)",
            "computing_time_s": round(self.results.seconds, 1),
        }
        held = [s for s in self.results.scores if s.split == "stretches"]
        for name in dict.fromkeys(s.model for s in held):
            last = max((s for s in held if s.model == name), key=lambda s: s.points)
            figures[f"{name}_noisy_error_rad_s2"] = round(last.noisy_mae, 4)
        return figures | {"report": str(self.page)}


def run(
    profile: str | Profile = "quick",
    out: str | Path = "out",
    *,
    seed: int = 0,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda _: None,
) -> Reproduction:
    """Reproduce the paper's experiments; what is done in `out` and unchanged is not run again.

    Args:
        profile: `"quick"`, `"paper"`, or sizes of one's own.
        out: folder for the page and everything it is made from.
        seed: of the first simulated run; the others follow.
        progress: opens a progress bar with a description and a total.
        say: called with one line on every stage that ends.

    Returns:
        Where the page is, and its numbers.

    Raises:
        UnknownNameError: no such profile.
    """
    sizes = profile_of(profile) if isinstance(profile, str) else profile
    root = Path(out)
    stages = Stages(root / "stages", progress, say)
    tasks = [make_task(stages, sizes, seed + i) for i in range(sizes.seeds)]
    fits = []
    for i, task in enumerate(tasks):
        splits = list(SPLITS) if i < sizes.paper_split_seeds else ["stretches"]
        fits += _fits(stages, sizes, task, splits)
    scores = [score_fit(stages, sizes, fit) for fit in fits]
    figures = all_figures(stages, sizes, tasks, fits)
    results = _results(sizes, tasks, scores, stages)
    write_text(root / RESULTS, results.to_json())
    readings = figures.multiplier, figures.identification, figures.rollouts
    write_text(root / MARKDOWN, results_markdown(results, *readings))
    write_page(root / PAGE, results, figures)
    done = stages.done.values()
    return Reproduction(root / PAGE, results, sum(stage.reused for stage in done), len(done))


def _fits(stages: Stages, sizes: Profile, task: Task, splits: list[str]) -> list[Fit]:
    """Every model on some splits: baselines at one size, GP models at all sizes, smaller ones first."""
    fits = []
    for split in splits:
        for name in ("analytical", *sizes.networks):
            fits.append(fit_model(stages, task, name, split, sizes.baseline_points))
        large: dict[str, Fit] = {}
        for points in sizes.sizes:
            models = (*GP_MODELS, *PAPER_KERNELS) if points <= sizes.paper_kernels_up_to else GP_MODELS
            for name in models:
                fit = fit_model(stages, task, name, split, points, large.get(name))
                fits.append(fit)
                if points >= LARGE:
                    large[name] = fit
    return fits


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
        simulations={str(task.seed): task.figures for task in tasks},
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
