"""Which columns of a data set are measurements of which quantity."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.projection import Measurement
from forcegp.forces.quantities import QUANTITIES

NoiseStd = float | Sequence[float]


@dataclass(frozen=True)
class Observation:
    """A data set as measurements of one quantity.

    Args:
        data: states, contacts and measured values.
        quantity: what is measured: `qdd` (in contact or free), `multiplier`, `contact_force`,
            `constraint_force`, `joint_force`, `contact_friction` or `total_force`.
        noise_std: standard deviation of the measurement, one number or one a component; the model's
            own for `qdd` by default.
    """

    data: Dataset
    quantity: str = "qdd"
    noise_std: NoiseStd | None = None


def _by_contact(name: str) -> Callable[[Dataset, ConstrainedSystem], Tensor]:
    def values(data: Dataset, system: ConstrainedSystem) -> Tensor:
        logged = data.contact_extras.get(name, {})
        for contact in system.contact_names:
            if contact not in logged:
                raise UnknownNameError(f"contact with a logged {name}", contact, logged)
        columns = [logged[contact] for contact in system.contact_names]
        return torch.cat([x[:, None] if x.ndim == 1 else x for x in columns], dim=-1)

    return values


COLUMNS: Mapping[str, Callable[[Dataset, ConstrainedSystem], Tensor]] = {
    "qdd": lambda data, _: data.qdd,
    "multiplier": _by_contact("multiplier"),
    "contact_force": _by_contact("F_I"),
    "constraint_force": lambda data, _: data.Q_I,
    "joint_force": lambda data, _: data.Q,
    "contact_friction": lambda data, _: data.Q_z,
    "total_force": lambda data, _: data.Q + data.Q_z,
}
"""Where a data set holds each quantity that can be measured."""


def measurement_of(
    observation: Observation, system: ConstrainedSystem, default_noise: NoiseStd
) -> tuple[Measurement, Tensor]:
    """The measurement that an observation makes, and the noise of its components `(d,)`.

    Raises:
        UnknownNameError: the quantity cannot be measured, or a contact is not logged.
        ModelError: the noise is not positive, or not given for a quantity other than qdd.
        DataError: the data's joints are not the robot's.
    """
    data, quantity = observation.data, observation.quantity
    if quantity not in QUANTITIES or quantity not in COLUMNS:
        raise UnknownNameError("measured quantity", quantity, COLUMNS)
    data.check_robot(system.robot)
    if len(data) == 0:
        raise ModelError("there is nothing to learn from", expected="at least one sample", got="none")
    values = COLUMNS[quantity](data, system)
    noise = observation.noise_std if observation.noise_std is not None else default_noise
    if observation.noise_std is None and quantity != "qdd":
        raise ModelError(
            f"the noise of {quantity!r} is not known",
            hint=f"pass Observation(data, {quantity!r}, noise_std=…) in the quantity's unit",
        )
    std = torch.as_tensor(noise, dtype=data.dtype, device=data.device)
    if std.shape not in ((), (1,), values.shape[-1:]):
        raise ModelError(
            f"the noise of {quantity!r} does not fit its components",
            expected=f"one number, or {values.shape[-1]}",
            got=f"shape {tuple(std.shape)}",
        )
    std = std.expand(values.shape[-1]).clone()
    if not bool((std > 0.0).all()) or not bool(torch.isfinite(std).all()):
        raise ModelError("a noise standard deviation must be positive and finite", got=noise)
    active = data.active(system.contact_names)
    return Measurement(quantity, data.q, data.qd, data.tau, active, values), std
