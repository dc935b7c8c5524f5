"""`forcegp rollout` and `forcegp simulate`: simulate motion with a model or a physics engine."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

import forcegp
from forcegp.cli.common import check_data_destination, progress_bar, read_data, save, show, trajectory_from
from forcegp.cli.options import AsJson, DataFile, ModelFile, SceneName, SimulatedTime
from forcegp.errors import DataError

if TYPE_CHECKING:
    from torch import Tensor

    from forcegp.simulate.passive import PassiveForces


def rollout(
    model: ModelFile,
    data: DataFile,
    out: Annotated[
        Path, Option("--out", "-o", writable=True, help="Folder for the trajectories and the page.")
    ],
    start: Annotated[int, Option(min=0, help="Row of the data to start from.")] = 0,
    duration: Annotated[
        float | None, Option(help="Simulated time in seconds; default: to the end of the trajectory.")
    ] = None,
    samples: Annotated[int, Option(min=0, help="Number of functions to draw from the posterior.")] = 0,
    stabilization: Annotated[str, Option(help="Stabilization: none, baumgarte or projection.")] = "baumgarte",
    method: Annotated[
        str, Option(help="Integrator: semi_implicit_euler, rk4, rk45 or dop853.")
    ] = "semi_implicit_euler",
    unilateral: Annotated[
        bool, Option("--unilateral", help="Let contacts open instead of pulling, and close again.")
    ] = False,
    seed: Annotated[int, Option(help="Seed for the samples.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Simulate motion with a model, starting from a logged state and applying the logged torques.

    The output folder contains rollout.parquet with the predicted motion, the logged motion as q_logged, and
    the standard deviation over samples as q_std. The page rollout.html shows plots and an animation of the
    arm. The plots are also written as SVG files, and their data as rollout.json.

    **Examples**

    forcegp rollout --model model --data test.parquet --out rollout/ --duration 2

    forcegp rollout -m model -d run.parquet --start 2400 --samples 50 -o rollout/
    """
    from forcegp.destination import check_folder, folder_or_keep
    from forcegp.report.page import label
    from forcegp.report.rollouts import rollout_data, write_rollouts
    from forcegp.rollout import beside_log
    from forcegp.rollout.forward import replayed
    from forcegp.rollout.inputs import sampling_period

    check_folder(out)
    regression = forcegp.load_model(model)
    log = _stretch(read_data(data, regression.specified.robot), start, duration)
    _say_contact(log, unilateral)
    dt = sampling_period(log)
    options = forcegp.rollout.RolloutOptions(dt, method, stabilization, unilateral, on_divergence="keep")
    with progress_bar("rolling out", len(log) - 1) as progress:
        path = replayed(regression, log, samples, seed=seed, options=options, progress=progress)
    rolled = _as_data(path, log, dt)
    compared = rollout_data(beside_log(regression.kind, path, log, dt))
    step = f"rolled out by the model in {model} from row {start}"

    def fill(folder: Path) -> None:
        rolled.with_step(step).write(folder / "rollout.parquet")
        write_rollouts(folder, f"{label(regression.kind)} rolled out on {data}", compared)

    folder_or_keep(fill, out)
    written = {"page": str(out / "rollout.html"), "file": str(out / "rollout.parquet")}
    show({**_figures(path, rolled, dt), **written}, as_json)


def _figures(path: forcegp.rollout.Rollout, rolled: forcegp.Dataset, dt: float) -> dict[str, object]:
    """Return the numbers to report, computed up to the point where the prediction diverges."""
    error = (rolled.q - rolled.q_logged).abs()
    figures: dict[str, object] = {
        "duration_s": dt * (len(rolled) - 1),
        "largest_joint_error": float(error.max()),
        "joint_error_at_the_end": float(error[-1].max()),
        "diverged": path.diverged[0].reason if path.diverged else "no",
    }
    if path.samples is not None and path.samples.diverged:
        figures["samples_diverged"] = f"{len(path.samples.diverged)} of {path.samples.rows}"
    if path.c.shape[-1]:
        figures["largest_constraint_error_m"] = float(path.drift[: len(rolled)].abs().max())
    for event in path.events:
        figures[f"{event.contact}_{'closes' if event.closed else 'opens'}_s"] = event.t
    return figures


def _say_contact(log: forcegp.Dataset, unilateral: bool) -> None:
    """Warn if a contact changes its state in the log but not in the rollout."""
    for name, closed in log.contact.items():
        changed = (closed != closed[0]).nonzero()
        if not unilateral and len(changed):
            row = int(changed[0])
            state = "closed" if closed[0] else "open"
            warnings.warn(
                f"the rollout keeps {name!r} {state}, as at the start, but it changes in the log after "
                f"{float(log.t[row] - log.t[0]):.4g} s: pass --unilateral",
                stacklevel=2,
            )


def _stretch(data: forcegp.Dataset, start: int, duration: float | None) -> forcegp.Dataset:
    """Return the rows from `start` to the end of the trajectory or of the duration."""
    from forcegp.data.derivative import UNIFORM_TOLERANCE

    stretch = trajectory_from(data, start, "rollout")
    if duration is not None:
        stretch = stretch[stretch.t <= stretch.t[0] + duration * (1.0 + 1e-9)]
    steps = stretch.t.diff()
    if len(stretch) < 2 or bool(((steps - steps.median()).abs() > UNIFORM_TOLERANCE * steps.median()).any()):
        raise DataError(
            "a rollout needs two rows or more at a constant sampling period",
            hint="start in a trajectory without gaps; rows left over from a selection have gaps",
        )
    return stretch


