"""`forcegp evaluate`: how good a model's predictions are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from forcegp.cli.common import AsJson, DataFile, ModelFolder, data_of_robot, progress_bar, read_data, show

WINDOW_SECONDS = 3.0
"""Length of the plots over time [s], as in the paper."""


def evaluate(
    model: ModelFolder,
    data: DataFile,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the page and its data.")] = None,
    train: Annotated[
        Path | None,
        typer.Option(
            help="Data that the trivial predictors are fitted to; default: the other half of the data."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare a model's predictions with a data set and with trivial predictors.

    The trivial predictors are the mean, the robot file alone, and least squares of inertial parameters,
    viscous and Coulomb friction and offsets. The verdict says whether the model is better than each, in
    torque and in acceleration. Errors are in rad/s² (m/s² for sliding joints); coverage is the share of
    samples within two standard deviations.

    With --out, prints the path of a page with the verdict, the errors by joint, the calibration and the
    predictions over the first seconds, and writes all scores to evaluation.json.

    [bold]Examples[/bold]

    forcegp evaluate --model model/ --data test.parquet --train train.parquet --out evaluation/
    """
    from forcegp.destination import check_destination, write_or_keep
    from forcegp.evaluation import evaluate as run
    from forcegp.files import atomic_directory, write_json
    from forcegp.models.load import load_model

    if out is not None:
        check_destination(out, folder=True, own_files=["*.json", "*.html", "*.svg", "*.png"])
    regression = load_model(model)
    robot = regression.system.robot
    test = data_of_robot(read_data(data), robot)
    known = None if train is None else data_of_robot(read_data(train), robot)
    with progress_bar("evaluating", len(test)) as progress:
        found = run(regression, test, train=known, progress=progress)
    result: dict[str, object] = {"verdict": found.verdict or "too few samples", **found.summary()}
    if out is not None:
        from forcegp.report.evaluation import PAGE, write_evaluation
        from forcegp.report.window import opening, predicted_window

        window = predicted_window(regression, opening(test, WINDOW_SECONDS), regression.kind)
        fitted_to = None if train is None else str(train)

        def write(folder: Path) -> None:
            with atomic_directory(folder) as temporary:
                write_json(temporary / "evaluation.json", found.to_dict())
                write_evaluation(temporary, str(model), str(data), found, window, fitted_to)

        write_or_keep(write, out)
        result |= {"file": str(out / "evaluation.json"), "page": str(out / PAGE)}
    show(result, as_json)
