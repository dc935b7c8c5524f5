"""Fitted models and their scores: one stage per fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forcegp.evaluation import evaluate
from forcegp.files import write_text
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.priors.sets import PAPER
from forcegp.gp.optimise import LearningOptions
from forcegp.models.base import Model
from forcegp.models.independent_gp import IndependentGP
from forcegp.models.load import load_model
from forcegp.models.neural import NeuralNetwork
from forcegp.models.registry import create
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from reproduction.profiles import Profile
from reproduction.results import GP_MODELS, PAPER_KERNELS, Score
from reproduction.stages import Stage
from reproduction.task import Task

MODEL, SCORE = "model", "score.json"
MEASURES = ("noisy_mae", "clean_mae", "coverage_noisy", "coverage_clean", "nlpd", "residual")
NETWORKS = {"nn-30-20": (30, 20), "nn-200x4": (200, 200, 200, 200)}
"""Hidden layers of the paper's other networks."""
LARGE = 400
"""From this many points on, the fit to the next size starts from the hyperparameters of the last."""
EXACT_MODELS = ("gp", "sgp-zero", "sgp-mean")
"""The paper's Gaussian processes."""
EXACT_LEARNING = LearningOptions(
    "adam",
    max_evaluations=500,
    learning_rate=0.2,
    analytical_learning_rate=0.2,
    warm_start=None,
    hyperpriors=False,
)
"""How the paper learns them; it says "until convergence", and states neither the start nor a tolerance."""


@dataclass(frozen=True)
class Fit:
    """A model on the training points of a split.

    Attributes:
        name: of the model.
        points: training points.
        split: where they come from.
        seed: of the simulated run.
        stage: fits and scores it.
    """

    name: str
    points: int
    split: str
    seed: int
    stage: Stage

    def score(self) -> Score:
        """Its score on test samples of the split."""
        return Score.model_validate_json((self.stage.folder / SCORE).read_bytes())


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


def fits_of(sizes: Profile, task: tuple[Stage, Stage], split: str, seed: int) -> list[Fit]:
    """Every model on a split, the smaller ones of each first; from `LARGE` on, each starts from the last.

    Args:
        sizes: which models.
        task: the two stages of the simulated run.
        split: where training and test samples come from.
        seed: of the run.
    """
    fits: list[Fit] = []
    for name, points in models_of(sizes, split):
        before = [fit.stage for fit in fits if fit.name == name and fit.points >= LARGE][-1:]
        settings = {
            "name": name,
            "split": split,
            "points": points,
            "exact": sizes.exact and name in EXACT_MODELS,
            "test_samples": sizes.test_samples,
        }
        path = f"fit/seed-{seed}/{split}/{name}-{points}"
        stage = Stage(task[0].root, path, fit_and_score, settings, (*task, *before))
        fits.append(Fit(name, points, split, seed, stage))
    names = list(dict.fromkeys(fit.name for fit in fits))
    return sorted(fits, key=lambda fit: names.index(fit.name))


def fit_and_score(
    folder: Path,
    run: Path,
    rows: Path,
    before: Path | None = None,
    *,
    name: str,
    split: str,
    points: int,
    exact: bool,
    test_samples: int,
) -> None:
    """Write a model fitted to the first training points of a split, and its score on the test samples.

    Args:
        folder: where they go.
        run, rows: the task.
        before: the same model on fewer points, whose hyperparameters a structured GP starts from.
        name: of the model.
        split: where the samples come from.
        points: number of training points.
        exact: whether a Gaussian process is the paper's in every respect that it states.
        test_samples: how many at most.
    """
    task = Task.read(run, rows)
    model = exact_model(name, task) if exact else make_model(name, task)
    options: dict[str, Any] = {"options": EXACT_LEARNING} if exact else {}
    smaller = None if before is None else load_model(before / MODEL)
    if isinstance(smaller, StructuredFit):
        options["after"] = smaller
    resettable = reset_peak()
    fit = model.fit(task.train(split, points), **options)
    peak = peak_memory() if resettable else None
    fit.save(folder / MODEL)
    found = evaluate(load_model(folder / MODEL), task.test(split, test_samples), compare=False)
    summary: dict[str, Any] = found.summary()
    score = Score(
        model=name,
        points=points,
        split=split,
        seed=task.seed,
        **{measure: summary[measure] for measure in MEASURES},
        test_samples=found.samples,
        fit_seconds=fit.result.seconds,
        predict_seconds=found.seconds_per_state * found.samples,
        peak_memory=peak,
        evaluations=fit.result.evaluations,
        converged=fit.result.converged,
    )
    write_text(folder / SCORE, score.model_dump_json(indent=2))


def make_model(name: str, task: Task) -> Model:
    """An unfitted model by its registry name, or one of the paper's other networks."""
    if name in NETWORKS:
        return NeuralNetwork(task.system, NETWORKS[name], task.seed)
    return create(name, task.system, noise=task.noise_std, seed=task.seed)


def exact_model(name: str, task: Task) -> Model:
    """An unfitted model of the paper: squared exponential kernels alone (eq. 31), inputs in their units."""
    if name == "gp":
        return IndependentGP(task.system, task.noise_std, standardize=False)
    mean = {"sgp-zero": "zero", "sgp-mean": "analytical"}[name]
    priors = [JointForcePrior(PAPER)]
    return StructuredGP(task.system, mean, priors, task.noise_std, inference="exact", standardize=False)


def reset_peak() -> bool:
    """Forget the process's peak memory; false where the system cannot (man 5 proc)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def peak_memory() -> int:
    """Peak resident memory of the process since the last reset [byte]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
