"""Comparison of predicted trajectories with the logged one: data, plots, a table and an animation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from forcegp.files import Header, Record, write_text
from forcegp.report.animation import FRAMES_PER_SECOND, animation, animation_source, arm_points, rounded
from forcegp.report.page import (
    DASHES,
    INK,
    NONE,
    Picture,
    PictureBlock,
    Series,
    Table,
    colour,
    draw,
    label,
    line,
    render,
    series,
)
from forcegp.rollout.comparison import HORIZONS, LEVEL, Comparison
from forcegp.rollout.trajectory import Rollout


class Band(Record):
    """Lower and upper bounds of a central band over function samples."""

    lower: Series
    upper: Series


class ModelPath(Record):
    """First trajectory predicted by a model, up to the point where it diverges.

    Attributes:
        model: name of the model.
        tip: x, y and z coordinates of the tip [m].
        tip_bands: bands for x, y and z over function samples, empty if there are no samples.
        tip_error: distance from the logged tip, as the median over the starts [m].
        drift: constraint error c(q) [m], empty if there are no contacts.
        multiplier: λ [N], empty if the model does not predict forces.
        multiplier_band: band for λ over function samples.
        lost: fraction of samples that have lost contact by each time, empty if there are no samples.
        errors: median tip error after each horizon over the starts [m], or `None` if more than half diverged.
        coverage: fraction of logged tip coordinates within the bands, or `None` if there are no samples.
        inflation: factor that widens the bands, calibrated on a different motion, or `None`.
        calibrated_coverage: coverage of the bands widened by this factor.
        worst_drift: largest constraint error of the mean and the samples over all starts [m].
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
    """Points of an arm in an animation, flattened from (frames, points, 3) [m]. `label` names the model."""

    label: str
    points: Series


