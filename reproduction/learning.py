"""Learning curves (main paper, error over N): plots, tables and findings, compared with the paper's.

The paper's curves are compared with models that use only the paper's kernel; the default kernels define a
different model.
"""

from __future__ import annotations

from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from forcegp import report
from reproduction.results import GP_MODELS, PAPER_KERNELS, SPLITS, PaperNumbers, Results, like
from reproduction.statements import Statement, number

WIDTH = 4.6
MARKERS = {"analytical": "x", "nn": "v", "gp": "s", "sgp-zero": "o", "sgp-mean": "D", "sgp-contact": "^"}
FLOOR = (2.0 / torch.pi) ** 0.5
"""Mean magnitude of standard normal noise, a lower bound on the error against noisy accelerations."""
PAPER_LINE, KERNEL_LINE = (0, (2, 1.5)), (0, (6, 1.5))
UNKNOWN = "The paper does not fully state its task settings."
"""Part of every comparison with the paper, favourable or not."""
ERROR_WORDS = ("lower (task differs)", "higher (task differs)")
POINTS_WORDS = ("fewer (task differs)", "more (task differs)")
"""Verdicts of comparisons with the paper's errors and numbers of points: the task is not the same."""
WIDE = 5000
"""Number of training points from which the axis is logarithmic."""
TASK = (
    "The paper does not state its rectangle, travel times, pressing force or test window, so the two tasks "
    "are not identical: slower or smaller motion than the paper's lowers our errors, faster or wider "
    "motion raises them. Like is compared with like: the paper's curves with its own kernel, not with our "
    "default kernels."
)
"""Explanation of `UNKNOWN`, shown once on every page."""


EXACT = (
    "The Gaussian processes of this profile are the paper's: its kernel alone on inputs in their units, the "
    "marginal likelihood without priors on hyperparameters, ADAM with the learning rate 0.2. The paper does "
    "not state where learning starts or when it counts as converged; here length-scales start at the square "
    "root of the number of inputs, and learning stops after 50 evaluations without improvement, or 500."
)
"""Settings that the profile `paper-exact` takes from the paper, and those that it had to choose."""


def about_task(results: Results) -> str:
    """Return what is not known of the paper's task, and of its models where these are compared."""
    return f"{TASK} {EXACT}" if results.exact else TASK


def learning_block(results: Results, paper: PaperNumbers) -> report.PictureBlock:
    """Return the learning curves with their caption."""
    pictures = [
        draw_learning_curve(results, paper, split, kind) for kind in ("noisy", "clean") for split in SPLITS
    ]
    ours = "Solid: our default kernels. Long dashes: the paper's kernel alone."
    if results.exact:
        ours = "Solid: the paper's models, learned here."
    seeds = len(results.seeds)
    spread = f" Lines are means over {seeds} seeds, bands their range." if seeds > 1 else ""
    return report.PictureBlock(
        "Learning curves (main paper, error over N)",
        f"Mean absolute error over the number of training points, and the mean constraint residual. {ours} "
        "Short dashes: the paper's curves, read off its plots, where they are comparable: noisy "
        f"accelerations on its own split, and the residual. Dotted: the mean magnitude of the noise.{spread}",
        (*pictures, draw_residual(results, paper, "stretches")),
        "results.json",
    )


def draw_learning_curve(results: Results, paper: PaperNumbers, split: str, kind: str) -> report.Picture:
    """Return the error against training points.

    Args:
        results: the scores.
        paper: the paper's curves, drawn if they are comparable.
        split: a name of `SPLITS`.
        kind: `"noisy"` or `"clean"`, the accelerations compared with.
    """

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        _curves(axes, results, split, f"{kind}_mae")
        if kind == "noisy" and split == "selection":
            for model, values in paper.noisy_mae.items():
                axes.plot(
                    paper.points, values, color=report.colour(model), linestyle=PAPER_LINE, linewidth=1.0
                )
            axes.plot([], [], color=report.INK, linestyle=PAPER_LINE, linewidth=1.0, label="paper")
        if kind == "noisy":
            floor = FLOOR * results.noise_std
            axes.axhline(floor, color=report.INK, linewidth=0.8, linestyle=":", label="noise alone")
        _finish(figure, axes, f"error against {kind} acceleration [rad/s²]")

    alt = f"Mean absolute error against {kind} accelerations over training points, {SPLITS[split]}: "
    title = f"{SPLITS[split].capitalize()}, {kind} accelerations"
    return report.draw(paint, (WIDTH, 4.1), alt + _ends(results, split, f"{kind}_mae"), title)


