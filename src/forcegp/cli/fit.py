"""`forcegp fit`: fit a model to a log; `forcegp sweep`: fit many models on a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

import forcegp
from forcegp.cli import common, options
from forcegp.cli.common import progress_bar, show
from forcegp.errors import ParameterError

if TYPE_CHECKING:
    from forcegp.models.base import Model
    from forcegp.models.fit_result import FitResult

STREAM_ROWS = 100_000
"""Number of rows above which a log is read piece by piece."""


def fit(
    data: options.DataFiles,
    out: Annotated[
        Path, Option("--out", "-o", writable=True, help="File for the fitted model (.safetensors).")
    ],
    scene: options.SceneOrNone = None,
    robot: options.RobotName = None,
    model: Annotated[
        str | None,
        Option(
            "--model",
            "-m",
            help="analytical, nn, gp, sgp or sgp-zero; from the paper: sgp-mean, sgp-contact or, with the "
            "paper's kernel, sgp-zero-se, sgp-mean-se, sgp-contact-se. Default: from the file, or sgp.",
        ),
    ] = None,
    config: options.Config = None,
    noise_std: Annotated[
        float | None,
        Option(help="Standard deviation of acceleration noise [rad/s²]; default: from the file or data."),
    ] = None,
    differentiate: options.Differentiate = None,
    workers: Annotated[
        int | None,
        Option(min=1, help="Number of processes that share the reading of a long log (needs Dask)."),
    ] = None,
    seed: Annotated[int | None, Option(help="Seed for random initial values.")] = None,
    as_json: options.AsJson = False,
) -> None:
    """Fit a model of the forward dynamics to logged motion.

    The table \\[model] in the scene or in --config defines priors, kernels, noise, robot parameters and
    learning. Command-line options override its entries.

    For structured models, Parquet logs are read piece by piece if they have more than 100,000 rows or consist
    of several files.

    **Examples**

    forcegp fit --scene kuka_plane --data train.parquet --model sgp --out model

    forcegp fit --robot ur3.urdf -d train.parquet --config model.toml --noise-std 0.2 -o model --json

    forcegp fit -s my_scene.toml -d monday.parquet -d tuesday.parquet --workers 2 -o model
    """
    from forcegp.cluster import cluster
    from forcegp.destination import check_destination
    from forcegp.models.configured import configured
    from forcegp.storage.model_file import model_path

    check_destination(model_path(out))
    system = common.system_of(scene, robot)
    table = common.model_table(config, scene)
    regression = configured(table, system, name=model, noise_std=noise_std, seed=seed)
    training = _training(regression.model, data, differentiate, system.robot)
    if workers is not None and not isinstance(training, forcegp.StreamedDataset):
        raise ParameterError(
            "--workers has no effect on this fit, which reads its log at once",
            expected=f"a structured model, and several Parquet files or one over {STREAM_ROWS:,} rows",
            hint="omit --workers",
        )
    with nullcontext() if workers is None else cluster(workers) as client:
        learned = common.fitted(regression, training, **({} if client is None else {"client": client}))
    common.save(learned.save, out)
    doubts = () if learned.result.converged else (f"the fit did not converge: {learned.result.message}",)
    for doubt in (*doubts, *learned.result.warnings):
        common.warn(doubt)
    result: dict[str, object] = {"model": regression.name, "training_points": len(training)}
    joints = () if as_json else system.robot.joint_names
    show({**result, **_figures(learned.result, joints), "file": str(model_path(out))}, as_json)


INPUTS = {
    "q": "position",
    "qd": "velocity",
    "tau": "torque",
    "load": "gravity load",
    "velocity": "velocity",
    "coulomb": "direction of motion",
}
"""Display names of the inputs of priors and models."""


def readable_input(name: str, joints: Sequence[str]) -> str:
    """Return the name of an input of a model in words.

    >>> readable_input("joint_friction.load[0]", ["shoulder", "elbow"])
    'gravity load of shoulder (joint_friction)'
    """
    head, _, number = name.removesuffix("]").partition("[")
    prior, _, kind = head.rpartition(".")
    word, index = INPUTS.get(kind.rstrip("_0123456789")), int(number)
    per_joint = word and index < len(joints) and not prior.startswith("contact")
    text = f"{word} of {joints[index]}" if per_joint else f"{word or kind}, component {index + 1}"
    return f"{text} ({prior})" if prior else text


def _figures(result: FitResult, joints: Sequence[str]) -> dict[str, object]:
    """Return the fields of the result by name.

    If names of joints are given, the fields are texts for readers, without empty fields and printed warnings.
    """
    figures = {name: value for name, value in asdict(result).items() if name != "history"}
    if not joints:
        return figures
    figures["worth"] = "".join(f"\n  {name}: {nats:.3g} nats" for name, nats in result.worth.items())
    figures["constant_inputs"] = tuple(readable_input(each, joints) for each in result.constant_inputs)
    return {name: value for name, value in figures.items() if name != "warnings" and value != ""}


def _training(
    regression: Model, files: list[Path], differentiate: int | None, robot: forcegp.RobotModel
) -> forcegp.Dataset | forcegp.StreamedDataset:
    """Return the training data, streamed if they are large and the model supports streaming."""
    parquet = all(file.suffix.lower() == ".parquet" for file in files)
    if parquet and isinstance(regression, forcegp.StructuredGP):
        log = forcegp.StreamedDataset(tuple(files), common.derivatives(differentiate), robot.joint_names)
        if len(files) > 1 or len(log) > STREAM_ROWS:
            return log
    parts = [common.read_data(file, robot, differentiate) for file in files]
    return parts[0] if len(parts) == 1 else forcegp.Dataset.concatenate(parts)


def sweep(
    scene: Annotated[list[str], Option("--scene", "-s", help="Scene; may be given several times.")],
    model: Annotated[list[str], Option("--model", "-m", help="Model; may be given several times.")],
    out: Annotated[Path, Option("--out", "-o", writable=True, help="Folder for the fits.")],
    seeds: Annotated[int, Option(min=1, help="Number of seeds, starting from 0.")] = 1,
    duration: options.SimulatedTime = None,
    processes: Annotated[int, Option(min=1, help="Number of single-threaded workers on this machine.")] = 2,
    address: Annotated[
        str | None, Option(help="Scheduler of a running cluster, instead of local workers.")
    ] = None,
    as_json: options.AsJson = False,
) -> None:
    """Simulate several scenes, and fit and score several models on each, with several seeds.

    Completed fits are not repeated. This command requires the extra `sweep` (Dask).

    **Examples**

    forcegp sweep --scene kuka_plane --model sgp-zero --model sgp --seeds 3 --out sweep/

    forcegp sweep -s kuka_plane -s ur5_wiping -m sgp --address tcp://host:8786 --out /shared/sweep
    """
    from forcegp.destination import check_destination
    from forcegp.sweep import fits_of
    from forcegp.sweep import sweep as run

    check_destination(out, folder=True)
    fits = fits_of(scene, model, range(seeds), duration)
    with progress_bar("sweeping", len(fits)) as progress:
        scores = run(fits, out, processes=processes, address=address, say=lambda done, _: progress(done))
    pairs = zip(fits, scores, strict=True)
    errors = {fit.name: score["clean_mae"] or score["noisy_mae"] for fit, score in pairs}
    show({**errors, "folder": str(out)}, as_json)
