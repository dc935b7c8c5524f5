"""Predictions at logged states beside what was measured there."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data import Dataset
from forcegp.data.fields import AXES
from forcegp.errors import DataError, ForceGPError, UnknownNameError
from forcegp.forces.observations import COLUMNS

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
    left = (true - torch.cat(means)).square().sum(0)
    spread = (true - true.mean(0)).square().sum(0)
    if not bool((spread > 0.0).any()):
        raise DataError(f"{quantity} is constant in the data, so that a score is not defined")
    return float((1.0 - left / spread)[spread > 0.0].mean())


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