def draw_residual(results: Results, paper: PaperNumbers, split: str) -> report.Picture:
    """Return the mean |A q̈ − b| of the predicted accelerations against training points."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        _curves(axes, results, split, "residual")
        for model, values in paper.residual.items():
            ends = [paper.points[0], paper.points[-1]]
            axes.plot(ends, values, color=report.colour(model), linestyle=PAPER_LINE, linewidth=1.0)
        axes.plot([], [], color=report.INK, linestyle=PAPER_LINE, linewidth=1.0, label="paper")
        _finish(figure, axes, "mean |A q̈ − b| [m/s²]")

    alt = "Mean constraint residual over the number of training points: " + _ends(results, split, "residual")
    return report.draw(paint, (WIDTH, 3.6), alt, "Constraint residual")


def _curves(axes: Axes, results: Results, split: str, measure: str) -> None:
    """Draw mean and range over seeds of every GP model, with the paper's kernel dashed in the same colour."""
    for model in GP_MODELS:
        style = {
            "color": report.colour(model),
            "marker": MARKERS[model],
            "markersize": 4.0,
            "label": report.label(model),
        }
        _curve(axes, results, model, split, measure, style)
        if model in PAPER_KERNELS:
            style = {"color": report.colour(model), "linestyle": KERNEL_LINE, "linewidth": 1.0}
            _curve(axes, results, PAPER_KERNELS[model], split, measure, style)
    if set(PAPER_KERNELS.values()) & set(results.models):
        axes.plot([], [], color=report.INK, linestyle=KERNEL_LINE, linewidth=1.0, label="paper's kernel")


def _curve(axes: Axes, results: Results, model: str, split: str, measure: str, style: dict[str, Any]) -> None:
    found = {n: v for n in results.sizes(model) if (v := results.values(model, split, n, measure))}
    if found:
        axes.plot(list(found), [sum(v) / len(v) for v in found.values()], **style)
    if any(len(v) > 1 for v in found.values()):
        low, high = ([pick(v) for v in found.values()] for pick in (min, max))
        axes.fill_between(list(found), low, high, color=style["color"], alpha=0.2, linewidth=0)


def _finish(figure: Figure, axes: Axes, name: str) -> None:
    axes.set_yscale("log")
    axes.set_xlabel("training points N")
    if axes.get_xlim()[1] > WIDE:
        axes.set_xscale("log")
    axes.set_ylabel(name)
    low, high = axes.get_ylim()
    if high / low < 1e3:
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    figure.legend(loc="outside upper center", ncols=2)


def _ends(results: Results, split: str, measure: str) -> str:
    """Return the last point of every curve, in words."""
    last = {m: (max(results.sizes(m), default=0), results.mean(m, split, None, measure)) for m in GP_MODELS}
    return (
        "; ".join(f"{report.label(m)} {v:.2g} at N = {n}" for m, (n, v) in last.items() if v is not None)
        + "."
    )


def curve_table(results: Results, paper: PaperNumbers, kind: str) -> report.Table:
    """Return the error over training points on both splits, with the paper's for noisy accelerations."""
    sizes = sorted({n for model in GP_MODELS for n in results.sizes(model)})
    rows = []
    for model in (m for m in (*GP_MODELS, *PAPER_KERNELS.values()) if m in results.models):
        for split in SPLITS:
            values = [number(results.values(model, split, n, f"{kind}_mae"), 4) for n in sizes]
            rows.append((f"{report.label(model)}, {SPLITS[split]}", *values))
        theirs = paper.beside(results, model) if kind == "noisy" else None
        if theirs is not None:
            rows.append((f"{report.label(theirs)}, paper", *(paper_value(paper, theirs, n) for n in sizes)))
    caption = f"Mean absolute error against {kind} accelerations over training points [rad/s²]"
    return report.Table(caption, ("N", *(str(n) for n in sizes)), tuple(rows))


