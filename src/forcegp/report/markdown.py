"""`docs/results.md`: the tables and readings of a reproduction, as text."""

from __future__ import annotations

from forcegp.report.data import IdentificationData, MultiplierData, Results, paper_numbers
from forcegp.report.findings import findings
from forcegp.report.rollout_data import RolloutData
from forcegp.report.rollouts import rollout_table
from forcegp.report.tables import (
    Table,
    curve_table,
    error_table,
    quality_table,
    residual_table,
    settings_table,
    simulation_table,
)

VERDICT = {True: " (borne out)", False: " (differs)", None: ""}


def results_markdown(
    results: Results,
    multiplier: MultiplierData | None,
    identification: IdentificationData | None,
    rollouts: RolloutData | None,
) -> str:
    """The numbers of a reproduction beside the paper's, as Markdown.

    Args:
        results: the scores.
        multiplier, identification: of the figures, for the readings.
        rollouts: predicted trajectories, for the readings and a table.
    """
    paper = paper_numbers()
    parts = [
        "# Results",
        f"Written by `forcegp reproduce --profile {results.profile}`; change nothing by hand. {paper.source}",
        "## What the numbers say",
        "\n".join(
            f"- **{f.topic}**{VERDICT[f.agrees]}. {f.text}"
            for f in findings(results, paper, multiplier, identification, rollouts)
        ),
        "## Errors",
        markdown_table(error_table(results, paper)),
        markdown_table(curve_table(results, paper, "noisy")),
        markdown_table(curve_table(results, paper, "clean")),
        "## Uncertainty, constraint, cost",
        markdown_table(quality_table(results)),
        markdown_table(residual_table(results, paper)),
        *(["## Trajectories", markdown_table(rollout_table(rollouts))] if rollouts else []),
        "## The runs",
        markdown_table(simulation_table(results)),
        markdown_table(settings_table(results)),
    ]
    return "\n\n".join(parts) + "\n"


def markdown_table(table: Table) -> str:
    """A table with its caption."""

    def line(cells: tuple[str, ...]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    rule = "|" + "---|" * len(table.head)
    return "\n".join([f"{table.caption}:", "", line(table.head), rule, *(line(row) for row in table.rows)])
