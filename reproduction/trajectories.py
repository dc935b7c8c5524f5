"""Open-loop trajectories (section 4) of every model, from states of a motion not used for training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch

from forcegp import report
from forcegp.data import Dataset
from forcegp.models.load import load_model
from forcegp.rollout import compare
from reproduction.fits import MODEL
from reproduction.stages import write_data
from reproduction.statements import Statement
from reproduction.task import LOG, Task

OTHER_MOTION = 1000
"""Offset from the task's seed for the motion that is not used for training."""
BAND_SECONDS = 2.0
"""Maximum duration of function samples [s]; each requires another trajectory from every start."""
CALIBRATION_STARTS = 2
"""Number of calibration trajectories per test trajectory, as far as the stretches suffice."""
HORIZON = 1.0
"""Time at which tip errors are compared [s]."""
FIFTH = 0.2
"""Fraction of the other models' tip error that the S-GP with analytical mean should stay below."""
HELD = (0.80, 0.97)
"""Coverage of 90 % bands that counts as calibrated."""
OURS = "sgp-mean"


def make_rollouts(
    folder: Path,
    unseen: Path,
    run: Path,
    rows: Path,
    fit: Path,
    *,
    model: str,
    seconds: float,
    starts: int,
    samples: int,
    stretch: float,
) -> None:
    """Write trajectories of one model: means over the whole time, bands over the first part of it.

    Args:
        folder: output folder.
        unseen: a run with other waypoints, long enough for trajectories that do not overlap.
        run, rows: the task.
        fit: the fitted model.
        model: name of the model.
        seconds: length of the trajectories.
        starts: number of initial states.
        samples: number of function samples for the bands.
        stretch: duration of the held-out stretches that bands are calibrated on [s].
    """
    models, task, data = {model: load_model(fit / MODEL)}, Task.read(run, rows), Dataset.read(unseen / LOG)
    found = report.rollout_data(compare(models, data, seconds, starts, system=task.system))
    if models[model].has_function_samples:
        seconds = min(BAND_SECONDS, seconds)
        bands = compare(models, data, seconds, starts, samples, system=task.system)
        seconds = min(seconds, stretch)
        chosen = _calibration_starts(task, seconds, CALIBRATION_STARTS * starts)
        calibration = compare(models, task.data, seconds, chosen, samples, system=task.system)
        found = with_bands(found, report.rollout_data(bands, calibration))
    write_data(folder, found)


def _calibration_starts(task: Task, seconds: float, most: int) -> torch.Tensor:
    """Return starts in held-out stretches, spread over the log and the phases of a line of the motion."""
    stretches, dt = task.stretches(), task.data.header.dt
    assert dt is not None
    chosen = torch.linspace(0, len(stretches) - 1, min(most, len(stretches))).round().long().tolist()
    rows = []
    for i, k in enumerate(chosen):
        first, end = stretches[k]
        spare = max(0, end - first - 1 - round(seconds / dt))
        # Golden-ratio sequence: phases spread over [0, 1) without following the order of the stretches.
        rows.append(first + round(spare * ((0.5 + i * 0.6180339887498949) % 1.0)))
    return torch.tensor(rows)


def with_bands(paths: report.RolloutData, bands: report.RolloutData) -> report.RolloutData:
    """Combine trajectories of mean functions with the bands of another comparison of the same models.

    Bands cost one trajectory per sample, so they may cover fewer starts and a shorter time.

    Args:
        paths: tip errors, drift and multiplier over the whole time.
        bands: bands of the models that have function samples, from the same first start.
    """
    sampled = {band.model: band for band in bands.models}
    models = [_with_bands(p, sampled[p.model]) if p.model in sampled else p for p in paths.models]
    seconds = {"band_starts": bands.starts, "band_seconds": bands.band_seconds}
    return paths.model_copy(update={"models": models, **seconds})


def together(parts: Sequence[report.RolloutData]) -> report.RolloutData:
    """Combine the trajectories of several models from separate comparisons on the same log.

    Args:
            parts: one or more comparisons from the same starts.
    """
    # Models without function samples have no bands, whose duration is then that of the trajectories.
    whole = min(parts, key=lambda part: part.band_seconds)
    models = [model for part in parts for model in part.models]
    films = [parts[0].films[0], *(film for part in parts for film in part.films[1:])]
    return whole.model_copy(update={"models": models, "films": films})


def _with_bands(path: report.ModelPath, band: report.ModelPath) -> report.ModelPath:
    drifts = [x.worst_drift for x in (path, band) if x.worst_drift is not None]
    times = [x.diverged_at for x in (path, band) if x.diverged_at is not None]
    names = ("tip_bands", "multiplier_band", "lost", "coverage", "inflation", "calibrated_coverage")
    worst = {"worst_drift": max(drifts, default=None), "diverged_at": min(times, default=None)}
    return path.model_copy(update={name: getattr(band, name) for name in names} | worst)


def tip_error(data: report.RolloutData) -> Statement | None:
    """Return a comparison of S-GP with analytical mean and models without learned forces after one second."""
    if HORIZON not in data.horizons:
        return None
    at = data.horizons.index(HORIZON)
    errors = {p.model: math.inf if (e := p.errors[at]) is None else e for p in data.models}
    others = {m: e for m, e in errors.items() if not m.startswith("sgp")}
    if OURS not in errors or not others:
        return None
    ours = errors[OURS]
    ratios = {m: ours / e if math.isfinite(ours) else math.inf for m, e in others.items()}
    listed = "; ".join(
        f"{report.label(m)} {_millimetres(e)}, ratio {ratios[m]:.2g}" for m, e in others.items()
    )
    structured = (m for m in errors if m.startswith("sgp") and m != OURS)
    beside = "".join(f"; {report.label(m)} {_millimetres(errors[m])}" for m in structured)
    text = (
        f"Open loop, median over {data.starts} starts, {HORIZON:g} s ahead: {report.label(OURS)} "
        f"{_millimetres(ours)} (target: at most a fifth of each of the following); {listed}{beside}."
    )
    return Statement("Tip error of trajectories", all(ratio <= FIFTH for ratio in ratios.values()), text)


def bands(data: report.RolloutData) -> Statement | None:
    """Return whether bands over function samples have the right coverage of the simulated motion."""
    sampled = [path for path in data.models if path.coverage is not None]
    if not sampled:
        return None
    calibrated = all(path.calibrated_coverage is not None for path in sampled)
    listed = []
    for path in sampled:
        text = f"{report.label(path.model)} {path.coverage:.3f}"
        if path.calibrated_coverage is not None:
            text += f", widened by {path.inflation:.2f} {path.calibrated_coverage:.3f}"
        listed.append(text)
    shares = {p.model: p.calibrated_coverage if calibrated else p.coverage for p in sampled}
    outside = [report.label(m) for m, s in shares.items() if s is None or not HELD[0] <= s <= HELD[1]]
    text = (
        f"Share of simulated tip positions inside the {data.level:.0%} bands over function samples, "
        f"{data.band_starts} starts, {data.band_seconds:.3g} s (target: {HELD[0]:.2f} to {HELD[1]:.2f}), "
        + ("as drawn and widened by calibration on held-out stretches: " if calibrated else "")
        + "; ".join(listed)
        + (f"; outside: {', '.join(outside)}." if outside else ".")
    )
    return Statement("Bands of trajectories", not outside, text)


def _millimetres(error: float) -> str:
    return f"{1e3 * error:.3g} mm" if math.isfinite(error) else "diverged"
