"""Error and constraint residual against the number of training points; parameters over iterations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from forcegp.report.data import GP_MODELS, SPLITS, IdentificationData, PaperNumbers, Results, Score
from forcegp.report.style import AXES, INK, MARKERS, Picture, colour, draw, label

WIDTH = 4.6
MASS_RANGE = 1.0
"""How far from the truth a mass is shown [kg]: first steps of the optimiser go further."""
FLOOR = (2.0 / torch.pi) ** 0.5
"""Mean magnitude of standard normal noise: no model's error against noisy accelerations is smaller."""

Measure = Callable[[Score], float | None]


def mean_over_seeds(
    scores: Sequence[Score], model: str, split: str, measure: Measure
) -> tuple[list[int], list[list[float]]]:
    """The training points of a model's fits, and a measure at each, one value a seed."""
    own = [s for s in scores if s.model == model and s.split == split and measure(s) is not None]
    points = sorted({s.points for s in own})
    return points, [[v for s in own if s.points == n and (v := measure(s)) is not None] for n in points]


def draw_learning_curve(results: Results, paper: PaperNumbers, split: str, kind: str) -> Picture:
    """Error against training points.

    Args:
        results: the scores.
        paper: the paper's curves, drawn dashed where they are comparable.
        split: a name of `SPLITS`.
        kind: `"noisy"` or `"clean"`, the accelerations compared with.
    """
    measure: Measure = (lambda s: s.noisy_mae) if kind == "noisy" else (lambda s: s.clean_mae)
    compared = kind == "noisy" and split == "selection"

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        _curves(axes, results, split, measure)
        if compared:
            for model, values in paper.noisy_mae.items():
                axes.plot(paper.points, values, color=colour(model), linestyle=(0, (2, 1.5)), linewidth=1.0)
            axes.plot([], [], color=INK, linestyle=(0, (2, 1.5)), linewidth=1.0, label="paper")
        if kind == "noisy":
            floor = FLOOR * results.noise_std
            axes.axhline(floor, color=INK, linewidth=0.8, linestyle=":", label="noise alone")
        _finish(axes, f"error against {kind} acceleration [rad/s²]")
        figure.legend(loc="outside upper center", ncols=2)

    alt = (
        f"Mean absolute error against {kind} accelerations over the number of training points, "
        f"{SPLITS[split]}: " + _ends(results, split, measure)
    )
    return draw(paint, (WIDTH, 4.1), alt, f"{SPLITS[split].capitalize()}, {kind} accelerations")


def draw_residual(results: Results, paper: PaperNumbers, split: str) -> Picture:
    """Mean |A q̈ − b| of the predicted accelerations against training points."""

    def measure(score: Score) -> float | None:
        return score.residual

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        _curves(axes, results, split, measure)
        for model, values in paper.residual.items():
            ends = [paper.points[0], paper.points[-1]]
            axes.plot(ends, values, color=colour(model), linestyle=(0, (2, 1.5)), linewidth=1.0)
        axes.plot([], [], color=INK, linestyle=(0, (2, 1.5)), linewidth=1.0, label="paper")
        _finish(axes, "mean |A q̈ − b| [m/s²]")
        figure.legend(loc="outside upper center", ncols=2)

    alt = "Mean constraint residual over the number of training points: " + _ends(results, split, measure)
    return draw(paint, (WIDTH, 3.6), alt, "Constraint residual")


def draw_identification(data: IdentificationData) -> list[Picture]:
    """The last link's mass and the error of the last joint's offset over iterations."""
    names = list(dict.fromkeys(run.model for run in data.runs))

    def paint_mass(figure: Figure) -> None:
        axes = figure.subplots()
        axes.axhline(data.true_mass, color=INK, linewidth=0.9, linestyle=":", label="true")
        for run in data.runs:
            axes.plot(run.mass, color=colour(run.model), label=label(run.model))
        axes.set_xlabel("evaluation")
        axes.set_ylabel("mass of the last link [kg]")
        axes.set_ylim(data.true_mass - MASS_RANGE, data.true_mass + MASS_RANGE)
        _legend(figure, axes, columns=2)

    def paint_offset(figure: Figure) -> None:
        rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(rows, names, strict=True):
            for run in (r for r in data.runs if r.model == name):
                for axis, letter in enumerate("xyz"):
                    error = [1e3 * abs(v) for v in run.offset[axis]]
                    axes.plot(error, color=AXES[axis], label=letter)
            axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=":")
            axes.set_yscale("log")
            axes.set_title(label(name), loc="left")
            axes.set_ylabel("|error| [mm]")
        rows[-1].set_xlabel("evaluation")
        _legend(figure, rows[0])

    ends = "; ".join(f"{label(run.model)} {run.mass[-1]:.3f} kg" for run in data.runs)
    errors = "; ".join(
        f"{label(run.model)} {1e3 * max(abs(o[-1]) for o in run.offset):.2g} mm" for run in data.runs
    )
    return [
        draw(
            paint_mass,
            (WIDTH, 4.1),
            f"Mass over evaluations, true {data.true_mass:g} kg; last: {ends}.",
            "Mass",
        ),
        draw(
            paint_offset, (WIDTH, 4.1), f"Error of the offset by axis; largest at last: {errors}.", "Offset"
        ),
    ]


def _curves(axes: Axes, results: Results, split: str, measure: Measure) -> None:
    for model in GP_MODELS:
        points, values = mean_over_seeds(results.scores, model, split, measure)
        if not points:
            continue
        middle = [sum(v) / len(v) for v in values]
        axes.plot(
            points, middle, color=colour(model), marker=MARKERS[model], markersize=4.0, label=label(model)
        )
        if any(len(v) > 1 for v in values):
            axes.fill_between(
                points, [min(v) for v in values], [max(v) for v in values], color=colour(model), alpha=0.2,
                linewidth=0,
            )  # fmt: skip


def _finish(axes: Axes, name: str) -> None:
    axes.set_yscale("log")
    axes.set_xlabel("training points N")
    axes.set_ylabel(name)
    low, high = axes.get_ylim()
    if high / low < 1e3:
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())


def _ends(results: Results, split: str, measure: Measure) -> str:
    """The last point of every curve, in words."""
    words = []
    for model in GP_MODELS:
        points, values = mean_over_seeds(results.scores, model, split, measure)
        if points:
            words.append(f"{label(model)} {sum(values[-1]) / len(values[-1]):.2g} at N = {points[-1]}")
    return "; ".join(words) + "."


def _legend(figure: Figure, axes: Axes, columns: int = 3) -> None:
    handles, names = axes.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside upper center", ncols=min(columns, len(unique)))
