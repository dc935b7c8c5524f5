"""Plots of a rollout: predicted motion with the spread of the function samples, beside the logged motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from matplotlib.axes import Axes
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ParameterError, UnknownNameError
from forcegp.plots import (
    MEASURED,
    PREDICTED,
    Curve,
    Panel,
    Target,
    Timeline,
    axis_label,
    chosen,
    draw_panels,
)

JOINT_QUANTITIES = ("q", "qd", "qdd", "tau")
CONTACT_QUANTITIES = ("multiplier", "c", "cd")


@runtime_checkable
class Trajectories(Protocol):
    """What a rollout holds; `Rollout` documents each field."""

    @property
    def system(self) -> ConstrainedSystem: ...
    @property
    def t(self) -> Tensor: ...
    @property
    def active(self) -> Tensor: ...
    @property
    def samples(self) -> Trajectories | None: ...
    @property
    def rows(self) -> int: ...


def plot(
    path: Trajectories,
    quantity: str,
    log: Dataset | None,
    joints: Sequence[str] | None,
    ax: Target,
) -> list[Axes]:
    """Draw one trajectory; `Rollout.plot` documents the arguments."""
    if quantity not in (*JOINT_QUANTITIES, *CONTACT_QUANTITIES):
        raise UnknownNameError("quantity of a rollout", quantity, (*JOINT_QUANTITIES, *CONTACT_QUANTITIES))
    if path.rows != 1:
        raise ParameterError(
            "several trajectories cannot be drawn on one axis",
            expected="one trajectory",
            got=path.rows,
            hint="choose one, such as rollout[0].plot()",
        )
    robot = path.system.robot
    of_joints = quantity in JOINT_QUANTITIES
    names = robot.joint_names if of_joints else _row_names(path.system)
    values = getattr(path, quantity).reshape(len(path.t), -1)
    std = _spread(path, quantity)
    logged = None if log is None else _logged(path, log, quantity)
    panels = []
    for i in chosen(joints, names, f"component of {quantity}"):
        curves = [] if logged is None else [Curve(logged[:, i], "logged", MEASURED)]
        curves.append(Curve(values[:, i], "predicted", PREDICTED, None if std is None else std[:, i]))
        kinds = robot.joint_types[i : i + 1] if of_joints else ()
        panels.append(Panel(names[i], axis_label(quantity, kinds), curves))
    active = path.active.reshape(len(path.t), -1)
    return draw_panels(panels, Timeline.of(path.t), list(active.unbind(-1)), ax)


def _row_names(system: ConstrainedSystem) -> list[str]:
    """One name per row of the constraints."""
    return [
        contact.name if contact.rows == 1 else f"{contact.name} {row + 1}"
        for contact in system.contacts
        for row in range(contact.rows)
    ]


def _spread(path: Trajectories, quantity: str) -> Tensor | None:
    """Standard deviation `(T, d)` over the function samples, of which a finite one is needed at each time."""
    if path.samples is None:
        return None
    values = getattr(path.samples, quantity).reshape(-1, len(path.t), getattr(path, quantity).shape[-1])
    finite = values.isfinite()
    count = finite.sum(0)
    mean = values.nan_to_num(0.0).sum(0) / count
    return ((values - mean).nan_to_num(0.0).square().sum(0) / (count - 1).clamp(min=1)).sqrt()


def _logged(path: Trajectories, log: Dataset, quantity: str) -> Tensor | None:
    """Logged values `(T, d)` at the times of the rollout, or `None` where they are not logged."""
    if len(log) < len(path.t):
        raise ParameterError(
            "the log is shorter than the rollout", expected=f"{len(path.t)} rows or more", got=len(log)
        )
    if quantity in JOINT_QUANTITIES:
        return getattr(log.select(path.system.robot.joint_names), quantity)[: len(path.t)]
    columns = [log.contact_extras.get(quantity, {}).get(name) for name in path.system.contact_names]
    present = [column[: len(path.t), None] for column in columns if column is not None]
    return torch.cat(present, dim=-1) if len(present) == len(_row_names(path.system)) > 0 else None
