"""`forcegp sweep`: several models, robots and seeds on the workers of a Dask cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from forcegp.cli.common import AsJson, progress_bar, show


def sweep(
    scene: Annotated[list[str], typer.Option("--scene", "-s", help="Scene; may be given several times.")],
    model: Annotated[list[str], typer.Option("--model", "-m", help="Model; may be given several times.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the fits.")],
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds, from 0 on.")] = 1,
    duration: Annotated[
        float | None, typer.Option(help="Simulated time in seconds; default: the scene's.")
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="Workers on this machine, of one thread each.")] = 2,
    address: Annotated[
        str | None, typer.Option(help="Scheduler of a running cluster, in place of workers here.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate, fit and score several models on several robots, with several seeds.

    Fits that are done are not run again. Needs the extra `sweep` (Dask).

    [bold]Examples[/bold]

    forcegp sweep --scene kuka_plane --model sgp-zero --model sgp-mean --seeds 3 --out sweep/

    forcegp sweep -s kuka_plane -s ur5_wiping -m sgp-mean --address tcp://host:8786 --out /shared/sweep
    """
    from forcegp.destination import check_destination
    from forcegp.sweep import fits_of
    from forcegp.sweep import sweep as run

    check_destination(out, folder=True)
    fits = fits_of(scene, model, range(seeds), duration)
    with progress_bar("sweeping", len(fits)) as progress:
        scores = run(
            fits, out, processes=processes, address=address, say=lambda done, _: progress(done, len(fits))
        )
    errors = {
        fit.name: score["clean_mae"] or score["noisy_mae"] for fit, score in zip(fits, scores, strict=True)
    }
    show({**errors, "folder": str(out)}, as_json)
