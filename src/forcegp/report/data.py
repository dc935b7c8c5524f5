"""What the figures and tables are drawn from: one versioned JSON format each, numbers in SI units."""

from __future__ import annotations

from importlib.resources import files
from typing import ClassVar

import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor

from forcegp.errors import DataError
from forcegp.files import Header

Series = list[float]
DIGITS = 7
"""Significant digits kept in series that are only drawn."""
GP_MODELS = ("gp", "sgp-zero", "sgp-mean", "sgp-contact")
PAPER_KERNELS = ("sgp-zero-se", "sgp-mean-se", "sgp-contact-se")
"""The paper's structured models with its kernel alone: in tables, not in figures."""
SPLITS = {"stretches": "held-out stretches", "selection": "paper's split"}
"""The two ways of choosing test samples, by name, and what they are called."""


def series(values: Tensor) -> Series:
    """A tensor `(n,)` as numbers for a file, rounded to what a figure can show."""
    return [float(f"{value:.{DIGITS}g}") for value in values.detach().cpu().tolist()]


def columns(values: Tensor) -> list[Series]:
    """A tensor `(n, d)` as d series."""
    return [series(column) for column in values.unbind(-1)]


def matrix(values: Tensor) -> list[Series]:
    """A tensor `(n, d)` as n rows."""
    return [series(row) for row in values.unbind(0)]


class Part(BaseModel):
    """A part of a result file: frozen, no unknown field, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class WindowData(Header):
    """Predictions of one model over a window of time (figures 4 and 5).

    Attributes:
        model: registry name.
        noise_std: of the measured accelerations [rad/s²], where known.
        t: [s].
        joint_names: one a series.
        measured, clean, mean, std: accelerations by joint [rad/s²]; `clean` and `std` may be unknown.
    """

    FORMAT: ClassVar[str] = "forcegp-window"
    VERSION: ClassVar[int] = 1

    model: str
    noise_std: float | None
    t: Series
    joint_names: list[str]
    measured: list[Series]
    clean: list[Series] | None
    mean: list[Series]
    std: list[Series] | None


class TaskSpaceData(Header):
    """Planned and executed motion of the tool (figure 3), each by axis: [m], [m/s], [m/s²]."""

    FORMAT: ClassVar[str] = "forcegp-task-space"
    VERSION: ClassVar[int] = 1

    t: Series
    planned_position: list[Series]
    planned_velocity: list[Series]
    planned_acceleration: list[Series]
    position: list[Series]
    velocity: list[Series]
    acceleration: list[Series]
    waypoints: list[Series]


class MultiplierBand(Part):
    """The multiplier as one model predicts it.

    Attributes:
        model: registry name.
        training_points: accelerations it is conditioned on.
        mean, std: [N].
        inside: share of samples where the simulator's value lies within two standard deviations.
        inside_held_out: the same, over held-out samples alone; `None` where there are none.
        mean_error: mean absolute error [N].
        smallest: the least predicted mean [N].
    """

    model: str
    training_points: int
    mean: Series
    std: Series
    inside: float
    inside_held_out: float | None
    mean_error: float
    smallest: float


class MultiplierData(Header):
    """Constraint error in simulation and the predicted multiplier (figure 2).

    Attributes:
        t: [s].
        c: constraint error [m].
        simulated: the simulator's multiplier [N].
        held_out: times between which no training point was chosen.
        bands: one a model.
    """

    FORMAT: ClassVar[str] = "forcegp-multiplier"
    VERSION: ClassVar[int] = 1

    t: Series
    c: Series
    simulated: Series
    held_out: list[tuple[float, float]]
    bands: list[MultiplierBand]


class CovarianceData(Header):
    """Blocks of the structured covariance H k_Q Hᵀ at some states (figure 1).

    Attributes:
        model: whose learned force prior it is.
        t: times of the states [s].
        nq: number of joints.
        operators: H of each state, `nq × nq` each.
        force: k_Q, `(n nq) × (n nq)`.
        acceleration: H k_Q Hᵀ, of the same size.
        rank: of the acceleration covariance.
    """

    FORMAT: ClassVar[str] = "forcegp-covariance"
    VERSION: ClassVar[int] = 1

    model: str
    t: Series
    nq: int
    operators: list[list[Series]]
    force: list[Series]
    acceleration: list[Series]
    rank: int


class Score(Part):
    """How one fitted model does on one set of test samples.

    Attributes:
        model, points, split, seed: which fit it is.
        noisy_mae, clean_mae: mean absolute error against noisy and noise-free accelerations [rad/s²].
        coverage_noisy, coverage_clean: share within two standard deviations.
        nlpd: mean negative log predictive density of a measured joint acceleration [nats].
        residual: mean |A q̈ − b| of the predicted mean [m/s²].
        test_samples: how many were predicted.
        fit_seconds, predict_seconds: time taken; prediction with its uncertainty where there is one.
        peak_memory: largest memory of the process while fitting [byte], `None` where it cannot be read.
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


class IdentificationRun(Part):
    """Analytical parameters over the iterations of one model.

    Attributes:
        model: name of the model.
        seed: of the data.
        mass: of the last link [kg].
        offset: error of the last joint's position, by axis [m].
    """

    model: str
    seed: int
    mass: Series
    offset: list[Series]


class IdentificationData(Header):
    """Mass and offset identified alongside the unknown friction.

    Attributes:
        true_mass: [kg].
        points: training points.
        runs: one a model and seed.
    """

    FORMAT: ClassVar[str] = "forcegp-identification"
    VERSION: ClassVar[int] = 1

    true_mass: float
    points: int
    runs: list[IdentificationRun]


class Results(Header):
    """Every number of a reproduction, from which the page's tables and `docs/results.md` are made.

    Attributes:
        profile: name of the profile.
        seeds: of the simulations.
        main_points: training points of the window and multiplier figures.
        noise_std: on the accelerations [rad/s²].
        settings: of the profile, by name.
        versions: of the libraries, by name.
        machine: a line on the computer.
        seconds: computing time of all stages.
        simulations: figures on each simulated run, by seed.
        scores: one a fit and split.
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


class PaperNumbers(Header):
    """What the paper reports, with its source.

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


def paper_numbers() -> PaperNumbers:
    """The numbers of the paper that come with the library."""
    text = (files("forcegp.report") / "paper.json").read_text(encoding="utf-8")
    return PaperNumbers.from_json(text, "paper.json", DataError)


def as_tensor(values: list[Series]) -> Tensor:
    """Series `(d, n)` as a tensor."""
    return torch.tensor(values, dtype=torch.float64)
