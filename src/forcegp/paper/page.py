"""The page of a reproduction and `docs/results.md`: every figure and table, ours beside the paper's."""

from __future__ import annotations

import dataclasses

from forcegp.paper.covariance import covariance_block
from forcegp.paper.figures import FigureData
from forcegp.paper.identification import identification_block, identification_finding
from forcegp.paper.learning import (
    about_task,
    against_paper,
    curve_table,
    draw_learning_curve,
    efficiency,
    learning_block,
    residual_table,
)
from forcegp.paper.multiplier import draw_multiplier, multiplier_block, multiplier_finding
from forcegp.paper.predictions import prediction_blocks
from forcegp.paper.results import PaperNumbers, Results, paper_numbers
from forcegp.paper.scores import (
    calibration,
    constraint,
    error_table,
    order,
    overview_table,
    quality_table,
    splits,
)
from forcegp.paper.task_space import task_space_block
from forcegp.paper.trajectories import bands, tip_error
from forcegp.report.html import Block, Finding, render
from forcegp.report.rollouts import rollout_section, rollout_table
from forcegp.report.style import label
from forcegp.report.tables import Table, cell

ROLLOUTS = "stages/figures/rollouts/data.json"
"""Where a reproduction keeps the data of its trajectories."""
OPENING = "sgp-mean"
"""The model whose multiplier opens the page."""


def findings(results: Results, paper: PaperNumbers, figures: FigureData) -> list[Finding]:
    """All findings that the results allow."""
    found = [against_paper(results, paper, model) for model in paper.noisy_mae]
    found += [order(results), efficiency(results, paper), splits(results), calibration(results)]
    found += [constraint(results), multiplier_finding(figures.multiplier)]
    found += [identification_finding(figures.identification)]
    found += [tip_error(figures.rollouts), bands(figures.rollouts)]
    return [finding for finding in found if finding is not None]


def render_page(results: Results, figures: FigureData, view: str | None = None) -> str:
    """The page of a reproduction as HTML; `view` is the file with the motion in three dimensions."""
    paper = paper_numbers()
    return render(
        "page.html.j2",
        package="forcegp.paper",
        results=results,
        paper=paper,
        view=view,
        task=about_task(results),
        opening=_opening(results, paper, figures),
        tables=_tables(results, paper),
        findings=findings(results, paper, figures),
        learning=learning_block(results, paper),
        blocks=(
            covariance_block(figures.covariance),
            multiplier_block(figures.multiplier),
            task_space_block(figures.task_space),
            *prediction_blocks(figures.windows),
            identification_block(figures.identification),
        ),
        trajectories=rollout_section(figures.rollouts, ROLLOUTS),
    )


def _opening(results: Results, paper: PaperNumbers, figures: FigureData) -> Block:
    """What the page shows first: how error falls with data, and the contact force with its band."""
    drawn = {"Error over training points": draw_learning_curve(results, paper, "stretches", "clean")}
    band = next((b for b in figures.multiplier.bands if b.model == OPENING), None)
    if band is not None:
        drawn[f"Contact force ({label(OPENING)})"] = draw_multiplier(figures.multiplier, band)
    pictures = tuple(dataclasses.replace(picture, title=title) for title, picture in drawn.items())
    caption = (
        "Error of predicted accelerations on motion without training points, and the contact force "
        "predicted without a force sensor; the shaded time contains no training point."
    )
    return Block("In short", caption, pictures, "results.json")


def _tables(results: Results, paper: PaperNumbers) -> dict[str, Table]:
    return {
        "overview": overview_table(results),
        "errors": error_table(results, paper),
        "quality": quality_table(results),
        "noisy": curve_table(results, paper, "noisy"),
        "clean": curve_table(results, paper, "clean"),
        "residual": residual_table(results, paper),
        "simulation": simulation_table(results),
        "settings": settings_table(results),
    }


def simulation_table(results: Results) -> Table:
    """Numbers on each simulated run, with the comparison of the physics engine and our equations."""
    seeds = list(results.simulations)
    names = dict.fromkeys(name for run in results.simulations.values() for name in run)
    runs = results.simulations.values()
    rows = [(name.replace("_", " "), *(cell(run.get(name)) for run in runs)) for name in names]
    return Table("The simulated runs", ("quantity", *(f"seed {s}" for s in seeds)), tuple(rows))


def settings_table(results: Results) -> Table:
    """Settings and versions."""
    rows = [(name.replace("_", " "), value) for name, value in results.settings.items()]
    rows += [("seeds", ", ".join(str(s) for s in results.seeds))]
    rows += [(f"version of {name}", value) for name, value in results.versions.items()]
    rows += [("computer", results.machine), ("computing time", f"{results.seconds:.0f} s")]
    return Table("Settings, seeds and versions", ("setting", "value"), tuple(rows))


def render_markdown(results: Results, figures: FigureData) -> str:
    """The numbers of a reproduction beside the paper's, as Markdown."""
    paper = paper_numbers()
    tables = {name: table.markdown() for name, table in _tables(results, paper).items()}
    said = findings(results, paper, figures)
    parts = [
        "# Results",
        f"Written by `forcegp reproduce --profile {results.profile}`; do not edit. {paper.source} "
        f"{about_task(results)}",
        tables["overview"],
        "## Findings",
        "\n".join(f"- **{f.topic}**{'' if f.verdict is None else f': {f.verdict}'}. {f.text}" for f in said),
        "## Errors",
        *(tables[name] for name in ("errors", "noisy", "clean")),
        "## Uncertainty, constraint, cost",
        *(tables[name] for name in ("quality", "residual")),
        "## Trajectories",
        rollout_table(figures.rollouts).markdown(),
        "## Runs and settings",
        *(tables[name] for name in ("simulation", "settings")),
    ]
    return "\n\n".join(parts) + "\n"
