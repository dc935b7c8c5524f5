"""The stages of a reproduction as jobs for several processes.

Each job runs the same functions as a reproduction in one process, which afterwards finds their stages done.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from forcegp.paper import figures
from forcegp.paper.fits import EXACT_MODELS, Fit, fit_model, score_fit
from forcegp.paper.parallel import Job, run_jobs
from forcegp.paper.profiles import Profile
from forcegp.paper.results import GP_MODELS, PAPER_KERNELS, SPLITS
from forcegp.paper.stages import Progress, Stages
from forcegp.paper.task import Task, make_task
from forcegp.paper.trajectories import trajectories, unseen_motion

LARGE = 400
"""From this many points on, the fit to the next size starts from the hyperparameters of the last."""


def splits_of(sizes: Profile, run: int) -> list[str]:
    """The splits on which the models are fitted to a simulated run."""
    return list(SPLITS) if run < sizes.paper_split_seeds else ["stretches"]


def models_of(sizes: Profile, split: str) -> list[tuple[str, int]]:
    """Name and number of points of every fit on a split; of each model, smaller ones first."""
    baselines = split == "stretches" or sizes.paper_split_baselines
    found = [(name, sizes.baseline_points) for name in ("analytical", *sizes.networks) if baselines]
    for points in sizes.sizes:
        papers = PAPER_KERNELS.values() if points <= sizes.paper_kernels_up_to else ()
        names = EXACT_MODELS if sizes.exact else (*GP_MODELS, *papers)
        found += [(name, points) for name in names]
    if split == "stretches":
        structured = [name for name in GP_MODELS if name != "gp"]
        found += [(name, points) for points in sizes.sparse_sizes for name in structured]
    return found


def fits_of(
    stages: Stages, sizes: Profile, task: Task, split: str, name: str, most: int | None = None
) -> list[Fit]:
    """One model on a split, with up to `most` points; from `LARGE` on, each fit starts from the last."""
    fits: list[Fit] = []
    for _, points in (pair for pair in models_of(sizes, split) if pair[0] == name):
        if most is not None and points > most:
            break
        before = fits[-1] if fits and fits[-1].points >= LARGE else None
        fits.append(fit_model(stages, task, name, split, points, before, exact=sizes.exact))
    return fits


def run_ahead(
    root: Path, sizes: Profile, seed: int, processes: int, progress: Progress, say: Callable[[str], None]
) -> set[str]:
    """Run the stages of a reproduction in several processes.

    Args:
        root: folder of the stages.
        sizes: of the reproduction.
        seed: of its first simulated run.
        processes: how many run at the same time.
        progress: opens a progress bar, which counts jobs.
        say: called with one line for every stage that ends.

    Returns:
        Names of the stages that were run, rather than found done.
    """
    jobs, made = jobs_of(root, sizes, seed), set()
    with progress(f"{processes} processes", len(jobs)) as advance:
        for done, (name, lines) in enumerate(run_jobs(jobs, processes), 1):
            for stage, line in lines:
                made.add(stage)
                say(line)
            advance(done, len(jobs), name)
    return made


def jobs_of(root: Path, sizes: Profile, seed: int) -> list[Job]:
    """The jobs of a reproduction, the longest first where the order is free."""
    jobs, fits = [], []
    for run in range(sizes.seeds):
        jobs.append(Job(f"task {run}", _task, (root, sizes, seed, run)))
        for split in splits_of(sizes, run):
            for name, points in models_of(sizes, split):
                smaller = [n for m, n in models_of(sizes, split) if m == name and LARGE <= n < points]
                after = [f"task {run}", *(_fit_name(run, split, name, n) for n in smaller)]
                job = Job(
                    _fit_name(run, split, name, points),
                    _fit,
                    (root, sizes, seed, run, split, name, points),
                    after,
                )
                fits.append((points, job))
        jobs.append(Job(f"identification {run}", _identification, (root, sizes, seed, run), [f"task {run}"]))
    jobs.append(Job("unseen motion", _unseen_motion, (root, sizes, seed)))
    jobs += [job for _, job in sorted(fits, key=lambda pair: -pair[0])]
    shown = [_fit_name(0, "stretches", *pair) for pair in models_of(sizes, "stretches")]
    for name in dict.fromkeys(m for m, _ in models_of(sizes, "stretches")):
        if name not in PAPER_KERNELS.values():
            arguments = (root, sizes, seed, name)
            jobs.append(Job(f"rollouts {name}", _rollouts, arguments, ["unseen motion", *shown]))
    jobs.append(Job("figures", _figures, (root, sizes, seed), shown))
    return jobs


def _fit_name(run: int, split: str, name: str, points: int) -> str:
    return f"{split} {name} {points}, run {run}"


class _Said:
    """Stages of a job with the line that each says when it ends."""

    def __init__(self, root: Path) -> None:
        self.lines: list[tuple[str, str]] = []
        self.stages = Stages(root, say=lambda line: self.lines.append((line.rpartition(":")[0], line)))


def _task(root: Path, sizes: Profile, seed: int, run: int) -> list[tuple[str, str]]:
    said = _Said(root)
    make_task(said.stages, sizes, seed + run)
    return said.lines


def _fit(root: Path, sizes: Profile, seed: int, run: int, split: str, name: str, points: int) -> list:
    said = _Said(root)
    task = make_task(said.stages, sizes, seed + run)
    score_fit(said.stages, sizes, fits_of(said.stages, sizes, task, split, name, points)[-1])
    return said.lines


def _identification(root: Path, sizes: Profile, seed: int, run: int) -> list[tuple[str, str]]:
    said = _Said(root)
    figures.identification(said.stages, sizes, [make_task(said.stages, sizes, seed + run)])
    return said.lines


def _unseen_motion(root: Path, sizes: Profile, seed: int) -> list[tuple[str, str]]:
    said = _Said(root)
    unseen_motion(said.stages, sizes, seed)
    return said.lines


def _rollouts(root: Path, sizes: Profile, seed: int, name: str) -> list[tuple[str, str]]:
    said = _Said(root)
    task = make_task(said.stages, sizes, seed)
    trajectories(said.stages, sizes, task, _shown(said.stages, sizes, task), [name])
    return said.lines


def _figures(root: Path, sizes: Profile, seed: int) -> list[tuple[str, str]]:
    said = _Said(root)
    task = make_task(said.stages, sizes, seed)
    figures.of_fits(said.stages, sizes, task, _shown(said.stages, sizes, task))
    return said.lines


def _shown(stages: Stages, sizes: Profile, task: Task) -> list[Fit]:
    names = dict.fromkeys(name for name, _ in models_of(sizes, "stretches"))
    fits = [fit for name in names for fit in fits_of(stages, sizes, task, "stretches", name)]
    return figures.shown(sizes, fits)
