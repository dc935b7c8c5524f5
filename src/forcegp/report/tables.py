"""The tables of the page and of `docs/results.md`, as rows of text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from forcegp.report.data import GP_MODELS, PAPER_KERNELS, SPLITS, PaperNumbers, Results, Score
from forcegp.report.style import label

NONE = "–"
MEGABYTE = 1e6


@dataclass(frozen=True)
class Table:
    """A table as text.

    Attributes:
        caption: what it holds.
        head: names of the columns, the first naming the rows.
        rows: one list of cells a row.
    """

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def number(values: Sequence[float | int | None], digits: int = 3) -> str:
    """The mean of values over seeds, with half their range where there are several."""
    known = [float(v) for v in values if v is not None]
    if not known:
        return NONE
    mean = sum(known) / len(known)
    text = f"{mean:.{digits}f}" if 1e-3 <= abs(mean) < 1e4 or mean == 0.0 else f"{mean:.1e}"
    spread = (max(known) - min(known)) / 2.0
    if len(known) == 1 or not 1e-3 <= abs(mean) < 1e4:
        return text
    return f"{text} ± {spread:.{digits}f}"


def pick(results: Results, model: str, split: str, points: int) -> list[Score]:
    """The scores of one model, split and number of training points, one a seed."""
    return [s for s in results.scores if (s.model, s.split, s.points) == (model, split, points)]


def largest(results: Results, model: str) -> int:
    """Most training points of a model."""
    return max(s.points for s in results.scores if s.model == model)


def models_of(results: Results) -> list[str]:
    """The models that were scored, in order."""
    return list(dict.fromkeys(s.model for s in results.scores))


def error_table(results: Results, paper: PaperNumbers) -> Table:
    """Errors of every model with its most training points, on both splits, beside the paper's."""
    rows = []
    for model in models_of(results):
        points = largest(results, model)
        cells = [
            number([measure(s) for s in pick(results, model, split, points)], 4)
            for split in SPLITS
            for measure in (_noisy, _clean)
        ]
        rows.append((label(model), str(points), *cells, paper_value(paper, model, points)))
    head = (
        "model",
        "N",
        "noisy, held out",
        "clean, held out",
        "noisy, paper's split",
        "clean, paper's split",
        "noisy, paper",
    )
    return Table("Mean absolute error of predicted accelerations [rad/s²]", head, tuple(rows))


def paper_value(paper: PaperNumbers, model: str, points: int) -> str:
    """The paper's error for a model, where it gives one for so many points."""
    if model not in paper.noisy_mae or points not in paper.points:
        return NONE
    return f"{paper.noisy_mae[model][paper.points.index(points)]:g}"


def quality_table(results: Results) -> Table:
    """Coverage, density, constraint residual and cost of every model on held-out stretches."""
    measures: tuple[Callable[[Score], float | None], ...] = (
        lambda s: s.coverage_noisy,
        lambda s: s.coverage_clean,
        lambda s: s.nlpd,
        lambda s: s.residual,
    )
    rows = []
    for model in models_of(results):
        points = largest(results, model)
        scores = pick(results, model, "stretches", points)
        cells = [number([measure(s) for s in scores]) for measure in measures]
        cost = [
            number([s.fit_seconds for s in scores], 1),
            number([1e3 * s.predict_seconds / s.test_samples for s in scores], 2),
            number([None if s.peak_memory is None else s.peak_memory / MEGABYTE for s in scores], 0),
        ]
        rows.append((label(model), str(points), *cells, *cost))
    head = (
        "model",
        "N",
        "±2 std holds noisy",
        "±2 std holds clean",
        "NLPD",
        "mean |A q̈ − b| [m/s²]",
        "fit [s]",
        "predict [ms/sample]",
        "peak memory [MB]",
    )
    return Table("Uncertainty, constraint and cost, held-out stretches", head, tuple(rows))


def curve_table(results: Results, paper: PaperNumbers, kind: str) -> Table:
    """Error over training points: ours on both splits, and the paper's for noisy accelerations."""
    measure = _noisy if kind == "noisy" else _clean
    sizes = sorted({s.points for s in results.scores if s.model in GP_MODELS})
    models = [m for m in (*GP_MODELS, *PAPER_KERNELS) if m in models_of(results)]
    rows = []
    for model in models:
        for split in SPLITS:
            values = [number([measure(s) for s in pick(results, model, split, n)], 4) for n in sizes]
            rows.append((f"{label(model)}, {SPLITS[split]}", *values))
        if kind == "noisy" and model in paper.noisy_mae:
            rows.append((f"{label(model)}, paper", *(paper_value(paper, model, n) for n in sizes)))
    caption = f"Mean absolute error against {kind} accelerations over training points [rad/s²]"
    return Table(caption, ("N", *(str(n) for n in sizes)), tuple(rows))


def residual_table(results: Results, paper: PaperNumbers) -> Table:
    """Constraint residual at the fewest and most training points, beside the paper's."""
    rows = []
    for model in (m for m in GP_MODELS if m in models_of(results)):
        sizes = sorted({s.points for s in results.scores if s.model == model})
        ours = [
            number([s.residual for s in pick(results, model, "stretches", n)]) for n in (sizes[0], sizes[-1])
        ]
        theirs = [f"{v:.0e}" for v in paper.residual.get(model, ())] or [NONE, NONE]
        rows.append((label(model), f"{sizes[0]}, {sizes[-1]}", " to ".join(ours), " to ".join(theirs)))
    return Table(
        "Mean |A q̈ − b| of the predicted mean [m/s²], held-out stretches",
        ("model", "N", "ours", f"paper, N = {paper.points[0]} to {paper.points[-1]}"),
        tuple(rows),
    )


def simulation_table(results: Results) -> Table:
    """Figures on each simulated run, with the comparison of the physics engine and our equations."""
    seeds = list(results.simulations)
    names = list(dict.fromkeys(name for run in results.simulations.values() for name in run))
    rows = [
        (name.replace("_", " "), *(_cell(results.simulations[s].get(name)) for s in seeds)) for name in names
    ]
    return Table("The simulated runs", ("figure", *(f"seed {s}" for s in seeds)), tuple(rows))


def settings_table(results: Results) -> Table:
    """Settings and versions."""
    rows = [(name.replace("_", " "), value) for name, value in results.settings.items()]
    rows += [("seeds", ", ".join(str(s) for s in results.seeds))]
    rows += [(f"version of {name}", value) for name, value in results.versions.items()]
    rows += [("computer", results.machine), ("computing time", f"{results.seconds:.0f} s")]
    return Table("Settings, seeds and versions", ("setting", "value"), tuple(rows))


def _cell(value: float | int | str | None) -> str:
    return f"{value:.4g}" if isinstance(value, float) else NONE if value is None else str(value)


def _noisy(score: Score) -> float | None:
    return score.noisy_mae


def _clean(score: Score) -> float | None:
    return score.clean_mae
