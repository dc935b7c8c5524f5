"""`forcegp fit`: a model from training data."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from forcegp.cli.common import (
    AsJson,
    DataFile,
    Differentiate,
    SceneName,
    data_of_robot,
    noise_std_of,
    progress_bar,
    read_data,
    show,
)


def fit(
    scene: SceneName,
    data: DataFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the fitted model.")],
    model: Annotated[
        str, typer.Option("--model", "-m", help="analytical, nn, gp, sgp-zero or sgp-mean.")
    ] = "sgp-mean",
    noise_std: Annotated[
        float | None,
        typer.Option(help="Noise on accelerations in rad/s²; default: the scene's or the data's."),
    ] = None,
    differentiate: Differentiate = None,
    seed: Annotated[int, typer.Option(help="Seed of random initial values.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Fit a model of the forward dynamics to logged motion.

    [bold]Examples[/bold]

    forcegp fit --scene kuka_plane --data train.parquet --model sgp-mean --out model/

    forcegp fit -s my_scene.toml -d train.parquet -m sgp-zero --noise-std 0.2 -o model/ --json
    """
    from forcegp.scene import load_scene

    read = load_scene(scene)
    system = read.system()
    training = data_of_robot(read_data(data, differentiate), system.robot)
    from forcegp.models.registry import create

    regression = create(model, system, noise_std=noise_std_of(noise_std, read, training), seed=seed)
    with progress_bar(f"fitting {model}", 1) as progress:
        result = regression.fit(
            training, progress=lambda done, most, value: progress(done, most, f"objective {value:.4g}")
        )
    regression.save(out)
    if not result.converged:
        typer.secho(f"warning: the fit did not converge: {result.message}", fg="yellow", err=True)
    figures = {name: value for name, value in asdict(result.result).items() if name != "history"}
    show({"model": model, "training_points": len(training), **figures, "folder": str(out)}, as_json)
