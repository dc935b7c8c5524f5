"""Motions to display: joint positions over time, contact forces, and paths of the tip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.models.base import FittedModel, Predictor
from forcegp.plots import as_array
from forcegp.report.animation import FRAMES_PER_SECOND
from forcegp.rollout import Rollout, RolloutOptions
from forcegp.rollout.comparison import tip_of
from forcegp.rollout.forward import replayed
from forcegp.rollout.inputs import sampling_period

Array = NDArray[np.float64]
LOGGED, MEAN, SAMPLE = "logged", "predicted", "sampled"


@dataclass(frozen=True)
class Force:
    """Normal force at a contact in each frame, with its point of application and the surface normal.

    `value` `(k,)` [N] is NaN while the contact is open. `std` is 0 if the uncertainty is unknown. Points have
    shape `(k, 3)` [m].
    """

    contact: str
    point: Array
    normal: Array
    value: Array
    std: Array


@dataclass(frozen=True)
class Path3D:
    """Path of the tip, `(n, 3)` [m]. `kind` is `"logged"`, `"predicted"` or `"sampled"`."""

    kind: str
    points: Array


@dataclass(frozen=True)
class Motion:
    """Joint positions `(k, nq)` at times `(k,)` [s], contact forces, and paths of the tip."""

    system: ConstrainedSystem
    t: Array
    q: Tensor
    forces: Sequence[Force] = ()
    paths: Sequence[Path3D] = ()


def at_rest(system: ConstrainedSystem) -> Motion:
    """Return the robot at rest at q = 0, or at the nearest position within its limits."""
    robot = system.robot
    q = torch.zeros(1, robot.nq, dtype=robot.dtype).clamp(robot.lower.cpu(), robot.upper.cpu())
    return Motion(system, np.zeros(1), q)


def of_log(system: ConstrainedSystem, data: Dataset, model: Predictor | None = None) -> Motion:
    """Return the logged motion with predicted or logged forces; raise `DataError` if the joints differ."""
    data = data.select(system.robot.joint_names)
    if not len(data):
        raise DataError("there is no motion to display", expected="one row or more", got="none")
    frames = data[pictures(data.t)]
    path = Path3D(LOGGED, tip_path(system, data.q))
    return Motion(system, as_array(frames.t - data.t[0]), frames.q, _forces(system, frames, model), [path])


def with_rollout(motion: Motion, path: Rollout) -> Motion:
    """Add the tip paths of a rollout to a motion, one for the mean and one for each function sample."""
    paths = [Path3D(MEAN, tip_path(motion.system, path.q.reshape(-1, path.q.shape[-1])))]
    if path.samples is not None:
        sampled = path.samples.q.reshape(-1, *path.samples.q.shape[-2:])
        paths += [Path3D(SAMPLE, tip_path(motion.system, q)) for q in sampled]
    return replace(motion, paths=[*motion.paths, *paths])


def sampled_rollout(model: Predictor, data: Dataset, samples: int, seconds: float) -> Rollout:
    """Simulate a model from the first state of a trajectory under the logged torques."""
    options = RolloutOptions(sampling_period(data), on_divergence="keep")
    return replayed(model, data, samples if model.has_function_samples else 0, seconds, options=options)


def tip_path(system: ConstrainedSystem, q: Tensor) -> Array:
    """Return the positions of the tip `(n, 3)` [m], up to the point where a trajectory diverges."""
    sound = int(torch.isfinite(q).all(-1).long().cumprod(0).sum())
    frame, point = tip_of(system)
    return as_array(kinematics.point_position(system.robot, q[:sound], frame, tuple(point)))


def pictures(t: Tensor) -> Tensor:
    """Return the indices of the rows to display: for each frame, the last row logged up to its time."""
    period = 1.0 / FRAMES_PER_SECOND
    times = torch.arange(float(t[0]), float(t[-1]) + 0.5 * period, period, dtype=t.dtype)
    return torch.unique((torch.searchsorted(t.contiguous(), times, right=True) - 1).clamp(0, len(t) - 1))


def _forces(system: ConstrainedSystem, data: Dataset, model: Predictor | None) -> list[Force]:
    """Return the normal force at each contact with a surface."""
    if not system.contacts:
        return []
    active = data.active(system.contact_names)
    with torch.no_grad():
        eom = system.equations(data.q, data.qd, active)
    value = std = None
    never = set(model.result.never_closed) if isinstance(model, FittedModel) else set()
    if model is not None and model.force_field() is not None and never != set(system.contact_names):
        prediction = model.predict(data.q, data.qd, data.tau, "multiplier", active=active)
        value, std = prediction.mean, prediction.std
    forces, logged = [], data.contact_extras.get("multiplier", {})
    for i, contact in enumerate(system.contacts):
        point, row = eom.contact_points.get(contact.name), system.rows[contact.name].start
        multiplier = logged.get(contact.name) if value is None else value[:, row]
        if point is not None and multiplier is not None:
            spread = torch.zeros_like(multiplier) if std is None else std[:, row]
            shown = torch.where(active[:, i], multiplier, torch.nan)
            parts = (point.position, point.normal, shown, spread)
            forces.append(Force(contact.name, *(as_array(x) for x in parts)))
    return forces
