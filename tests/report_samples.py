"""Small results with numbers chosen by hand, for the tests of plots, tables and pages."""

from __future__ import annotations

import dataclasses
import math

from forcegp.report.rollouts import Band, Film, ModelPath, RolloutData
from forcegp.report.window import WindowData
from reproduction.covariance import CovarianceData
from reproduction.identification import IdentificationData, IdentificationRun
from reproduction.multiplier import MultiplierBand, MultiplierData
from reproduction.page import FigureData
from reproduction.results import Results, Score
from reproduction.task_space import TaskSpaceData

T = [i / 240 for i in range(72)]
JOINTS = [f"joint_{i}" for i in range(1, 8)]
NOISY = {"gp": 0.25, "sgp-zero": 0.12, "sgp-mean": 0.09, "sgp-contact": 0.081}
MODELS = ("analytical", "nn", *NOISY)


def score(model: str, points: int, split: str, **changes: object) -> Score:
    """A score with plausible numbers."""
    noisy = NOISY.get(model, 1.0) * ((200 / points) ** 0.2 if model in NOISY else 1.0)
    values = {
        "noisy_mae": noisy,
        "clean_mae": noisy / 4,
        "coverage_noisy": 0.95 if model in NOISY else None,
        "coverage_clean": 0.93 if model in NOISY else None,
        "nlpd": -0.7 if model in NOISY else None,
        "residual": 0.1 if model in ("nn", "gp") else 2e-15,
        "test_samples": 100,
        "fit_seconds": 1.5,
        "predict_seconds": 0.2,
        "peak_memory": 500_000_000,
        "evaluations": 80,
        "converged": True,
        "seed": 0,
    }
    return Score(model=model, points=points, split=split, **(values | changes))


def results(scores: list[Score] | None = None) -> Results:
    """Results of one seed: baselines at 5000 points, GP models at 100 and 200."""
    made = [
        score(model, points, split)
        for split in ("stretches", "selection")
        for model in MODELS
        for points in ((100, 200) if model in NOISY else (5000,))
    ]
    return Results(
        profile="quick",
        seeds=[0],
        main_points=200,
        noise_std=0.1,
        settings={"duration": "60.0"},
        versions={"python": "3"},
        machine="a computer",
        seconds=12.0,
        simulations={"0": {"engine": "pybullet", "samples": 72, "constraint_error_m": 5.8e-5}},
        scores=made if scores is None else scores,
    )


def waves(n: int = 7, scale: float = 1.0) -> list[list[float]]:
    """A series for each joint."""
    return [[scale * math.sin(20 * t + i) for t in T] for i in range(n)]


def window(model: str = "sgp-mean", *, std: bool = True, clean: bool = True) -> WindowData:
    """Predictions that are off by a tenth of the signal."""
    return WindowData(
        model=model,
        noise_std=0.1,
        t=T,
        joint_names=JOINTS,
        measured=waves(scale=1.05),
        clean=waves() if clean else None,
        mean=waves(scale=0.9),
        std=[[0.1] * len(T)] * 7 if std else None,
    )


def band(model: str = "sgp-mean", **changes: object) -> MultiplierBand:
    """A predicted multiplier."""
    values = {
        "mean": [40.0 + math.sin(t) for t in T],
        "std": [0.5] * len(T),
        "inside": 0.96,
        "inside_held_out": 0.95,
        "mean_error": 0.1,
        "smallest": 40.0,
    }
    return MultiplierBand(model=model, **(values | changes))


def multiplier(*bands: MultiplierBand) -> MultiplierData:
    """A simulated multiplier with predictions."""
    return MultiplierData(
        t=T, c=[1e-5 * t for t in T], simulated=[40.0] * len(T), held_out=[(0.1, 0.2)],
        bands=list(bands or (band(),)),
    )  # fmt: skip


def identification(mass: float = 2.001, offset: float = 2e-4) -> IdentificationData:
    """Runs that end at the given errors."""
    runs = [
        IdentificationRun(model=model, seed=0, mass=[2.5, 2.2, mass], offset=[[0.05, 0.01, offset]] * 3)
        for model in ("analytical", "sgp-mean")
    ]
    return IdentificationData(true_mass=2.0, points=100, runs=runs)


def model_path(model: str, error: float | None, coverage: float | None = None) -> ModelPath:
    """A trajectory whose tip error after 0.5 and 1 s is given [m]; one without an error has diverged."""
    near = [Band(lower=[-0.1] * len(T), upper=[0.1] * len(T))]
    forces = coverage is not None
    return ModelPath(
        model=model,
        tip=waves(3, 0.1),
        tip_bands=near * 3 if forces else [],
        tip_error=[1e-3 * t for t in T],
        drift=[1e-5 * t for t in T],
        multiplier=[45.0] * len(T) if forces else [],
        multiplier_band=Band(lower=[44.0] * len(T), upper=[46.0] * len(T)) if forces else None,
        lost=[0.0] * len(T) if forces else [],
        errors=[0.001, error],
        coverage=coverage,
        worst_drift=1e-4,
        diverged_at=0.9 if error is None else None,
    )


def rollouts(*models: ModelPath) -> RolloutData:
    """Trajectories that bear the aims out unless models are given."""
    good = (
        model_path("analytical", 0.5),
        model_path("nn", None),
        model_path("gp", 0.3),
        model_path("sgp-zero", 0.2, 0.85),
        model_path("sgp-mean", 0.03, 0.9),
        model_path("sgp-contact", 0.004, 0.96),
    )
    shown = models or good
    return RolloutData(
        t=T,
        tip=waves(3, 0.1),
        multiplier=[45.0] * len(T),
        starts=4,
        band_starts=2,
        band_seconds=0.5,
        level=0.9,
        horizons=[0.5, 1.0],
        models=list(shown),
        frame_times=[0.0, 0.1],
        bodies=2,
        films=[
            Film(label=name, points=[0.0, 0.0, 0.0, 0.4, 0.1 * i, 0.5] * 2)
            for i, name in enumerate(("logged", *(path.model for path in shown)))
        ],
    )


def figures(**changes: object) -> FigureData:
    """The data of all figures, some of them changed."""
    eye = [[float(i == j) for j in range(14)] for i in range(14)]
    three = waves(3, 0.1)
    made = FigureData(
        covariance=CovarianceData(
            model="sgp-zero", t=[0.0, 0.1], nq=7, operators=[[row[:7] for row in eye[:7]]] * 2, force=eye,
            acceleration=eye, rank=12,
        ),
        multiplier=multiplier(),
        task_space=TaskSpaceData(
            t=T, planned_position=three, planned_velocity=three, planned_acceleration=three, position=three,
            velocity=three, acceleration=three, waypoints=[[0.4, 0.0, 0.05], [0.5, 0.1, 0.05]],
        ),
        windows=[window("nn", std=False), window("sgp-mean")],
        identification=identification(),
        rollouts=rollouts(),
    )  # fmt: skip
    return dataclasses.replace(made, **changes)  # pyright: ignore[reportArgumentType]
