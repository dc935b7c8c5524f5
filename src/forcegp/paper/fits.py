"""Fitted models and their scores: one stage per fit, one stage per score."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from forcegp.errors import DataError
from forcegp.evaluation import evaluate
from forcegp.files import Header, write_text
from forcegp.forces.priors.default import PAPER
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.gp.optimise import LearningOptions
from forcegp.models.base import Model
from forcegp.models.independent_gp import IndependentGP
from forcegp.models.load import load_model
from forcegp.models.neural import NeuralNetwork
from forcegp.models.registry import create
from forcegp.models.structured_gp import StructuredGP
from forcegp.paper.memory import peak_memory, reset_peak
from forcegp.paper.profiles import Profile
from forcegp.paper.results import Score
from forcegp.paper.stages import Advance, Stage, Stages
from forcegp.paper.task import Task

MODEL, FIT, SCORE = "model", "fit.json", "score.json"


NETWORKS = {"nn-30-20": (30, 20), "nn-200x4": (200, 200, 200, 200)}
"""Hidden layers of the paper's other networks."""
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


class FitRecord(Header):
    """How a fit went; time in seconds, memory in bytes."""

    FORMAT: ClassVar[str] = "forcegp-fit"
    VERSION: ClassVar[int] = 1

    seconds: float
    evaluations: int
    converged: bool
    objective: float
    log_marginal_likelihood: float | None
    jitter: float
    message: str
    peak_memory: int | None


@dataclass(frozen=True)
class Fit:
    """A model that has been fitted.

    Attributes:
        name: of the model.
        points: training points.
        split: where the training points come from.
        task: the simulated run.
        stage: its folder.
    """

    name: str
    points: int
    split: str
    task: Task
    stage: Stage

    def load(self) -> Model:
        """The model from its files."""
        return load_model(self.stage / MODEL)

    def record(self) -> FitRecord:
        """How the fit went."""
        return FitRecord.from_json((self.stage / FIT).read_bytes(), str(self.stage / FIT), DataError)


def noise_std_of(task: Task) -> float:
    """The noise on the accelerations that models are given [rad/s²]."""
    noise = task.data.header.noise_std
    assert noise is not None
    return noise


def fit_model(
    stages: Stages,
    task: Task,
    name: str,
    split: str,
    points: int,
    before: Fit | None = None,
    *,
    exact: bool = False,
) -> Fit:
    """Fit a model to the first training points of a split, or use the result of an earlier run.

    Args:
        stages: where results are kept.
        task: the simulated run.
        name: of the model.
        split: where the training points come from.
        points: how many.
        before: the same model on fewer points, whose hyperparameters a structured GP starts from.
        exact: whether a Gaussian process is the paper's in every respect that it states.
    """
    exact = exact and name in EXACT_MODELS
    begins = [] if before is None else [before.stage]
    stage = stages.run(
        f"fit/seed-{task.seed}/{split}/{name}-{points}",
        lambda folder, advance: _fit(task, name, split, points, before, exact, folder, advance),
        settings={
            "model": name,
            "points": points,
            "noise_std": noise_std_of(task),
            "seed": task.seed,
            **({"learning": asdict(EXACT_LEARNING)} if exact else {}),
        },
        inputs=[task.simulated, task.selected, *begins],
    )
    return Fit(name, points, split, task, stage)


def _fit(
    task: Task,
    name: str,
    split: str,
    points: int,
    before: Fit | None,
    exact: bool,
    folder: Path,
    advance: Advance,
) -> None:
    model = exact_model(name, task) if exact else make_model(name, task)
    settings: dict[str, Any] = {"options": EXACT_LEARNING} if exact else {}
    resettable = reset_peak()
    data, progress = task.train(split, points), fit_progress(advance)
    smaller = None if before is None else before.load()
    if isinstance(model, StructuredGP) and isinstance(smaller, StructuredGP):
        result = model.fit(data, after=smaller, progress=progress, **settings)
    else:
        result = model.fit(data, progress=progress, **settings)
    model.save(folder / MODEL)
    names = FitRecord.model_fields.keys() - {"peak_memory"}
    taken = {name: getattr(result, name) for name in names}
    record = FitRecord(**taken, peak_memory=peak_memory() if resettable else None)
    write_text(folder / FIT, record.to_json())


def make_model(name: str, task: Task) -> Model:
    """An unfitted model by its registry name, or one of the paper's other networks."""
    if name in NETWORKS:
        return NeuralNetwork(task.system, NETWORKS[name], task.seed)
    return create(name, task.system, noise=noise_std_of(task), seed=task.seed)


def exact_model(name: str, task: Task) -> Model:
    """An unfitted model of the paper: squared exponential kernels alone (eq. 31), inputs in their units."""
    noise = noise_std_of(task)
    if name == "gp":
        return IndependentGP(task.system, noise, standardize=False)
    mean = {"sgp-zero": "zero", "sgp-mean": "analytical"}[name]
    return StructuredGP(
        task.system, mean, [JointForcePrior(PAPER)], noise, inference="exact", standardize=False
    )


def fit_progress(advance: Advance) -> Callable[[int, int, float], None]:
    """Shows a fit's progress on a bar, with the objective beside it."""

    def progress(evaluations: int, most: int, objective: float) -> None:
        advance(evaluations, most, f"objective {objective:.6g}")

    return progress


def score_fit(stages: Stages, profile: Profile, fit: Fit) -> Score:
    """The score of a fit on test samples of its split, or that of an earlier run."""
    stage = stages.run(
        f"score/seed-{fit.task.seed}/{fit.split}/{fit.name}-{fit.points}",
        lambda folder, _: _score(profile, fit, folder),
        settings={"test_samples": profile.test_samples},
        inputs=[fit.stage],
    )
    return Score.model_validate_json((stage / SCORE).read_bytes())


def _score(profile: Profile, fit: Fit, folder: Path) -> None:
    model, test = fit.load(), fit.task.test(fit.split, profile.test_samples)
    found, record = evaluate(model, test, compare=False), fit.record()
    measured = ("noisy_mae", "clean_mae", "coverage_noisy", "coverage_clean", "nlpd", "residual")
    score = Score(
        model=fit.name,
        points=fit.points,
        split=fit.split,
        seed=fit.task.seed,
        **{name: getattr(found, name) for name in measured},
        test_samples=found.samples,
        fit_seconds=record.seconds,
        predict_seconds=found.seconds_per_state * found.samples,
        peak_memory=record.peak_memory,
        evaluations=record.evaluations,
        converged=record.converged,
    )
    write_text(folder / SCORE, score.model_dump_json(indent=2))
