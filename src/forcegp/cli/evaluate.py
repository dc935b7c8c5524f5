"""`forcegp evaluate`: compare the predictions of a model with a log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

import forcegp
from forcegp.cli.common import fitted, model_table, progress_bar, read_data, show, show_table, warn_beyond
from forcegp.cli.options import AsJson, Config, DataFile, Verbose
from forcegp.errors import ForceGPError

if TYPE_CHECKING:
    from forcegp.models.base import Predictor

WINDOW_SECONDS = 3.0
"""Duration shown in plots over time [s], as in the paper."""


def evaluate(
    data: DataFile,
    model: Annotated[
        Path | None, Option("--model", "-m", help="File of a fitted model; if omitted, a model is fitted.")
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", writable=True, help="Folder for the page and its data.")
    ] = None,
    train: Annotated[
        Path | None,
        Option(
            help="Data to fit the trivial predictors to (default: the other half of the data) and, without "
            "--model, the model."
        ),
    ] = None,
    scene: Annotated[
        str | None, Option("--scene", "-s", help="Scene of the model to fit, if --model is omitted.")
    ] = None,
    config: Config = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Compare the predictions of a model with a data set and with trivial predictors.

    The trivial predictors are the mean, the robot file alone, and a least-squares fit of inertial parameters,
    viscous and Coulomb friction, and offsets. The verdict states which fraction of the non-gravitational
    torque the model explains, and the errors in open-loop motion and, if logged, in the contact force. A
    comparison of the model with each predictor in torque and acceleration follows, with the torque errors by
    joint in motion (root mean square), and the fraction of accelerations within two standard deviations. With
    --verbose, the response is the effect of an added torque on each joint, which is 1 if the model has the
    inertia of the robot file. Errors of accelerations are in rad/s² (m/s² for prismatic joints).

    With --out, the command writes a page that shows the verdict, the errors by joint, the calibration and
    the predictions over the first seconds. It prints the path of the page, and writes all scores to
    evaluation.json.

    **Examples**

    forcegp evaluate --model model --data test.parquet --train train.parquet --out evaluation/

    forcegp evaluate --scene my_scene.toml --config model.toml --train train.parquet --data test.parquet
    """
    from forcegp.destination import check_folder
    from forcegp.models.structured_fit import StructuredFit

    if out is not None:
        check_folder(out)
    regression = _model(model, scene, config, train)
    robot = regression.specified.robot
    test = read_data(data, robot)
    training = None if train is None else read_data(train, robot)
    with progress_bar("evaluating", len(test)) as progress:
        evaluation = forcegp.evaluate(regression, test, train=training, progress=progress)
    warn_beyond(regression, test)
    numbers: dict[str, object] = {
        "left_out": evaluation.left_out,
        "response": evaluation.response,
        **evaluation.summary(),
    }
    head = {"verdict": evaluation.verdict or "too few samples"}
    doubts, compared = evaluation.doubts, {"comparison": evaluation.comparison or None}
    written: dict[str, object] = {}
    if out is not None:
        names = str(model or config or scene), str(data), str(train) if train else None
        written = _written(out, evaluation, regression, test, names)
    if as_json:
        result = {**head, "doubts": doubts, **compared, **numbers}
        if isinstance(regression, StructuredFit):
            result["parameters"] = [vars(each) for each in regression.parameters()]
        show(result | written, as_json)
        return
    show({**head, **{f"doubt_{i + 1}": text for i, text in enumerate(doubts)}, **compared}, as_json)
    _show_errors(evaluation)
    if evaluation.response is not None:
        each = zip(evaluation.joint_names, evaluation.response, strict=True)
        numbers["response"] = [f"{joint} {x:.2g}" for joint, x in each]
    show({**(numbers if verbose else {"samples": evaluation.samples}), **written}, as_json)


def _show_errors(scores: forcegp.evaluation.Evaluation) -> None:
    """Print a table of the torque errors of the model and of the trivial predictors, and of the coverage."""
    if not scores.predictors:
        return
    columns: dict[str, Sequence[float | None]] = {p.name: p.torque.in_motion for p in scores.predictors}
    rows = [["torque error [N m, N]", *columns]]
    rows += [
        [joint, *("" if x is None else f"{x:.3g}" for x in errors)]
        for joint, *errors in zip(scores.joint_names, *columns.values(), strict=True)
    ]
    if scores.uncertainty is not None:
        shares = (f"{share:.0%}" for share in scores.uncertainty.coverage_by_joint)
        rows = [[*row, text] for row, text in zip(rows, ("within ±2σ (95%)", *shares), strict=True)]
    show_table(rows)


def _written(
    out: Path,
    scores: forcegp.evaluation.Evaluation,
    model: Predictor,
    test: forcegp.Dataset,
    names: tuple[str, str, str | None],
) -> dict[str, object]:
    """Write the page and its data, and return their paths. `names` are the file names shown on the page."""
    from forcegp.destination import folder_or_keep
    from forcegp.files import write_json
    from forcegp.report.evaluation import PAGE, write_evaluation
    from forcegp.report.window import opening, predicted_window

    worth = getattr(getattr(model, "result", None), "worth", {})
    window = predicted_window(model, opening(test, WINDOW_SECONDS), model.kind)

    def fill(folder: Path) -> None:
        write_json(folder / "evaluation.json", scores.to_dict())
        write_evaluation(folder, *names, scores, window, worth)

    folder_or_keep(fill, out)
    return {"file": str(out / "evaluation.json"), "page": str(out / PAGE)}


def _model(model: Path | None, scene: str | None, config: Path | None, train: Path | None) -> Predictor:
    """Load a fitted model from a file, or fit a model to the training data."""
    from forcegp.models.configured import configured

    if model is not None:
        if scene is not None or config is not None:
            raise ForceGPError("a fitted model contains its scene and settings", hint="pass only --model")
        return forcegp.load_model(model)
    if scene is None or train is None:
        text = "no model to evaluate was given"
        raise ForceGPError(text, expected="--model FILE, or --scene and --train to fit one")
    system = forcegp.load_scene(scene).system()
    return fitted(configured(model_table(config, scene), system), read_data(train, system.robot))