class RolloutData(Header):
    """Open-loop trajectories compared with the logged one.

    Attributes:
        t: time since the start [s].
        tip, multiplier: logged x, y, z of the tip [m], and λ of the first contact [N], empty if not logged.
        starts: number of starts over which medians are taken.
        band_starts, band_seconds, level: number of starts, duration and nominal coverage of the bands.
        horizons: times at which `ModelPath.errors` are given [s].
        models: the trajectory of each model.
        frame_times, bodies, films: animation times [s], points per arm, and the arms (the logged arm first).
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
    """Return the data to plot, with curves from the first start, and bands widened using `calibration`."""
    horizons = [h for h in HORIZONS if h <= float(comparison.t[-1]) * (1.0 + 1e-9)]
    stride = max(1, round(1.0 / (FRAMES_PER_SECOND * float(comparison.t[1] - comparison.t[0]))))
    tip = comparison.frame, comparison.point
    joints = arm_points(comparison.system.robot, comparison.q[0, ::stride], *tip)
    films = [Film(label="logged", points=rounded(joints))]
    for name, rolled in comparison.predicted.items():
        points = arm_points(rolled.system.robot, rolled.q[0, : _sound(rolled.q[0]) : stride], *tip)
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


def _bands(rolled: Rollout, values: Tensor, n: int) -> list[Band]:
    """Return a band for each component of samples `(S, T, d)`, over the first n times or up to divergence."""
    band = rolled.bands(values[:, :n], LEVEL)
    last = _sound(band.lower)
    pairs = zip(band.lower[:last].T, band.upper[:last].T, strict=True)
    return [Band(lower=series(low), upper=series(high)) for low, high in pairs]


def _sound(q: Tensor) -> int:
    """Return the number of time steps at which the state `(T, nq)` is finite."""
    return int(torch.isfinite(q).all(-1).sum())


def _animation(data: RolloutData) -> Markup:
    """Return an animation of the logged and predicted arms."""
    films = [
        {
            "label": film.label if film.label == "logged" else label(film.label),
            "colour": INK if film.label == "logged" else colour(film.label),
            "dash": [3.0 * length for length in DASHES.get(film.label, ())],
            "points": film.points,
        }
        for film in data.films
    ]
    content = {"times": data.frame_times, "bodies": data.bodies, "films": films}
    return animation(content, "The arm in motion: logged in black, predicted in colour")


WIDTH = 4.6
PAGE, DATA = "rollout.html", "rollout.json"


def draw_tip(data: RolloutData) -> Picture:
    """Plot the logged and predicted position of the tip along each axis, for the duration of the bands."""

    def paint(figure: Figure) -> None:
        for axis, axes in enumerate(figure.subplots(3, 1, sharex=True)):
            for path in data.models:
                _curve(axes, data, path, path.tip[axis], path.tip_bands[axis] if path.tip_bands else None)
            axes.plot(data.t, data.tip[axis], color=INK, linestyle=(0, (4, 1.5)), label="logged")
            span = max(data.tip[axis]) - min(data.tip[axis])
            middle = 0.5 * (max(data.tip[axis]) + min(data.tip[axis]))
            axes.set_ylim(middle - max(span, 0.02), middle + max(span, 0.02))
            axes.set_ylabel(f"{'xyz'[axis]} [m]")
            axes.set_xlim(0.0, data.band_seconds)
        figure.axes[-1].set_xlabel("time [s]")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)

    alt = f"Tip position over {data.band_seconds:.3g} s by axis, logged, and predicted by each model."
    return draw(paint, (WIDTH, 5.0), alt, "Position of the tip")


def _draw_logarithmic(
    data: RolloutData, curves: list[tuple[ModelPath, Series]], least: float, name: str, alt: str, title: str
) -> Picture:
    """Plot magnitudes on a logarithmic scale, omitting the first magnitude, which is zero."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for path, values in curves:
            _curve(axes, data, path, [math.nan, *(max(abs(value), least) for value in values[1:])])
        axes.set_yscale("log")
        axes.set_xlabel("time [s]")
        axes.set_ylabel(name)
        axes.margins(x=0.0)
        figure.legend(loc="outside upper center", ncols=2)

    return draw(paint, (WIDTH, 3.0), alt, title)


def draw_contact_force(data: RolloutData) -> Picture:
    """Plot the multiplier and its band along predicted trajectories, and the probability of lost contact."""
    paths = [path for path in data.models if path.multiplier]
    losing = [path for path in paths if any(path.lost)]

    def paint(figure: Figure) -> None:
        panels = figure.subplots(2 if losing else 1, 1, sharex=True, squeeze=False)[:, 0]
        for path in paths:
            _curve(panels[0], data, path, path.multiplier, path.multiplier_band)
        if data.multiplier:
            panels[0].plot(data.t, data.multiplier, color=INK, linestyle=(0, (4, 1.5)), label="logged")
            top = max(data.multiplier)
            panels[0].set_ylim(min(0.0, min(data.multiplier)) - 0.2 * top, 1.6 * top)
        panels[0].set_ylabel("multiplier λ [N]")
        for path in losing:
            _curve(panels[1], data, path, path.lost)
            panels[1].set_ylabel("P(contact lost)")
            panels[1].set_ylim(-0.03, 1.03)
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(0.0, data.band_seconds)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)

    alt = "Multiplier along the predicted trajectories, with bands over samples, and logged multiplier."
    return draw(paint, (WIDTH, 3.8 if losing else 2.8), alt, "Contact force over time")


def _curve(axes: Axes, data: RolloutData, path: ModelPath, values: Series, band: Band | None = None) -> None:
    """Draw the values of a model and their band over time, in the style of the model."""
    style = {"color": colour(path.model), "linestyle": line(path.model)}
    if band is not None:
        t = data.t[: len(band.lower)]
        axes.fill_between(t, band.lower, band.upper, color=style["color"], alpha=0.25, linewidth=0)
    axes.plot(data.t[: len(values)], values, label=label(path.model), **style)


