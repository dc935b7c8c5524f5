"""The page of a reproduction: every figure and table of the paper, ours beside theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from forcegp.files import write_text
from forcegp.report.covariance import draw_force_prior, draw_operators, draw_structured
from forcegp.report.curves import MASS_RANGE, draw_identification, draw_learning_curve, draw_residual
from forcegp.report.data import (
    SPLITS,
    CovarianceData,
    IdentificationData,
    MultiplierData,
    Results,
    TaskSpaceData,
    WindowData,
    paper_numbers,
)
from forcegp.report.findings import findings
from forcegp.report.html import FigureBlock, render
from forcegp.report.motion import draw_constraint, draw_multiplier, draw_path, draw_task_space
from forcegp.report.predictions import common_limit, draw_errors, draw_predictions
from forcegp.report.rollout_data import RolloutData
from forcegp.report.rollouts import rollout_section
from forcegp.report.tables import (
    Table,
    curve_table,
    error_table,
    quality_table,
    residual_table,
    settings_table,
    simulation_table,
)

ROLLOUTS = "stages/figures/rollouts/data.json"
"""Where a reproduction keeps the data of its trajectories."""


@dataclass(frozen=True)
class FigureData:
    """What the figures of a reproduction are drawn from."""

    covariance: CovarianceData
    multiplier: MultiplierData
    task_space: TaskSpaceData
    windows: list[WindowData]
    identification: IdentificationData
    rollouts: RolloutData


def write_page(path: Path, results: Results, figures: FigureData) -> None:
    """Write the page of a reproduction."""
    write_text(path, render_page(results, figures))


def render_page(results: Results, figures: FigureData) -> str:
    """The page of a reproduction as HTML."""
    paper = paper_numbers()
    tables: dict[str, Table] = {
        "errors": error_table(results, paper),
        "quality": quality_table(results),
        "noisy": curve_table(results, paper, "noisy"),
        "clean": curve_table(results, paper, "clean"),
        "residual": residual_table(results, paper),
        "simulation": simulation_table(results),
        "settings": settings_table(results),
    }
    return render(
        "report.html.j2",
        results=results,
        paper=paper,
        tables=tables,
        findings=findings(results, paper, figures.multiplier, figures.identification, figures.rollouts),
        learning=_learning(results),
        blocks=_figures(figures),
        trajectories=rollout_section(figures.rollouts, ROLLOUTS),
    )


def _learning(results: Results) -> FigureBlock:
    paper = paper_numbers()
    pictures = [
        draw_learning_curve(results, paper, split, kind) for kind in ("noisy", "clean") for split in SPLITS
    ]
    seeds = len(results.seeds)
    spread = f" Lines are means of {seeds} seeds, bands their range." if seeds > 1 else ""
    return FigureBlock(
        "Learning curves (main paper, error over N)",
        "Mean absolute error over the number of training points, and the mean constraint residual. "
        "Dashed: the paper's curves, read off its plots, where they compare: against noisy accelerations on "
        f"its own split, and for the residual. Dotted: the mean magnitude of the noise.{spread}",
        (*pictures, draw_residual(results, paper, "stretches")),
        "results.json",
    )


def _figures(data: FigureData) -> Sequence[FigureBlock]:
    return (
        _covariance(data.covariance),
        _multiplier(data.multiplier),
        _task_space(data.task_space),
        _predictions(data.windows),
        _errors(data.windows),
        _identification(data.identification),
    )


def _covariance(data: CovarianceData) -> FigureBlock:
    return FigureBlock(
        "Figure 1: structured covariance",
        f"H k_Q Hᵀ block by block, for {len(data.t)} training points, with the learned hyperparameters of "
        "the zero-mean S-GP. Left: the operators H(xᵢ), which the known mechanics gives. Middle: the prior "
        "on the forces, one independent process a joint, so every block is diagonal. Right: the covariance "
        "of accelerations, full in every block and without the direction that the surface forbids: rank "
        f"{data.rank} of {len(data.acceleration)}. Logarithmic shades.",
        (draw_operators(data), draw_force_prior(data), draw_structured(data)),
        "stages/figures/covariance/data.json",
    )


def _multiplier(data: MultiplierData) -> FigureBlock:
    return FigureBlock(
        "Figure 2: surface error and multiplier",
        "The error of the surface equation in simulation, and the Lagrange multiplier λ (the normal "
        "force) predicted from accelerations alone, beside the simulator's own. No training point "
        "lies in the shaded time. Below each: the same, less the simulator's value. Bands are two "
        "standard deviations.",
        (draw_constraint(data), *(draw_multiplier(data, band) for band in data.bands)),
        "stages/figures/multiplier/data.json",
    )


def _task_space(data: TaskSpaceData) -> FigureBlock:
    return FigureBlock(
        "Figure 3: task-space motion",
        "The tool runs straight lines between random points on the surface, with trapezoidal speed "
        "and at rest at every point; dashed as planned, wide as executed under torque control with "
        "contact and friction.",
        (draw_task_space(data), draw_path(data)),
        "stages/figures/task-space/data.json",
    )


def _predictions(windows: list[WindowData]) -> FigureBlock:
    seconds = f"{windows[0].t[-1] - windows[0].t[0]:.1f} s" if windows else ""
    return FigureBlock(
        "Figure 4: predictions",
        f"Accelerations of all joints over the same {seconds} of held-out motion, no training point "
        "within: noisy measurements in black, predicted mean in colour, with the band of two "
        "standard deviations where the model gives one.",
        tuple(draw_predictions(window) for window in windows),
        "stages/figures/window/",
    )


def _errors(windows: list[WindowData]) -> FigureBlock:
    limit = common_limit(windows)
    return FigureBlock(
        "Figure 5: errors of the predictions",
        "The same window less the predicted mean: noise-free acceleration in black, noisy in grey, "
        f"the model's band in colour. All models at the same scale of ±{limit:.2g} rad/s²; what is "
        "larger is cut off.",
        tuple(draw_errors(window, limit) for window in windows),
        "stages/figures/window/",
    )


def _identification(data: IdentificationData) -> FigureBlock:
    return FigureBlock(
        "Identification (main paper)",
        "Mass of the last link, started at 2.5 kg, and error of the last joint's position, started "
        f"0.05 m off along each axis, learned from {data.points} points together with "
        "the unknown friction; the analytical model alone, which has no room for the friction, "
        "beside them. At every evaluation the best parameters so far; of the mass, what is further than "
        f"{MASS_RANGE:g} kg from the truth is cut off. The dotted line marks 1 mm.",
        tuple(draw_identification(data)),
        "stages/figures/identification/",
    )
