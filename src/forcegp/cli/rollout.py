"""`forcegp rollout`: a model rolled forward in time under logged torques."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from forcegp.cli.common import AsJson, DataFile, ModelFolder, data_of_robot, progress_bar, read_data, show

if TYPE_CHECKING:
    from forcegp.data import Dataset
    from forcegp.rollout import Rollout


def rollout(
    model: ModelFolder,
    data: DataFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the trajectories and the page.")],
    start: Annotated[int, typer.Option(min=0, help="Row of the data to start from.")] = 0,
    duration: Annotated[
        float | None, typer.Option(help="Time to roll out in seconds; default: to the end of the trajectory.")
    ] = None,
    samples: Annotated[int, typer.Option(min=0, help="Functions to draw from the model's posterior.")] = 0,
    stabilization: Annotated[str, typer.Option(help="none, baumgarte or projection.")] = "baumgarte",
    method: Annotated[
        str, typer.Option(help="semi_implicit_euler, rk4, rk45 or dop853.")
    ] = "semi_implicit_euler",
    unilateral: Annotated[
        bool, typer.Option("--unilateral", help="Let contacts open where they would pull, and close again.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the samples.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Simulate forward with a model, from a logged state and under the logged torques.

    The folder gets rollout.parquet: the predicted motion, the logged one as q_logged, and, with samples,
    the spread of the sampled motions as q_std; and rollout.html with figures and an animation of the arm,
    the figures as SVG and their data as rollout.json.

    [bold]Examples[/bold]

    forcegp rollout --model model/ --data test.parquet --out rollout/ --duration 2

    forcegp rollout -m model/ -d run.parquet --start 2400 --samples 50 -o rollout/
    """
    from forcegp.models.files import load_model
    from forcegp.report.rollout_data import rollout_data
    from forcegp.report.rollouts import write_rollouts
    from forcegp.rollout import RolloutOptions, beside_log

    regression = load_model(model)
    log = _stretch(data_of_robot(read_data(data), regression.system.robot), start, duration)
    dt = float((log.t[-1] - log.t[0]) / (len(log) - 1))
    with progress_bar("rolling out", len(log) - 1) as progress:
        path = regression.rollout(
            log.q[0],
            log.qd[0],
            log.tau,
            duration=dt * (len(log) - 1),
            samples=samples,
            seed=seed,
            active=log.active(regression.system.contact_names)[0],
            options=RolloutOptions(dt, method, stabilization, unilateral, on_divergence="keep"),
            progress=progress,
        )
    length = len(path.t) if not path.diverged else round(path.diverged[0].t / dt) + 1
    file = out / "rollout.parquet"
    _as_data(path, log, length).with_step(f"rolled out by the model in {model} from row {start}").write(file)
    error = (path.q[:length] - log.q[:length]).abs()
    figures: dict[str, object] = {
        "duration_s": dt * (length - 1),
        "largest_joint_error": float(error.max()),
        "joint_error_at_the_end": float(error[-1].max()),
        "diverged": path.diverged[0].reason if path.diverged else "no",
    }
    if path.c.shape[-1]:
        figures["largest_constraint_error_m"] = float(path.drift[:length].abs().max())
    for event in path.events:
        figures[f"{event.contact}_{'closes' if event.closed else 'opens'}_s"] = event.t
    title = f"Model {model} rolled out on {data}"
    figures["page"] = str(
        write_rollouts(out, title, rollout_data(beside_log(regression.kind, path, log, dt)))
    )
    show({**figures, "file": str(file)}, as_json)


def _stretch(data: Dataset, start: int, duration: float | None) -> Dataset:
    """The rows from `start` on, to the end of their trajectory or of the duration."""
    from forcegp.data.derivative import UNIFORM_TOLERANCE
    from forcegp.errors import DataError

    if not data.header.ordered:
        raise DataError("a rollout needs a log in order of time", got="points in order of selection")
    if start >= len(data) - 1:
        raise DataError("there is no such row to start from", expected=f"0 to {len(data) - 2}", got=start)
    rest = data[start:]
    own = rest[rest.segment == rest.segment[0]]
    if duration is not None:
        own = own[own.t <= own.t[0] + duration * (1.0 + 1e-9)]
    steps = own.t.diff()
    if len(own) < 2 or bool(((steps - steps.median()).abs() > UNIFORM_TOLERANCE * steps.median()).any()):
        raise DataError(
            "a rollout needs two rows or more at an even sampling period",
            hint="start in a trajectory without gaps; rows that are left over from a selection have them",
        )
    return own


def _as_data(path: Rollout, log: Dataset, length: int) -> Dataset:
    """The rolled-out motion as a data set beside the log that it started from."""
    extras = {"q_logged": log.q[:length], "qd_logged": log.qd[:length]}
    if path.samples is not None:
        extras["q_std"] = path.samples.q[:, :length].std(dim=0)
    rows = slice(0, length)
    names = path.system.contact_names
    return log[:length].replace(
        q=path.q[rows],
        qd=path.qd[rows],
        qdd=path.qdd[rows],
        tau=path.tau[rows],
        contact={name: path.active[rows, i] for i, name in enumerate(names)},
        extras=extras,
        contact_extras={},
    )
