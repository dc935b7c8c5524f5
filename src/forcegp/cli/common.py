"""What several commands share: options, progress bars, results, and reading data for a robot."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol, runtime_checkable

import typer

if TYPE_CHECKING:
    from forcegp.constraints import ConstrainedSystem
    from forcegp.data import Dataset
    from forcegp.models.base import Predictor
    from forcegp.robot import RobotModel
    from forcegp.scene import ModelTable

AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
SCENES = sorted(
    entry.name.removesuffix(".toml") for entry in (files("forcegp") / "scene" / "bundled").iterdir()
)
"""Names of the bundled scenes, read without loading the library."""
SceneName = Annotated[
    str,
    typer.Option("--scene", "-s", help=f"Scene file, or the name of a bundled one: {', '.join(SCENES)}."),
]
SceneOrNone = Annotated[
    str | None,
    typer.Option("--scene", "-s", help=f"Scene file, or the name of a bundled one: {', '.join(SCENES)}."),
]
RobotName = Annotated[
    str | None,
    typer.Option(
        "--robot", help="In place of a scene without contacts: URDF or MJCF file, or a bundled robot."
    ),
]
ModelFile = Annotated[Path, typer.Option("--model", "-m", help="File of a fitted model.")]
DataFile = Annotated[Path, typer.Option("--data", "-d", help="Data set, .parquet or .csv.")]
Config = Annotated[
    Path | None,
    typer.Option(help="TOML file with a table \\[model], in place of the scene's: priors, learning."),
]
DataFiles = Annotated[
    list[Path],
    typer.Option("--data", "-d", help="Data set, .parquet or .csv; may be given several times."),
]
Differentiate = Annotated[
    int | None,
    typer.Option(
        metavar="WINDOW",
        help="Compute velocities and accelerations that the log lacks by a Savitzky-Golay filter over an odd "
        "number of samples.",
    ),
]


@runtime_checkable
class Advance(Protocol):
    """Moves a progress bar; `note` is a word on how it goes, such as the objective."""

    def __call__(self, done: int, total: int | None = None, note: str = "") -> None: ...


@contextmanager
def progress_bar(description: str, total: int) -> Iterator[Advance]:
    """A progress bar on stderr.

    Yields:
        A function to call with the number of steps done so far, their total where it has changed, and a note.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    times = (TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[note]}"))
    console = Console(stderr=True)
    # A file or a pipe gets no bar: its steps would only fill the log.
    with Progress(*columns, *times, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(description, total=total, note="")
        yield lambda done, total=None, note="": bar.update(task, completed=done, total=total, note=note)


def show(result: Mapping[str, object], as_json: bool) -> None:
    """Print the result of a command, one value per line without those that are empty, or all as JSON."""
    if as_json:
        typer.echo(json.dumps(dict(result), default=str))
        return
    fields = {name: value for name, value in result.items() if value is not None and value != ()}
    width = max(len(name) for name in fields)
    for name, value in fields.items():
        text = f"{value:.6g}" if isinstance(value, float) else _listed(value)
        typer.echo(f"{name.replace('_', ' '):<{width}}  {text}")


def _listed(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def check_apart(out: Path, *inputs: Path) -> None:
    """Refuse to write a result over a file that it is made from, or over another result.

    Raises:
        DestinationError: they are one file.
    """
    from forcegp.errors import DestinationError

    if out.resolve() in (path.resolve() for path in inputs):
        raise DestinationError(f"{out} would be overwritten", hint="name another file for the result")


def check_data_destination(path: Path, *inputs: Path) -> None:
    """Check, before long work, that a data set can be written without losing what it is made from.

    Raises:
        DataError: the name does not end in `.parquet`.
        DestinationError: the place cannot be written, or is one of the inputs.
    """
    from forcegp.data.table import check_ending
    from forcegp.destination import check_destination

    check_ending(path)
    check_destination(path)
    check_apart(path, *inputs)


def read_data(path: Path, differentiate: int | None = None) -> Dataset:
    """Read a data set, computing derivatives that it lacks where a window is given."""
    from forcegp.data import Dataset, SavitzkyGolay

    method = SavitzkyGolay(window=differentiate) if differentiate is not None else None
    return Dataset.read(path, differentiate=method)


def data_of_robot(data: Dataset, robot: RobotModel) -> Dataset:
    """The data with the robot's joints in the robot's order; further logged joints are left out."""
    if set(robot.joint_names) <= set(data.joint_names):
        data = data.select(robot.joint_names)
    data.check_robot(robot)
    return data


def check_robot_named(scene: str | None, robot: str | None) -> None:
    """Check that either a scene or a robot was given.

    Raises:
        ForceGPError: neither was, or both.
    """
    from forcegp.errors import ForceGPError

    if (scene is None) == (robot is None):
        problem = (
            "nothing says which robot moved" if scene is None else "both --scene and --robot name a robot"
        )
        raise ForceGPError(problem, hint="give either --scene or --robot")


def system_of(scene: str | None, robot: str | None) -> ConstrainedSystem:
    """The robot of a scene with its contacts, or a robot without any.

    Raises:
        ForceGPError: neither is given, or both, or the file is not valid.
    """
    from forcegp.constraints import ConstrainedSystem
    from forcegp.robot import load_robot
    from forcegp.scene import load_scene

    check_robot_named(scene, robot)
    return load_scene(scene).system() if scene is not None else ConstrainedSystem(load_robot(str(robot)))


def model_table(config: Path | None, scene: str | None) -> ModelTable:
    """The table [model] of a file of its own where one is given, else that of the scene, if there is one."""
    from forcegp.scene import default_model_table, load_model_table, load_scene

    if config is not None:
        return load_model_table(config)
    return default_model_table() if scene is None else load_scene(scene).model


def warn_beyond(model: Predictor, data: Dataset) -> None:
    """Print a warning where a model is asked for states far from those that it was trained on."""
    from forcegp.forces.noise import warnings_beyond
    from forcegp.models.structured_fit import StructuredFit

    beyond = model.beyond(data.qd, data.tau) if isinstance(model, StructuredFit) else None
    for doubt in () if beyond is None else warnings_beyond(beyond, data.joint_names):
        typer.secho(f"warning: {doubt}", fg="yellow", err=True)
