"""`forcegp evaluate`: how good a model's predictions are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from forcegp.cli.common import AsJson, DataFile, ModelFolder, data_of_robot, read_data, show


def evaluate(
    model: ModelFolder,
    data: DataFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the figures and the page.")],
    as_json: AsJson = False,
) -> None:
    """Compare a model's predictions with a data set: errors, coverage, density, constraint residual.

    [bold]Examples[/bold]

    forcegp evaluate --model model/ --data test.parquet --out evaluation/
    """
    from forcegp.evaluation import evaluate as run
    from forcegp.models.files import load_model

    regression = load_model(model)
    test = data_of_robot(read_data(data), regression.system.robot)
    show(run(regression, test, out).summary(), as_json)
