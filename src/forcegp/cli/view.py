"""`forcegp view`: display a robot, its surfaces, contact forces and predicted paths in 3D."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

import forcegp
from forcegp.cli.common import printable, progress_bar, read_data, show, trajectory_from
from forcegp.cli.options import AsJson
from forcegp.errors import ParameterError

if TYPE_CHECKING:
    from forcegp.models.base import FittedModel
    from forcegp.robot.shapes import Shape


def view(
    target: Annotated[str, Argument(help="Scene file, name of a bundled scene, or file of a fitted model.")],
    data: Annotated[Path | None, Option("--data", "-d", help="Log with the motion to display.")] = None,
    rollout: Annotated[
        Path | None,
        Option("--rollout", "-r", help="rollout.parquet from `forcegp rollout`, to display its motion."),
    ] = None,
    out: Annotated[
        Path | None,
        Option(
            "--out", "-o", writable=True, help="HTML file that works offline; if omitted, the page is served."
        ),
    ] = None,
    start: Annotated[int, Option(min=0, help="Row of the log to start from.")] = 0,
    seconds: Annotated[float, Option(min=0.05, help="Duration of the motion in seconds.")] = 10.0,
    samples: Annotated[
        int, Option(min=0, help="Number of sampled tip paths to draw (structured models only).")
    ] = 8,
    horizon: Annotated[float, Option(min=0.01, help="Duration of the predicted paths in seconds.")] = 1.0,
    port: Annotated[int, Option(min=1024, max=65535, help="Port of the page.")] = 8080,
    as_json: AsJson = False,
) -> None:
    """View a robot, its surfaces, contact forces and predicted paths in 3D.

    Given a model and a log, the view shows the logged motion, the predicted contact force, and the tip paths
    predicted from the first state. The force is an arrow with a bar of ±2 standard deviations at its head.
    Given a scene and a log, the view shows the logged force instead. Without a log, the robot does not move.

    The page is accessible from this computer only. With --out, it is written as one HTML file that works
    offline.

    **Examples**

    forcegp view kuka_plane

    forcegp view model --data test.parquet --out view.html

    forcegp view my_scene.toml --rollout rollout/rollout.parquet
    """
    from forcegp.destination import check_destination
    from forcegp.view.motion import at_rest, of_log, sampled_rollout, with_rollout
    from forcegp.view.page import serve, view_page, write_view

    if out is not None:
        check_destination(out)
    if data is not None and rollout is not None:
        raise ParameterError("--data and --rollout cannot be combined", hint="choose one motion to display")
    system, model, shapes = _target(target)
    log, motion = data or rollout, at_rest(system)
    if log is not None:
        stretch = _stretch(log, system if model is None else model.specified, start, seconds)
        motion = of_log(system, stretch, model)
        if model is not None and data is not None:
            with progress_bar("rolling out", 1) as advance:
                motion = with_rollout(motion, sampled_rollout(model, stretch, samples, horizon))
                advance(1)
    title = f"{target}: {log or 'at rest'}"
    if out is None:
        page = view_page(motion, shapes, title)
        typer.echo(printable(title))
        serve(page, port, say=lambda address: typer.echo(f"open {address}, end with Ctrl-C"))
        return
    write_view(out, motion, shapes, title)
    show({"pictures": len(motion.t), "paths": len(motion.paths), "page": str(out)}, as_json)


def _target(target: str) -> tuple[forcegp.ConstrainedSystem, FittedModel | None, list[Shape]]:
    """Return the system, the model if the target is a model, and the shapes of the robot."""
    from forcegp.robot.shapes import shapes_of
    from forcegp.storage.model_file import model_path

    if not target.endswith(".toml") and model_path(target).is_file():
        model = forcegp.load_model(target)
        return model.system, model, shapes_of(model.system.robot)
    scene = forcegp.load_scene(target)
    system = scene.system()
    return system, None, shapes_of(system.robot, scene.robot_source)


def _stretch(log: Path, system: forcegp.ConstrainedSystem, start: int, seconds: float) -> forcegp.Dataset:
    """Return the rows of a trajectory from `start` to the first gap or to the end of the given duration."""
    stretch = trajectory_from(read_data(log, system.robot), start, "view")
    steps = stretch.t.diff()
    gaps = (steps > 1.5 * steps.median()).nonzero() if len(steps) > 0 else steps  # left by `forcegp select`
    stretch = stretch[: int(gaps[0]) + 1] if len(gaps) > 0 else stretch
    return stretch[stretch.t <= stretch.t[0] + seconds]