def paper_value(paper: PaperNumbers, model: str | None, points: int) -> str:
    """Return the paper's error for a model, if it reports one for this number of points."""
    value = None if model is None else paper.error(model, points)
    return report.NONE if value is None else f"{value:g}"


def residual_table(results: Results, paper: PaperNumbers) -> report.Table:
    """Return the constraint residual at the fewest and most training points, with the paper's values."""
    rows = []
    for model in (m for m in GP_MODELS if m in results.models):
        ends = results.sizes(model)[0], results.sizes(model)[-1]
        ours = [number(results.values(model, "stretches", n, "residual")) for n in ends]
        theirs = [f"{v:.0e}" for v in paper.residual.get(model, ())] or [report.NONE, report.NONE]
        rows.append((report.label(model), f"{ends[0]}, {ends[1]}", " to ".join(ours), " to ".join(theirs)))
    return report.Table(
        "Mean |A q̈ − b| of the predicted mean [m/s²], held-out stretches",
        ("model", "N", "ours", f"paper, N = {paper.points[0]} to {paper.points[-1]}"),
        tuple(rows),
    )


def against_paper(results: Results, paper: PaperNumbers, model: str) -> Statement | None:
    """Return our error on the paper's split against the paper's at every N, with the paper's kernel first."""
    same = like(results, model)
    pairs = {
        n: (ours, theirs)
        for n in paper.points
        if (ours := results.mean(same, "selection", n, "noisy_mae")) and (theirs := paper.error(model, n))
    }
    if not pairs:
        return None
    above = [str(n) for n, (ours, theirs) in pairs.items() if ours > theirs]
    text = (
        f"Above the paper's error at N = {', '.join(above)}. "
        if above
        else "At or below the paper's error at every N. "
    )
    text += f"{report.label(same)}: " + "; ".join(
        f"N = {n}: {ours:.3f}, paper {theirs:g}" for n, (ours, theirs) in pairs.items()
    )
    if same != model:
        n, best = max(results.sizes(model)), results.mean(model, "selection", None, "noisy_mae")
        text += "" if best is None else f". With our default kernels {best:.3f} at N = {n}"
    return Statement(f"{report.label(model)} against the paper", not above, f"{text}. {UNKNOWN}", ERROR_WORDS)


def efficiency(results: Results, paper: PaperNumbers) -> Statement | None:
    """Return how many points the zero-mean structured model needs to reach the paper's best error."""
    target, words, reached = paper.noisy_mae["sgp-zero"][-1], [], []
    for model in (m for m in (PAPER_KERNELS["sgp-zero"], "sgp-zero") if m in results.models):
        sizes = results.sizes(model)
        errors = {n: results.mean(model, "selection", n, "noisy_mae") for n in sizes}
        least = [n for n, e in errors.items() if e is not None and e <= target]
        found = f"with N = {least[0]}" if least else f"with none of N = {', '.join(map(str, sizes))}"
        words.append(f"{report.label(model)} {found}")
        reached.append(bool(least) and least[0] <= paper.points[1])
    if not words:
        return None
    text = (
        f"Training points needed for the paper's error at N = {paper.points[-1]} ({target:g} rad/s²) on the "
        f"paper's split: {'; '.join(words)}. The lower bound of this metric is the mean magnitude of the "
        f"noise, {FLOOR * results.noise_std:.4f} rad/s²; close to it, only the error against noise-free "
        f"accelerations separates models. {UNKNOWN}"
    )
    return Statement("Points needed", reached[0], text, POINTS_WORDS)
