"""`forcegp simulate`: a log of a simulated motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from forcegp.cli.common import AsJson, SceneName, check_data_destination, progress_bar, show


def simulate(
    scene: SceneName,
    out: Annotated[Path, typer.Option("--out", "-o", help="Where the log goes (.parquet).")],
    duration: Annotated[
        float | None, typer.Option(help="Simulated time in seconds; default: the scene's.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of motion and noise; default: the scene's.")] = None,
    engine: Annotated[str | None, typer.Option(help="pybullet, mujoco or auto; default: scene's.")] = None,
    contact: Annotated[
        str | None,
        typer.Option(help="rigid, or solver for MuJoCo's own contact and friction; default: the scene's."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate the robot of a scene as it slides over its surface, and log the motion.

    [bold]Examples[/bold]

    forcegp simulate --scene kuka_plane --out run.parquet

    forcegp simulate --scene my_scene.toml --duration 10 --seed 3 --out run.parquet

    forcegp simulate --scene ur5_wiping --engine mujoco --contact solver --out run.parquet
    """
    from forcegp.destination import write_or_keep
    from forcegp.scene import load_scene
    from forcegp.simulate import simulate as run

    check_data_destination(out)
    read = load_scene(scene)
    changes = {"duration": duration, "seed": seed, "engine": engine, "contact": contact}
    config = replace(read.simulation, **{name: v for name, v in changes.items() if v is not None})
    system = read.system()
    with progress_bar("simulating", config.steps) as progress:
        result = run(system, config, progress=lambda done, _: progress(done))
    write_or_keep(result.data.write, out)
    show({**result.summary(), "file": str(out)}, as_json)
