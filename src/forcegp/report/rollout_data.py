"""Data of the section on trajectories: what its plots, table and animation are drawn from."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from forcegp.files import Header, Record
from forcegp.report.animation import FRAMES_PER_SECOND, arm_points, rounded
from forcegp.report.html import Series, series
from forcegp.rollout.comparison import HORIZONS, LEVEL, Comparison


class Band(Record):
    """Bounds of a central band over function samples."""

    lower: Series
    upper: Series


class ModelPath(Record):
    """The first predicted trajectory of one model, up to where it diverged.

    Attributes:
        model: name.
        tip: x, y and z of the tip [m].
        tip_bands: of x, y and z over samples; empty without samples.
        tip_error: distance from the logged tip, median over the starts [m].
        drift: constraint error c(q) [m]; empty without contacts.
        multiplier: λ [N]; empty for models without forces.
        multiplier_band: over samples.
        lost: probability that contact was lost by then, over samples; empty without samples.
        errors: tip error after each horizon, median over the starts [m]; `None` if over half diverged.
        coverage: share of logged tip coordinates within the band; `None` without samples.
        inflation: factor on the band, calibrated on another motion; `None` without one.
        calibrated_coverage: coverage of the band widened by that factor.
        worst_drift: largest constraint error of mean and samples over all starts [m].
        diverged_at: time of the first divergence [s].
    """

    model: str
    tip: list[Series]
    tip_bands: list[Band]
    tip_error: Series
    drift: Series
    multiplier: Series
    multiplier_band: Band | None
    lost: Series
    errors: list[float | None]
    coverage: float | None
    inflation: float | None = None
    calibrated_coverage: float | None = None
    worst_drift: float | None
    diverged_at: float | None


class Film(Record):
    """Points of an arm for an animation: frames × points × 3, flat [m]; `label` names the model."""

    label: str
    points: Series


class RolloutData(Header):
    """Trajectories predicted in open loop beside the logged one.

    Attributes:
        t: time since the start [s].
        tip, multiplier: logged x, y, z of the tip [m]; λ of the first contact [N], empty if not logged.
        starts: number of starts of the medians.
        band_starts, band_seconds, level: starts, duration and nominal coverage of the bands.
        horizons: times of `ModelPath.errors` [s].
        models: one per model.
        frame_times, bodies, films: animation times [s], points of the arm, and arms, the logged one first.
    """

    FORMAT: ClassVar[str] = "forcegp-rollout"
    VERSION: ClassVar[int] = 3
    MAX_BYTES: ClassVar[int] = 1 << 24

    t: Series
    tip: list[Series]
    multiplier: Series
    starts: int
    band_starts: int
    band_seconds: float
    level: float
    horizons: Series
    models: list[ModelPath]
    frame_times: Series
    bodies: int
    films: list[Film]


def rollout_data(comparison: Comparison, calibration: Comparison | None = None) -> RolloutData:
    """The data of the section from a comparison; curves are those of its first start.

    Bands are calibrated on `calibration`, the same models on another motion.
    """
    horizons = [h for h in HORIZONS if h <= float(comparison.t[-1]) * (1.0 + 1e-9)]
    stride = max(1, round(1.0 / (FRAMES_PER_SECOND * float(comparison.t[1] - comparison.t[0]))))
    tip = comparison.frame, comparison.point
    joints = arm_points(comparison.system.robot, comparison.q[0, ::stride], *tip)
    films = [Film(label="logged", points=rounded(joints))]
    for name, rolled in comparison.predicted.items():
        sound = _sound(rolled.q[0])
        points = arm_points(rolled.system.robot, rolled.q[0, :sound:stride], *tip)
        films.append(Film(label=name, points=rounded(points)))
    logged = comparison.multiplier
    return RolloutData(
        t=series(comparison.t),
        tip=[series(x) for x in comparison.tip[0].T],
        multiplier=[] if logged is None else series(logged[0, :, 0]),
        starts=len(comparison.q),
        band_starts=len(comparison.q),
        band_seconds=float(comparison.t[-1]),
        level=LEVEL,
        horizons=horizons,
        models=[_model_path(comparison, name, horizons, calibration) for name in comparison.predicted],
        frame_times=series(comparison.t[::stride]),
        bodies=joints.shape[1],
        films=films,
    )


def _model_path(
    comparison: Comparison, name: str, horizons: list[float], calibration: Comparison | None
) -> ModelPath:
    rolled = comparison.predicted[name]
    n = _sound(rolled.q[0])
    samples, contacts = rolled.samples, rolled.system.m > 0
    multiplier = rolled.multiplier[0, :n, 0] if contacts else rolled.multiplier.new_zeros(0)
    has_multiplier = bool(torch.isfinite(multiplier).all()) and len(multiplier) > 0
    tip_error = comparison.tip_error(name).median(0).values
    errors = [comparison.error_at(name, horizon) for horizon in horizons]
    times = [d.t for d in (*rolled.diverged, *(samples.diverged if samples else ()))]
    factor = calibration.inflation(name) if samples and calibration else math.inf
    inflation = factor if math.isfinite(factor) else None
    drifts = [x.drift.nan_to_num(0.0).abs().max() for x in (rolled, samples) if x is not None and contacts]
    return ModelPath(
        model=name,
        tip=[series(x) for x in comparison.predicted_tip(name)[0, :n].T],
        tip_bands=[] if samples is None else _bands(rolled, comparison.sampled_tip(name)[:, 0], n),
        tip_error=series(tip_error[torch.isfinite(tip_error)]),
        drift=series(rolled.drift[0, :n, 0]) if contacts else [],
        multiplier=series(multiplier) if has_multiplier else [],
        multiplier_band=_bands(rolled, samples.multiplier[:, 0], n)[0] if samples and contacts else None,
        lost=series(rolled.contact_lost()[0, :n, 0]) if samples and contacts else [],
        errors=[e if math.isfinite(e) else None for e in errors],
        coverage=comparison.coverage(name) if samples else None,
        inflation=inflation,
        calibrated_coverage=None if inflation is None else comparison.coverage(name, inflation=inflation),
        worst_drift=float(torch.stack(drifts).max()) if drifts else None,
        diverged_at=min(times) if times else None,
    )


def _bands(rolled, values: Tensor, n: int) -> list[Band]:
    """Bands `(S, T, d)` of each component over the first n times, as far as any sample goes."""
    band = rolled.bands(values[:, :n], LEVEL)
    last = _sound(band.lower)
    pairs = zip(band.lower[:last].T, band.upper[:last].T, strict=True)
    return [Band(lower=series(low), upper=series(high)) for low, high in pairs]


def _sound(q: Tensor) -> int:
    """How many leading times `(T, nq)` hold a finite state."""
    return int(torch.isfinite(q).all(-1).sum())
