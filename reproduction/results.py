"""All results of a reproduction and of the paper, and lookup of scores."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from forcegp.errors import DataError
from forcegp.files import Header, Record

GP_MODELS = ("gp", "sgp-zero", "sgp-mean", "sgp-contact")
PAPER_KERNELS = {"sgp-zero": "sgp-zero-se", "sgp-mean": "sgp-mean-se", "sgp-contact": "sgp-contact-se"}
"""Structured models with only the paper's kernel, for tables and learning curves but not plots over time."""
SPLITS = {"stretches": "held-out stretches", "selection": "paper's split"}
"""The two ways of choosing test samples, and their labels."""


class Score(Record):
    """Scores of a fitted model on a set of test samples.

    Attributes:
        model, points, split, seed: identify the fit.
        noisy_mae, clean_mae: mean absolute error against noisy and noise-free accelerations [rad/s²].
        coverage_noisy, coverage_clean: ±2σ coverage.
        nlpd: mean negative log predictive density of a measured joint acceleration [nats].
        residual: mean |A q̈ − b| of the predicted mean [m/s²].
        test_samples: number of predicted samples.
        fit_seconds, predict_seconds: time taken; predictions include their uncertainty if there is one.
        peak_memory: largest memory of the process during the fit [byte], `None` if it cannot be read.
        evaluations: number of evaluations of the objective.
        converged: whether the optimiser reached its tolerance.
    """

    model: str
    points: int
    split: str
    seed: int
    noisy_mae: float
    clean_mae: float | None
    coverage_noisy: float | None
    coverage_clean: float | None
    nlpd: float | None
    residual: float | None
    test_samples: int
    fit_seconds: float
    predict_seconds: float
    peak_memory: int | None
    evaluations: int
    converged: bool


class Results(Header):
    """All results of a reproduction, the source of the tables on the page and in `results.md`.

    Attributes:
        profile: name of the profile.
        seeds: seeds of the simulations.
        main_points: training points of the plots over time.
        noise_std: standard deviation of the acceleration noise [rad/s²].
        settings: settings of the profile, by name.
        versions: versions of the libraries, by name.
        machine: description of the computer.
        seconds: computing time of all stages.
        simulations: statistics of each simulated run, by seed.
        scores: one score per fit and split.
    """

    FORMAT: ClassVar[str] = "forcegp-results"
    VERSION: ClassVar[int] = 1

    profile: str
    seeds: list[int]
    main_points: int
    noise_std: float
    settings: dict[str, str]
    versions: dict[str, str]
    machine: str
    seconds: float
    simulations: dict[str, dict[str, float | int | str]]
    scores: list[Score]

    @property
    def exact(self) -> bool:
        """Whether the Gaussian processes follow the paper's settings wherever it states them."""
        return self.settings.get("exact") == "True"

    @property
    def models(self) -> list[str]:
        """The models that were scored, in order."""
        return list(dict.fromkeys(s.model for s in self.scores))

    def sizes(self, model: str) -> list[int]:
        """Return the numbers of training points of a model, ascending."""
        return sorted({s.points for s in self.scores if s.model == model})

    def values(self, model: str, split: str, points: int, measure: str) -> list[float]:
        """Return a measure (a field of `Score`) of a model, split and size, one value per available seed."""
        own = [s for s in self.scores if (s.model, s.split, s.points) == (model, split, points)]
        return [float(v) for s in own if (v := getattr(s, measure)) is not None]

    def mean(self, model: str, split: str, points: int | None, measure: str) -> float | None:
        """Return the mean of `values` over seeds, by default at the largest size; `None` without values."""
        if points is None:
            points = max(self.sizes(model), default=0)
        values = self.values(model, split, points, measure)
        return sum(values) / len(values) if values else None


def like(results: Results, model: str) -> str:
    """Return the model to compare with the paper's: the one with the paper's kernel, if it was fitted."""
    own = PAPER_KERNELS.get(model, model)
    return own if own in results.models else model


class PaperNumbers(Header):
    """Results reported in the paper.

    Attributes:
        source: source of the numbers.
        points: training points of the curves.
        noisy_mae: error by model over `points` [rad/s²].
        residual: mean |A q̈ − b| by model, at the fewest and the most points [m/s²].
    """

    FORMAT: ClassVar[str] = "forcegp-paper"
    VERSION: ClassVar[int] = 1

    source: str
    points: list[int]
    noisy_mae: dict[str, list[float]]
    residual: dict[str, tuple[float, float]]

    def error(self, model: str, points: int) -> float | None:
        """Return the paper's error of a model at a size [rad/s²], if it reports one."""
        known = model in self.noisy_mae and points in self.points
        return self.noisy_mae[model][self.points.index(points)] if known else None

    def beside(self, results: Results, model: str) -> str | None:
        """Return the paper's model to compare a model with, if there is one."""
        return next((name for name in self.noisy_mae if like(results, name) == model), None)


def paper_numbers() -> PaperNumbers:
    """Return the numbers of the paper."""
    text = (Path(__file__).parent / "paper.json").read_text(encoding="utf-8")
    return PaperNumbers.from_json(text, "paper.json", DataError)
