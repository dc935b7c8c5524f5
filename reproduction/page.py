"""The page of a reproduction and its `results.md`: all figures and tables, compared with the paper's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from forcegp import report
from reproduction import learning, scores
from reproduction.covariance import CovarianceData, covariance_block
from reproduction.identification import IdentificationData, identification_block, identification_finding
from reproduction.multiplier import MultiplierData, draw_multiplier, multiplier_block, multiplier_finding
from reproduction.results import PaperNumbers, Results, paper_numbers
from reproduction.statements import Statement, markdown
from reproduction.task_space import TaskSpaceData, task_space_block
from reproduction.trajectories import bands, tip_error

ROLLOUTS, WINDOWS = "stages/figures/rollouts/", "stages/figures/window/"
"""Folders for the data of trajectories and of figures 4 and 5."""
OPENING = "sgp-mean"
"""The model with the multiplier shown at the top of the page."""


@dataclasses.dataclass(frozen=True)
class FigureData:
    """Data of the figures of a reproduction."""

    covariance: CovarianceData
    multiplier: MultiplierData
    task_space: TaskSpaceData
    windows: list[report.WindowData]
    identification: IdentificationData
    rollouts: report.RolloutData


def common_limit(windows: Sequence[report.WindowData]) -> float:
    """Return an axis limit [rad/s²] that fits the noise and the errors of the better half of the models."""
    if not windows:
        return 0.5
    largest = sorted(float(window.error.abs().quantile(0.995)) for window in windows)
    return max(4.0 * (windows[0].noise_std or 0.0), 1.3 * largest[(len(largest) - 1) // 2])


def findings(results: Results, paper: PaperNumbers, figures: FigureData) -> list[Statement]:
    """Return all findings that can be derived from the results."""
    found = [learning.against_paper(results, paper, model) for model in paper.noisy_mae]
    found += [
        scores.order(results),
        learning.efficiency(results, paper),
        scores.splits(results),
        scores.calibration(results),
    ]
    found += [scores.constraint(results), multiplier_finding(figures.multiplier)]
    found += [identification_finding(figures.identification)]
    found += [tip_error(figures.rollouts), bands(figures.rollouts)]
    return [finding for finding in found if finding is not None]


def render_page(results: Results, figures: FigureData, view: str | None = None) -> str:
    """Return the page of a reproduction as HTML; `view` is the file with the motion in three dimensions."""
    paper = paper_numbers()
    return report.render(
        "page.html.j2",
        package="reproduction",
        results=results,
        paper=paper,
        view=view,
        task=learning.about_task(results),
        opening=_opening(results, paper, figures),
        tables=_tables(results, paper),
        findings=findings(results, paper, figures),
        learning=learning.learning_block(results, paper),
        blocks=(
            covariance_block(figures.covariance),
            multiplier_block(figures.multiplier),
            task_space_block(figures.task_space),
            *prediction_blocks(figures.windows),
            identification_block(figures.identification),
        ),
        trajectories=report.rollout_section(figures.rollouts, ROLLOUTS),
    )


def _opening(results: Results, paper: PaperNumbers, figures: FigureData) -> report.PictureBlock:
    """Return what the page shows first: how error falls with data, and the contact force with its band."""
    drawn = {"Error over training points": learning.draw_learning_curve(results, paper, "stretches", "clean")}
    band = next((b for b in figures.multiplier.bands if b.model == OPENING), None)
    if band is not None:
        drawn[f"Contact force ({report.label(OPENING)})"] = draw_multiplier(figures.multiplier, band)
    pictures = tuple(dataclasses.replace(picture, title=title) for title, picture in drawn.items())
    caption = (
        "Error of predicted accelerations on motion without training points, and the contact force predicted "
        "without a force sensor; the shaded time contains no training point."
    )
    return report.PictureBlock("In short", caption, pictures, "results.json")


def _tables(results: Results, paper: PaperNumbers) -> dict[str, report.Table]:
    return {
        "overview": scores.overview_table(results),
        "errors": scores.error_table(results, paper),
        "quality": scores.quality_table(results),
        "noisy": learning.curve_table(results, paper, "noisy"),
        "clean": learning.curve_table(results, paper, "clean"),
        "residual": learning.residual_table(results, paper),
        "simulation": simulation_table(results),
        "settings": settings_table(results),
    }


def prediction_blocks(
    windows: Sequence[report.WindowData],
) -> tuple[report.PictureBlock, report.PictureBlock]:
    """Return both figures with their captions."""
    seconds, limit = f"{windows[0].seconds:.1f} s" if windows else "", common_limit(windows)
    predictions = report.PictureBlock(
        "Figure 4: predictions",
        f"Accelerations of all joints over the same {seconds} of held-out motion without training points: "
        "noisy measurements in black, predicted mean in colour, with the ±2σ band of models that give one.",
        tuple(report.draw_predictions(window) for window in windows),
        WINDOWS,
    )
    errors = report.PictureBlock(
        "Figure 5: errors of the predictions",
        "The same window less the predicted mean: noise-free acceleration in black, noisy in grey, the "
        "model's "
        f"band in colour. All models at the same scale of ±{limit:.2g} rad/s²; larger values are cut off.",
        tuple(report.draw_errors(window, limit) for window in windows),
        WINDOWS,
    )
    return predictions, errors


def simulation_table(results: Results) -> report.Table:
    """Return statistics of each simulated run, including the comparison of engine and library."""
    seeds = list(results.simulations)
    names = dict.fromkeys(name for run in results.simulations.values() for name in run)
    runs = results.simulations.values()
    rows = [(name.replace("_", " "), *(report.cell(run.get(name)) for run in runs)) for name in names]
    return report.Table("The simulated runs", ("quantity", *(f"seed {s}" for s in seeds)), tuple(rows))


def settings_table(results: Results) -> report.Table:
    """Return the settings and versions."""
    rows = [(name.replace("_", " "), value) for name, value in results.settings.items()]
    rows += [("seeds", ", ".join(str(s) for s in results.seeds))]
    rows += [(f"version of {name}", value) for name, value in results.versions.items()]
    rows += [("computer", results.machine), ("computing time", f"{results.seconds:.0f} s")]
    return report.Table("Settings, seeds and versions", ("setting", "value"), tuple(rows))


def render_markdown(results: Results, figures: FigureData) -> str:
    """Return the results of a reproduction and those of the paper as Markdown."""
    paper = paper_numbers()
    tables = {name: markdown(table) for name, table in _tables(results, paper).items()}
    said = findings(results, paper, figures)
    parts = [
        "# Results",
        f"Written by `python -m reproduction --profile {results.profile}`; do not edit. {paper.source} "
        f"{learning.about_task(results)}",
        tables["overview"],
        "## Findings",
        "\n".join(f"- **{f.topic}**{'' if f.verdict is None else f': {f.verdict}'}. {f.text}" for f in said),
        "## Errors",
        *(tables[name] for name in ("errors", "noisy", "clean")),
        "## Uncertainty, constraint, cost",
        *(tables[name] for name in ("quality", "residual")),
        "## Trajectories",
        markdown(report.rollout_table(figures.rollouts)),
        "## Runs and settings",
        *(tables[name] for name in ("simulation", "settings")),
    ]
    return "\n\n".join(parts) + "\n"
