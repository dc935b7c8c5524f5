"""`forcegp excite`: plan the next motion to record."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from forcegp.cli.common import check_data_destination, numbers, progress_bar, read_data, save, show
from forcegp.cli.options import AsJson, SceneName

if TYPE_CHECKING:
    from forcegp.simulate.excite import Excitation

Numbers = Annotated[str | None, Option(metavar="X[,X...]", help="Maximum, as one number or one per joint.")]


def excite(
    scene: SceneName,
    out: Annotated[
        Path, Option("--out", "-o", writable=True, help="Output file for the motion (.csv or .parquet).")
    ],
    seconds: Annotated[float, Option(help="Duration of the motion in seconds.")] = 30.0,
    model: Annotated[
        Path | None, Option("--model", "-m", help="Fitted model with the posterior to start from.")
    ] = None,
    region: Annotated[
        Path | None,
        Option(help="Data set with the states at which to predict the torque; default: all states."),
    ] = None,
    start: Annotated[
        str | None,
        Option(
            metavar="Q,Q...", help="Initial and final joint positions; default: a collision-free posture."
        ),
    ] = None,
    velocity: Numbers = None,
    acceleration: Numbers = None,
    torque: Numbers = None,
    share: Annotated[float, Option(help="Fraction of the limits that the motion may use.")] = 0.9,
    box: Annotated[
        list[str] | None,
        Option(metavar="X,Y,Z,A,B,C", help="Box to avoid: centre and side lengths [m]; repeatable."),
    ] = None,
    clearance: Annotated[float, Option(min=1e-4, help="Minimum distance between parts [m].")] = 0.01,
    criterion: Annotated[
        str,
        Option(
            help="A: expected standard deviation of the torque; V: expected torque error of least squares "
            "with link inertia, viscous and dry friction alone; D: determinant of the covariance."
        ),
    ] = "A",
    rate: Annotated[float, Option(help="Samples per second.")] = 1000.0,
    restarts: Annotated[int, Option(min=1, help="Number of random starts to optimise from.")] = 2,
    seed: Annotated[int, Option(help="Seed for the random starts.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Plan a motion in free space that identifies inertia and friction as well as possible.

    The motion starts and ends at rest, respects the limits given as options or in the robot file, and avoids
    collisions of the robot with itself, the surfaces of the scene, and boxes. A page of the same name
    displays the motion, its use of the limits, and the expected standard deviation of the torque before and
    after the motion is recorded.

    **Examples**

    forcegp excite --scene ur5_free --seconds 30 --acceleration 6 --out motion.csv

    forcegp excite -s ur5_free --model model --box 0.5,0,0.1,0.3,0.3,0.2 -o motion.csv
    """
    from forcegp.control.information import Unknowns
    from forcegp.destination import check_destination
    from forcegp.errors import ModelError
    from forcegp.models.calibrated import unknowns_after
    from forcegp.models.load import load_model
    from forcegp.models.structured_fit import StructuredFit
    from forcegp.robot.shapes import shapes_of
    from forcegp.scene import load_scene
    from forcegp.simulate.collisions import Collisions
    from forcegp.simulate.excite import Limits, excite, random_states
    from forcegp.view.excitation import write_excitation

    (check_destination if out.suffix.lower() == ".csv" else check_data_destination)(out)
    page = out.with_suffix(".html")
    check_destination(page)
    read = load_scene(scene)
    system = read.system()
    shapes = shapes_of(system.robot, read.robot_source, ("collision", "visual"))
    fit = None if model is None else load_model(model)
    if fit is not None:
        if not isinstance(fit, StructuredFit):
            text = f"{model} has no forces to continue from"
            raise ModelError(text, expected="a structured GP", got=fit.kind)
        fit.specified.robot.check_state(start=system.robot.lower)
        system = system.with_robot(fit.system.robot)
    limits = Limits.of(
        system.robot,
        velocity=numbers("velocity", velocity),
        acceleration=numbers("acceleration", acceleration),
        torque=numbers("torque", torque),
        share=share,
    )
    states = random_states(system.robot, limits)
    if region is not None:
        log = read_data(region, system.robot)
        log = log[:: max(1, len(log) // len(states[0]))]
        states = log.q, log.qd, log.qdd
    unknowns = Unknowns.of(system.robot, limits.low, limits.high, limits.velocity, states)
    collisions = Collisions(system, shapes, [numbers("box", text) for text in box or ()], clearance)
    with progress_bar("searching", 1) as advance:
        result = excite(
            system,
            seconds,
            limits=limits,
            unknowns=unknowns if fit is None else unknowns_after(fit, unknowns),
            collisions=collisions,
            start=numbers("start", start) or None,
            criterion=criterion,
            rate=rate,
            restarts=restarts,
            seed=seed,
            progress=lambda done, total: advance(done, total),
        )
    save(result.write, out)
    write_excitation(page, result, system, shapes, collisions.boxes, f"{scene}: the next motion")
    show({**_summary(result), "page": str(page), "file": str(out)}, as_json)


def _summary(result: Excitation) -> dict[str, object]:
    before, after = (x.torque_std()["all"] for x in (result.before, result.after))
    used = {f"used_{name}" if name != "clearance_m" else name: value for name, value in result.used.items()}
    return {
        "samples": len(result.motion),
        **used,
        "torque_std_before": [float(f"{x:.4g}") for x in before.tolist()],
        "torque_std_after": [float(f"{x:.4g}") for x in after.tolist()],
    }
