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
"""Hidden layer widths of the paper's other networks."""
LARGE = 400
"""Number of points from which a fit starts from the hyperparameters of the previous size."""
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
"""The paper's learning options; it states "until convergence", without initial values or a tolerance."""


@dataclass(frozen=True)
class Fit:
    """A model on the training points of a split.

    Attributes:
        name: name of the model.
        points: training points.
        split: name of the split.
        seed: seed for the simulated run.
        stage: the stage that fits and scores the model.
    """

    name: str
    points: int
    split: str
    seed: int
    stage: Stage

    def score(self) -> Score:
        """Return the its score on test samples of the split."""
        return Score.model_validate_json((self.stage.folder / SCORE).read_bytes())


def models_of(sizes: Profile, split: str) -> list[tuple[str, int]]:
    """Return the model name and number of points of every fit on a split, smaller fits of a model first."""
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
    """Return the fits of every model on a split, smaller ones first, each from `LARGE` on after the previous.

    Args:
        sizes: profile that selects the models.
        task: the two stages of the simulated run.
        split: name of the split.
        seed: seed for the run.
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
        folder: output folder.
        run, rows: the task.
        before: fit of the same model to fewer points, which provides initial hyperparameters.
        name: name of the model.
        split: name of the split.
        points: number of training points.
        exact: whether to follow the paper's settings wherever it states them.
        test_samples: maximum number of test samples.
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
    """Return an unfitted model by registry name, or one of the paper's other networks."""
    if name in NETWORKS:
        return NeuralNetwork(task.system, NETWORKS[name], task.seed)
    return create(name, task.system, noise=task.noise_std, seed=task.seed)


def exact_model(name: str, task: Task) -> Model:
    """Return the paper's unfitted model, with squared exponential kernels only (eq. 31) and raw inputs."""
    if name == "gp":
        return IndependentGP(task.system, task.noise_std, standardize=False)
    mean = {"sgp-zero": "zero", "sgp-mean": "analytical"}[name]
    priors = [JointForcePrior(PAPER, scaled=False)]
    return StructuredGP(task.system, mean, priors, task.noise_std, inference="exact")


def reset_peak() -> bool:
    """Forget the process's peak memory; false where the system cannot (man 5 proc)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def peak_memory() -> int:
    """Return the peak resident memory of the process since the last reset [byte]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