def _spread(q: Tensor) -> Tensor:
    """Return the standard deviation over samples `(S, T, nq)`, as long as at least two have not diverged."""
    import numpy as np
    import torch

    finite = q.isfinite().all(-1)
    length = int((finite.sum(0) >= 2).to(torch.int64).cumprod(0).sum())
    sound = torch.where(finite[..., None], q, torch.nan)[:, :length]
    return torch.from_numpy(np.nanstd(sound.numpy(), axis=0, ddof=1))


def _as_data(path: forcegp.rollout.Rollout, log: forcegp.Dataset, dt: float) -> forcegp.Dataset:
    """Return a data set with the simulated motion, up to a divergence, and the logged motion."""
    # A prediction that diverges between two rows ends at the first of them.
    length = min([len(path.t), *(round(diverged.t / dt) + 1 for diverged in path.diverged[:1])])
    extras = {"q_logged": log.q, "qd_logged": log.qd}
    if path.samples is not None and path.samples.rows > 1:
        extras["q_std"] = _spread(path.samples.q)
        length = min(length, len(extras["q_std"]))
    closed = zip(path.system.contact_names, path.active[:length].unbind(-1), strict=True)
    return log[:length].replace(
        **{name: getattr(path, name)[:length] for name in ("q", "qd", "qdd", "tau")},
        contact=dict(closed),
        extras={name: values[:length] for name, values in extras.items()},
        contact_extras={},
    )


def _learned(path: Path, sample: bool, seed: int) -> PassiveForces:
    """Return the mean forces of a fitted model, or one function sampled from their posterior."""
    import torch

    from forcegp.errors import ModelError
    from forcegp.models.load import load_model
    from forcegp.simulate.passive import PassiveForces

    fit = load_model(path)
    field = fit.force_field()
    if field is None or (sample and not fit.has_function_samples):
        raise ModelError(f"{path} contains no forces to simulate", expected="a structured GP", got=fit.kind)
    if sample:
        field = fit.force_samples(1, torch.Generator().manual_seed(seed))
    return PassiveForces(fit.system, field)


def simulate(
    scene: SceneName,
    out: Annotated[Path, Option("--out", "-o", writable=True, help="Output file for the log (.parquet).")],
    duration: SimulatedTime = None,
    seed: Annotated[
        int | None, Option(help="Seed for the motion and the noise; default: from the scene.")
    ] = None,
    engine: Annotated[
        str | None, Option(help="Engine: pybullet, mujoco or auto; default: from the scene.")
    ] = None,
    contact: Annotated[
        str | None,
        Option(help="rigid, or solver for MuJoCo's contacts and friction; default: from the scene."),
    ] = None,
    motion: Annotated[
        Path | None, Option(help="Data set with the motion to follow, such as that of `forcegp excite`.")
    ] = None,
    model: Annotated[
        Path | None,
        Option("--model", "-m", help="Fitted model: simulate its robot with the learned joint forces."),
    ] = None,
    sample: Annotated[
        bool, Option("--sample", help="Use a posterior sample, drawn with the seed, instead of the mean.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Simulate and log the robot of a scene while it slides over a surface or follows a given motion.

    If a model is given, MuJoCo simulates the fitted robot with the learned joint forces, which replace joint
    friction. MuJoCo computes the contact forces itself.

    **Examples**

    forcegp simulate --scene kuka_plane --out run.parquet

    forcegp simulate --scene my_scene.toml --duration 10 --seed 3 --out run.parquet

    forcegp simulate --scene ur5_wiping --engine mujoco --contact solver --out run.parquet

    forcegp simulate --scene ur5_free --model model --motion motion.csv --sample --seed 3 --out run.parquet
    """
    from forcegp.errors import ParameterError
    from forcegp.simulate import simulate as run

    check_data_destination(out)
    if sample and model is None:
        raise ParameterError("--sample needs a model to draw from", hint="give --model")
    read = forcegp.load_scene(scene)
    system = read.system()
    path = None if motion is None else read_data(motion, system.robot)
    if path is not None and duration is None:
        duration = float(path.t[-1] - path.t[0])
    changes = {"duration": duration, "seed": seed, "engine": engine, "contact": contact}
    config = replace(read.simulation, **{name: v for name, v in changes.items() if v is not None})
    forces = None
    if model is not None:
        forces = _learned(model, sample, config.seed)
        solver = replace(config.solver, joint_friction=(), joint_damping=())
        config = replace(config, contact="solver", engine="mujoco", solver=solver)
        robot = forces.system.robot
        system = system.with_robot(robot.replace(stribeck=0.0 * robot.stribeck))
    with progress_bar("simulating", config.steps) as progress:
        result = run(system, config, motion=path, forces=forces, progress=lambda done, _: progress(done))
    save(result.data.write, out)
    show({**result.summary(), "file": str(out)}, as_json)
