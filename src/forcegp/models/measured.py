"""Predictions at logged states beside what was measured there: values, scores and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from matplotlib.axes import Axes
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data import Dataset
from forcegp.data.fields import AXES
from forcegp.errors import DataError, ForceGPError, ShapeError, UnknownNameError
from forcegp.forces.observations import COLUMNS
from forcegp.plots import MEASURED, PREDICTED, Curve, Panel, Target, Timeline, axis_label, chosen, draw_panels

CHUNK = 2000
"""States that are predicted at once, to bound the memory."""


@runtime_checkable
class Predicts(Protocol):
    """What predicts quantities of a system."""

    @property
    def system(self) -> ConstrainedSystem: ...
    @property
    def predict(self) -> Any: ...


def predicted(model: Predicts, data: Dataset, quantity: str, **settings: Any) -> Any:
    """The `Prediction` of a quantity at logged states; contacts are closed where the log says so."""
    system = settings.get("system") or model.system
    active = data.active(system.contact_names)
    return model.predict(data.q, data.qd, data.tau, quantity, active=active, **settings)


def measured(system: ConstrainedSystem, data: Dataset, quantity: str) -> Tensor:
    """Logged values `(n, d)` of a quantity.

    Raises:
        UnknownNameError: the quantity cannot be measured, or a contact of the system is not logged.
        NotLoggedError: it is not logged.
    """
    if quantity not in COLUMNS:
        raise UnknownNameError("measured quantity", quantity, COLUMNS)
    return COLUMNS[quantity](data, system)


def measured_if_logged(system: ConstrainedSystem, data: Dataset, quantity: str) -> Tensor | None:
    """Logged values `(n, d)` of a quantity, or `None`."""
    try:
        return measured(system, data, quantity)
    except ForceGPError:
        return None


def score(model: Predicts, data: Dataset, quantity: str) -> float:
    """R² of the predicted mean, averaged over the components; `Predictor.score` documents it."""
    data.check_robot(getattr(model, "specified", model.system).robot)
    if len(data) < 2:
        raise DataError("a score needs two samples or more", got=len(data))
    true = measured(model.system, data, quantity)
    means = [
        predicted(model, data[first : first + CHUNK], quantity, covariance=False).mean
        for first in range(0, len(data), CHUNK)
    ]
    unexplained = (true - torch.cat(means)).square().sum(0)
    spread = (true - true.mean(0)).square().sum(0)
    if not bool((spread > 0.0).any()):
        raise DataError(f"{quantity} is constant in the data, so that a score is not defined")
    return float((1.0 - unexplained / spread)[spread > 0.0].mean())


def component_names(system: ConstrainedSystem, quantity: str) -> list[str]:
    """What the components of a quantity belong to: joints, contacts, or axes of a contact's force."""
    if quantity == "contact_force":
        contacts = [c.name for c in system.contacts if isinstance(c, SurfaceContact)]
        return [f"{name} {axis}" for name in contacts for axis in AXES]
    if quantity != "multiplier":
        return list(system.robot.joint_names)
    return [
        name if contact.rows == 1 else f"{name} {row + 1}"
        for contact in system.contacts
        for name in [contact.name]
        for row in range(contact.rows)
    ]


MOST_SAMPLES = 2000
"""Samples that are predicted and drawn: more cannot be told apart."""


def plot_model(
    model: Predicts,
    data: Dataset,
    quantity: str,
    joints: Sequence[str] | None,
    ax: Target,
    settings: Mapping[str, Any],
) -> list[Axes]:
    """Draw predictions at logged states; `Predictor.plot` documents the arguments."""
    system = settings.get("system") or model.system
    data.check_robot((settings.get("system") or getattr(model, "specified", system)).robot)
    data = data[:: max(1, -(-len(data) // MOST_SAMPLES))]
    prediction = predicted(model, data, quantity, **settings)
    names, kinds = component_names(system, quantity), system.robot.joint_types
    true, mean, std = measured_if_logged(system, data, quantity), prediction.mean, prediction.std
    of_joints = names == list(system.robot.joint_names)
    panels = [
        _panel(names[i], axis_label(quantity, kinds[i : i + 1] if of_joints else ()), i, true, mean, std)
        for i in chosen(joints, names, f"component of {quantity}")
    ]
    time = Timeline.of(data.t, data.segment, data.header.ordered)
    return draw_panels(panels, time, [data.contact[c] for c in system.contact_names], ax)


def plot_prediction(
    mean: Tensor,
    std: Tensor | None,
    quantities: Sequence[str],
    t: Tensor | None,
    measured: Tensor | None,
    names: Sequence[str] | None,
    ax: Target,
) -> list[Axes]:
    """Draw a prediction by itself; `Prediction.plot` documents the arguments."""
    if mean.ndim != 2:
        raise ShapeError(
            "only predictions over one list of states can be drawn",
            expected="a mean of shape (n, d)",
            got=tuple(mean.shape),
        )
    n, d = mean.shape
    quantity = quantities[0] if len(quantities) == 1 else ""
    names = [f"component {i + 1}" for i in range(d)] if names is None else list(names)
    for what, value, expected in (
        ("t", None if t is None else tuple(t.shape), (n,)),
        ("measured", None if measured is None else tuple(measured.shape), (n, d)),
        ("names", (len(names),), (d,)),
    ):
        if value is not None and value != expected:
            raise ShapeError(f"{what} does not fit the prediction", expected=expected, got=value)
    panels = [_panel(names[i], axis_label(quantity), i, measured, mean, std) for i in range(d)]
    axes = draw_panels(panels, Timeline.of(torch.arange(n) if t is None else t), (), ax)
    if t is None:
        axes[-1].set_xlabel("sample")
    return axes


def _panel(name: str, label: str, i: int, true: Tensor | None, mean: Tensor, std: Tensor | None) -> Panel:
    """Column i of a prediction, and of what was measured, if anything was."""
    curves = [] if true is None else [Curve(true[:, i], "measured", MEASURED, width=0.7)]
    band = None if std is None else std[:, i]
    return Panel(name, label, [*curves, Curve(mean[:, i], "predicted", PREDICTED, band)])
