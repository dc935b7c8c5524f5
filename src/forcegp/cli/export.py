"""`forcegp export`: export a fitted model as controller code or as parameters in a robot file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

import forcegp
from forcegp.cli.common import numbers, show, words
from forcegp.cli.options import ALL, AsJson, Frame, ModelFile, Reference, WrenchAxes, WrenchPoint
from forcegp.errors import ModelError, RobotFileError, check_name

if TYPE_CHECKING:
    from forcegp.models.structured_fit import StructuredFit

TARGETS = ("c", "casadi", "urdf", "mjcf")


def export(
    model: ModelFile,
    out: Annotated[
        Path,
        Option(
            "--out", "-o", writable=True, help="Folder for the code and its test, or path of the robot file."
        ),
    ],
    to: Annotated[str, Option("--to", help="Format: c, casadi, urdf or mjcf.")] = "c",
    name: Annotated[str, Option(help="For C: name of the files and prefix of the functions.")] = "controller",
    functions: Annotated[
        int | None,
        Option(
            min=1,
            help="For C: number of basis functions in a reduced covariance, which widens the error bars. "
            "Default: all, or 200 if there are more than 1700.",
        ),
    ] = None,
    frame: Frame = None,
    point: WrenchPoint = "0,0,0",
    axes: WrenchAxes = ALL,
    reference: Reference = "world",
    float32: Annotated[
        bool, Option("--float32", help="For C: use single precision and report its rounding error.")
    ] = False,
    no_jacobians: Annotated[
        bool, Option("--no-jacobians", help="For C: leave out Jacobians, most of the code of a legged robot.")
    ] = False,
    no_online: Annotated[
        bool,
        Option("--no-online", help="For C: leave out learning online, which speeds up uncertain inertia."),
    ] = False,
    robot: Annotated[
        str | None, Option(help="URDF or MJCF file of the robot, or name of a bundled robot.")
    ] = None,
    samples: Annotated[
        int, Option(min=0, help="For robot files: number of robots to draw from the posterior.")
    ] = 0,
    seed: Annotated[int, Option(help="Seed for drawing these robots.")] = 0,
    gain_std: Annotated[
        float, Option(min=0.0, help="Robot file: relative standard deviation of the torque sensors' gains.")
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Export a structured Gaussian process as C99 or CasADi code, or into a copy of its robot file.

    C: the files compute the mean and covariance of accelerations, multipliers and forces, and the Jacobians
    of the mean, given the state and the closed contacts. They depend only on libm. A test program with
    reference values, a CMakeLists.txt and a README are included.

    CasADi: the file contains the mean as a function for `casadi.Function.load`, with exact derivatives.

    URDF, MJCF: the copy of the robot file contains the identified inertia, damping and friction. A report
    with standard deviations and losses, and robots drawn from the posterior, are also written.

    **Examples**

    forcegp export --model model --to c --out controller/

    forcegp export -m model --functions 100 --name arm -o controller/

    forcegp export -m model --frame tool -o controller/

    forcegp export -m model --to casadi -o mpc/

    forcegp export -m model --to urdf --robot my.urdf --samples 100 -o calibrated.urdf
    """
    import torch

    from forcegp.destination import check_destination, check_folder
    from forcegp.forces.external_wrench import WrenchFrame
    from forcegp.models.calibrated import written_files
    from forcegp.models.structured_fit import StructuredFit

    check_name("format to export to", to, TARGETS)
    if to in ("urdf", "mjcf"):
        for path in written_files(out, samples):
            check_destination(path)
    else:
        check_folder(out)
    fit = forcegp.load_model(model)
    if not isinstance(fit, StructuredFit):
        raise ModelError("only a structured Gaussian process can be exported", expected="sgp", got=fit.kind)
    if to in ("urdf", "mjcf"):
        show(_written_back(fit, to, robot, out, samples, seed, gain_std), as_json)
        return
    x, y, z = numbers("point", point, 3)
    wrench = None if frame is None else WrenchFrame(frame, reference, words(axes), (x, y, z))
    dtype = torch.float32 if float32 else torch.float64
    settings = {"functions": functions, "wrench": wrench, "dtype": dtype}
    settings |= {"jacobians": not no_jacobians, "online": not no_online}
    written = fit.export(out, language=to, name=name, **settings)
    lost: dict[str, object] = {}
    if written.loss:
        lost = {"widest": written.widest, "wider": written.wider, "loss": written.loss.replace("\n", " ")}
    if float32:
        lost |= dict(zip(("rounding of the mean", "rounding of σ"), written.rounding, strict=True))
    show({"folder": str(out), "functions": written.functions, **lost}, as_json)


def _written_back(
    fit: StructuredFit, to: str, robot: str | None, out: Path, samples: int, seed: int, gain_std: float
) -> dict[str, object]:
    """Write the robot file, and return a summary."""
    from forcegp.models.calibrated import write_calibrated
    from forcegp.robot.write_back import is_mjcf

    if robot is None:
        text = "no robot file was given"
        raise ModelError(text, expected="--robot my.urdf, the file that the robot was loaded from")
    if is_mjcf(robot) != (to == "mjcf"):
        text = f"{robot} has a different format"
        raise RobotFileError(text, expected=to, got="mjcf" if to == "urdf" else "urdf")
    calibration = write_calibrated(fit, robot, out, samples=samples, seed=seed, gain_std=gain_std)
    determined = sum(parameter.determined for parameter in calibration.parameters)
    result: dict[str, object] = {"file": str(out), "report": str(out.with_name(f"{out.stem}.report.json"))}
    return result | {"parameters": len(calibration.parameters), "determined": determined, "samples": samples}
