"""Fits of several models to several robots with several seeds, run on a Dask cluster.

Each fit is a task that writes a folder, so an interrupted sweep resumes with the missing fits.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import torch

from forcegp.cluster import cluster, on_cluster
from forcegp.data import split_by_stretches
from forcegp.data.selection import complement
from forcegp.evaluation import evaluate
from forcegp.files import write_json, written_folder
from forcegp.models.configured import configured
from forcegp.scene import load_scene
from forcegp.simulate import simulate

SCORE, MODEL = "score.json", "model"


@dataclass(frozen=True)
class SweptFit:
    """A fit in a sweep, defined by a scene with a simulated motion, a model, and a seed.

    `duration` is the simulated time [s]; if it is `None`, the duration in the scene is used.
    """

    scene: str
    model: str
    seed: int
    duration: float | None = None

    @property
    def name(self) -> str:
        """Name of the folder for the fit."""
        return f"{Path(self.scene).stem}/{self.model}/seed-{self.seed}"


def fits_of(
    scenes: Sequence[str], models: Sequence[str], seeds: Sequence[int], duration: float | None = None
) -> list[SweptFit]:
    """Return one fit for each combination of the given models, robots and seeds.

    Example:
        >>> [fit.name for fit in fits_of(["kuka_plane"], ["sgp-mean", "gp"], [0])]
        ['kuka_plane/sgp-mean/seed-0', 'kuka_plane/gp/seed-0']
    """
    return [SweptFit(*chosen, duration) for chosen in product(scenes, models, seeds)]


def run_fit(fit: SweptFit, out: str) -> dict[str, Any]:
    """Run a fit on one thread and return its scores, or return the scores saved by an earlier run."""
    folder = Path(out) / fit.name
    if (folder / SCORE).is_file():
        return json.loads((folder / SCORE).read_text(encoding="utf-8"))
    torch.set_num_threads(1)
    scene = load_scene(fit.scene)
    system, config = scene.system(), replace(scene.simulation, seed=fit.seed)
    if fit.duration is not None:
        config = replace(config, duration=fit.duration)
    data = simulate(system, config).data
    split = split_by_stretches(data, 1, seed=fit.seed)
    model = configured(scene.model, system, name=fit.model, seed=fit.seed)
    fitted = model.fit(data[complement(split.test, len(data))])
    scores = evaluate(fitted, data[split.test], compare=False).summary()
    score = {
        **asdict(fit),
        **{name: scores[name] for name in ("noisy_mae", "clean_mae", "coverage_noisy")},
        "samples": fitted.result.samples,
        "seconds": fitted.result.seconds,
        "converged": fitted.result.converged,
    }
    with written_folder(folder) as temporary:
        fitted.save(temporary / MODEL)
        write_json(temporary / SCORE, score)
    return score


def sweep(
    fits: Sequence[SweptFit],
    out: str | Path,
    *,
    processes: int = 2,
    address: str | None = None,
    say: Callable[[int, dict[str, Any]], None] = lambda _, __: None,
) -> list[dict[str, Any]]:
    """Run fits on a Dask cluster, either a new one on this machine or an existing one.

    Args:
        fits: the fits to run.
        out: folder for the fits, accessible to all workers.
        processes: number of single-threaded workers on this machine.
        address: address of the scheduler of a running cluster, such as `tcp://host:8786`.
        say: function called with the number of finished fits and the score of the last one.

    Returns:
        The scores in the order of the fits.
    """
    scores = list[dict[str, Any]]()
    with cluster(processes, address) as client:
        for score in on_cluster(client, partial(run_fit, out=str(Path(out).resolve())), fits):
            scores.append(score)
            say(len(scores), score)
    return scores