def _starts(number: int) -> str:
    return f"{number} start" + "s" * (number != 1)


def rollout_pictures(data: RolloutData) -> tuple[Picture, ...]:
    """Return all plots of the section for which data exist."""
    log = "logarithmic scale, one curve per model."
    errors = [(path, path.tip_error) for path in data.models]
    alt = f"Tip error over time, median over {_starts(data.starts)}, {log}"
    picture = _draw_logarithmic(data, errors, 1e-9, "tip error [m]", alt, "Tip error over time")
    pictures = [draw_tip(data), picture]
    if drifts := [(path, path.drift) for path in data.models if path.drift]:
        alt = f"Distance of the predicted tip from the surface over time, {log}"
        pictures += [_draw_logarithmic(data, drifts, 1e-16, "|c(q)| [m]", alt, "Drift off the surface")]
    pictures += [draw_contact_force(data)] if any(path.multiplier for path in data.models) else []
    return tuple(pictures)


def rollout_table(data: RolloutData) -> Table:
    """Return a table of the tip errors at the horizons, the coverage of the bands and the largest drift."""
    after = (f"after {h:g} s [mm]" for h in data.horizons)
    head = ("model", *after, "in band", "in calibrated band", "largest |c(q)| [m]")
    rows = []
    for path in data.models:
        errors = ["diverged" if e is None else f"{1e3 * e:.3g}" for e in path.errors]
        coverage = NONE if path.coverage is None else f"{path.coverage:.3f}"
        calibrated = path.calibrated_coverage
        widened = NONE if calibrated is None else f"{calibrated:.3f} (× {path.inflation:.2f})"
        drift = NONE if path.worst_drift is None else f"{path.worst_drift:.1e}"
        rows.append((label(path.model), *errors, coverage, widened, drift))
    caption = f"Tip error in open loop (median over {_starts(data.starts)})"
    if any(path.coverage is not None for path in data.models):
        caption += (
            f"; fraction of logged tip positions inside the {data.level:.0%} bands over function samples "
            f"({_starts(data.band_starts)}, {data.band_seconds:.3g} s), and inside the bands widened by the "
            "factor calibrated on held-out blocks of the training run"
        )
    return Table(caption, head, tuple(rows))


@dataclass(frozen=True)
class RolloutSection:
    """Plots, table and animation of trajectories. `script` is the hash of the script (`animation_source`)."""

    block: PictureBlock
    table: Table
    animation: Markup
    script: str


def rollout_section(data: RolloutData, source: str = DATA) -> RolloutSection:
    """Return the section on trajectories. `source` names the data file next to the page."""
    band = f" with the band that contains {data.level:.0%} of the function samples"
    sampled = any(path.tip_bands for path in data.models)
    why = " The curve follows the mean force. It may leave the band, since motion is nonlinear in the force."
    caption = (
        f"Open-loop prediction over {data.t[-1]:.3g} s from a logged state under the logged torques: "
        f"logged in black, predicted in colour{band if sampled else ''}. Position and contact force are "
        f"shown for the first {data.band_seconds:.3g} s. Errors are medians over {_starts(data.starts)}. A "
        f"curve ends where its prediction diverged.{why if sampled else ''}"
    )
    block = PictureBlock("Trajectories predicted in open loop", caption, rollout_pictures(data), source)
    return RolloutSection(block, rollout_table(data), _animation(data), animation_source())


def write_rollouts(folder: Path, title: str, data: RolloutData) -> Path:
    """Write the page on trajectories, its plots and their data to a folder, and return the page's path."""
    section = rollout_section(data)
    for i, picture in enumerate(section.block.pictures):
        write_text(folder / f"rollout-{i + 1}.svg", picture.svg)
    write_text(folder / DATA, data.to_json())
    write_text(folder / PAGE, render("rollout.html.j2", title=title, section=section))
    return folder / PAGE
