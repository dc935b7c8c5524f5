"""`forcegp fit`: a model from training data."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from forcegp.cli.common import (
    AsJson,
    DataFile,
    Differentiate,
    SceneName,
    check_apart,
    data_of_robot,
    noise_std_of,
    progress_bar,
    read_data,
    show,
)

if TYPE_CHECKING:
    from forcegp.models.base import FitResult


def fit(
    scene: SceneName,
    data: DataFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the fitted model.")],
    model: Annotated[
        str,
        typer.Option(
            "--model",
            "-m",
            help="analytical, nn, gp, sgp-zero, sgp-mean, sgp-contact or sgp-real; with the paper's kernel "
            "sgp-zero-se, sgp-mean-se or sgp-contact-se.",
        ),
    ] = "sgp-mean",
    noise_std: Annotated[
        float | None,
        typer.Option(help="Noise on accelerations in rad/s²; default: the scene's or the data's."),
    ] = None,
    differentiate: Differentiate = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(help="File that records a long fit; a fit that finds it resumes there."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of random initial values.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Fit a model of the forward dynamics to logged motion.

    [bold]Examples[/bold]

    forcegp fit --scene kuka_plane --data train.parquet --model sgp-mean --out model/

    forcegp fit -s my_scene.toml -d train.parquet -m sgp-zero --noise-std 0.2 -o model/ --json
    """
    from forcegp.destination import check_destination, write_or_keep
    from forcegp.errors import DestinationError
    from forcegp.models.registry import create
    from forcegp.scene import load_scene
    from forcegp.storage.folder import check_model_destination

    check_model_destination(out)
    if checkpoint is not None:
        check_destination(checkpoint)
        check_apart(checkpoint, data)
        if out.resolve() in checkpoint.resolve().parents:
            raise DestinationError(
                "the checkpoint would lie in the folder of the model, which is written as a whole",
                got=checkpoint,
                hint="name a file outside of it",
            )
    read = load_scene(scene)
    system = read.system()
    training = data_of_robot(read_data(data, differentiate), system.robot)
    regression = create(model, system, noise_std=noise_std_of(noise_std, read), seed=seed)
    with progress_bar(f"fitting {model}", 1) as progress:
        fitted = regression.fit(
            training,
            progress=lambda done, most, value: progress(done, most, f"objective {value:.4g}"),
            checkpoint=checkpoint,
            keep_checkpoint=True,
        )
    write_or_keep(fitted.save, out)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    _warn(fitted.result)
    figures = {name: value for name, value in asdict(fitted.result).items() if name != "history"}
    show({"model": model, "training_points": len(training), **figures, "folder": str(out)}, as_json)


def _warn(result: FitResult) -> None:
    """Print what is doubtful about a fit."""
    doubts = () if result.converged else (f"the fit did not converge: {result.message}",)
    for doubt in (*doubts, *result.warnings):
        typer.secho(f"warning: {doubt}", fg="yellow", err=True)
