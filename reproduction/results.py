"""Every number of a reproduction, the paper's own numbers, and how scores are looked up."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from forcegp.errors import DataError
from forcegp.files import Header, Record

GP_MODELS = ("gp", "sgp-zero", "sgp-mean", "sgp-contact")
PAPER_KERNELS = {"sgp-zero": "sgp-zero-se", "sgp-mean": "sgp-mean-se", "sgp-contact": "sgp-contact-se"}
"""Each structured model with the paper's kernel alone: in tables and learning curves, not over time."""
SPLITS = {"stretches": "held-out stretches", "selection": "paper's split"}
"""The two ways of choosing test samples, and what they are called."""


class Score(Record):
    """How one fitted model does on one set of test samples.

    Attributes:
        model, points, split, seed: which fit it is.
        noisy_mae, clean_mae: mean absolute error against noisy and noise-free accelerations [rad/s²].
        coverage_noisy, coverage_clean: ±2σ coverage.
        nlpd: mean negative log predictive density of a measured joint acceleration [nats].
        residual: mean |A q̈ − b| of the predicted mean [m/s²].
        test_samples: how many were predicted.
        fit_seconds, predict_seconds: time taken; predictions include their uncertainty if there is one.
        peak_memory: largest memory of the process during the fit [byte], `None` if it cannot be read.
        evaluations: of the objective.
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
    """Every number of a reproduction, from which the tables of the page and of `results.md` are made.

    Attributes:
        profile: name of the profile.
        seeds: of the simulations.
        main_points: training points of the plots over time.
        noise_std: on the accelerations [rad/s²].
        settings: of the profile, by name.
        versions: of the libraries, by name.
        machine: one line on the computer.
        seconds: computing time of all stages.
        simulations: numbers on each simulated run, by seed.
        scores: one per fit and split.
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
        """Whether the Gaussian processes are the paper's in every respect that it states."""
        return self.settings.get("exact") == "True"

    @property
    def models(self) -> list[str]:
        """The models that were scored, in order."""
        return list(dict.fromkeys(s.model for s in self.scores))

    def sizes(self, model: str) -> list[int]:
        """The numbers of training points of a model, ascending."""
        return sorted({s.points for s in self.scores if s.model == model})

    def values(self, model: str, split: str, points: int, measure: str) -> list[float]:
        """A measure (a field of `Score`) of one model, split and size, one value per seed that has it."""
        own = [s for s in self.scores if (s.model, s.split, s.points) == (model, split, points)]
        return [float(v) for s in own if (v := getattr(s, measure)) is not None]

    def mean(self, model: str, split: str, points: int | None, measure: str) -> float | None:
        """The mean of `values` over seeds, at the largest size by default; `None` if there are none."""
        if points is None:
            points = max(self.sizes(model), default=0)
        values = self.values(model, split, points, measure)
        return sum(values) / len(values) if values else None


def like(results: Results, model: str) -> str:
    """Our model that compares with the paper's of that name: with the paper's kernel, if it was fitted."""
    own = PAPER_KERNELS.get(model, model)
    return own if own in results.models else model


class PaperNumbers(Header):
    """What the paper reports.

    Attributes:
        source: where the numbers come from.
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
        """The paper's error of a model at a size, if it gives one [rad/s²]."""
        known = model in self.noisy_mae and points in self.points
        return self.noisy_mae[model][self.points.index(points)] if known else None

    def beside(self, results: Results, model: str) -> str | None:
        """The paper's model that one of ours compares with, if there is one."""
        return next((name for name in self.noisy_mae if like(results, name) == model), None)


def paper_numbers() -> PaperNumbers:
    """The numbers of the paper."""
    text = (Path(__file__).parent / "paper.json").read_text(encoding="utf-8")
    return PaperNumbers.from_json(text, "paper.json", DataError)
