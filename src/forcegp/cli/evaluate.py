"""`forcegp evaluate`: how good a model's predictions are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from forcegp.cli.common import AsJson, DataFile, ModelFolder, data_of_robot, progress_bar, read_data, show

WINDOW_SECONDS = 3.0
"""How much of the data the figures show, as in the paper."""


def evaluate(
    model: ModelFolder,
    data: DataFile,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for figures and a page.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare a model's predictions with a data set: errors, coverage, density, constraint residual.

    Errors are in rad/s² (m/s² for sliding joints); coverage is the share of samples within two standard
    deviations. The folder gets a page with the predictions over the first seconds, its figures and their
    data, and evaluation.json with the scores by joint and the calibration.

    [bold]Examples[/bold]

    forcegp evaluate --model model/ --data test.parquet --out evaluation/
    """
    from forcegp.evaluation import evaluate as run
    from forcegp.files import write_json
    from forcegp.models.load import load_model

    regression = load_model(model)
    test = data_of_robot(read_data(data), regression.system.robot)
    with progress_bar("evaluating", len(test)) as progress:
        result = run(regression, test, progress=progress)
    figures: dict[str, object] = dict(result.summary())
    if out is not None:
        from forcegp.report.evaluation import write_evaluation
        from forcegp.report.window import opening, predicted_window

        write_json(out / "evaluation.json", result.to_dict())
        window = predicted_window(regression, opening(test, WINDOW_SECONDS), regression.kind)
        figures["file"] = str(out / "evaluation.json")
        title = f"Model {model} on {data}"
        figures["page"] = str(write_evaluation(out, title, result.summary(), window))
    show(figures, as_json)
