"""Options shared by several commands."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated

from typer import Option

AsJson = Annotated[bool, Option("--json", help="Print the result as JSON on stdout.")]
Verbose = Annotated[bool, Option("--verbose", help="Also print the numbers of the computation.")]
SCENES = sorted(
    entry.name.removesuffix(".toml") for entry in (files("forcegp") / "scene" / "bundled").iterdir()
)
"""Names of the bundled scenes, which are listed without loading the library."""
_SCENE = Option("--scene", "-s", help=f"Scene file, or name of a bundled scene: {', '.join(SCENES)}.")
SceneName = Annotated[str, _SCENE]
SceneOrNone = Annotated[str | None, _SCENE]
RobotName = Annotated[
    str | None, Option("--robot", help="URDF or MJCF file, or name of a bundled robot, instead of a scene.")
]
ALL = "fx,fy,fz,mx,my,mz"
"""All components of a wrench."""
ModelFile = Annotated[Path, Option("--model", "-m", help="File of a fitted model.")]
DataFile = Annotated[Path, Option("--data", "-d", help="Data set (.parquet or .csv).")]
Frame = Annotated[
    str | None, Option(help="Frame on which an external wrench acts; no declared contact is needed.")
]
WrenchPoint = Annotated[
    str, Option(metavar="X,Y,Z", help="Where the external wrench acts, in coordinates of the frame [m].")
]
WrenchAxes = Annotated[
    str, Option(help="Components of the external wrench to estimate; all others are zero.")
]
Reference = Annotated[str, Option(help="Directions of these components: world or local.")]
SimulatedTime = Annotated[
    float | None, Option("--duration", help="Simulated time in seconds; default: from the scene.")
]
Config = Annotated[
    Path | None, Option(help="TOML file with a \\[model] table that replaces the one in the scene.")
]
DataFiles = Annotated[
    list[Path], Option("--data", "-d", help="Data set (.parquet or .csv); may be given several times.")
]
Differentiate = Annotated[
    int | None,
    Option(
        metavar="WINDOW",
        help="Compute missing velocities and accelerations with a Savitzky-Golay filter over this (odd) "
        "number of samples.",
    ),
]
