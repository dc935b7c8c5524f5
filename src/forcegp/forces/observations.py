"""Which columns of a data set measure which quantity, with which noise."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.data.checks import check_robot, contact_table
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.quantities import QUANTITIES
from forcegp.gp.features import Standardization

NoiseStd = float | Sequence[float] | Tensor
DEFAULT_NOISE_STD = 0.1
"""Noise of accelerations where neither the caller nor the log states it, as in the paper [rad/s², m/s²]."""


def plain(noise: NoiseStd | str | None) -> Any:
    """A noise as what JSON can hold."""
    if noise is None or isinstance(noise, str):
        return noise
    values = torch.as_tensor(noise, dtype=torch.float64).tolist()
    return tuple(values) if isinstance(values, list) else values


@dataclass(frozen=True)
class Observation:
    """A data set as measurements of one quantity.

    Args:
        data: states, contacts and measured values.
        quantity: what is measured: `qdd` (in contact or free), `multiplier`, `contact_force`,
            `constraint_force`, `joint_force`, `contact_friction` or `total_force`.
        noise_std: standard deviation of the measurement: one number, one per component, or `(n, d)`. For
            `qdd`, the default is that of the model, else the `qdd_std` of the log, else that of its header.

    Example:
        >>> import forcegp, torch
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
        >>> q, qd, tau = torch.randn(3, 20, 2, dtype=torch.float64)
        >>> qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau - 0.5 * qd)
        >>> t = torch.arange(20, dtype=torch.float64)
        >>> data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
        >>> Observation(data, "qdd", noise_std=0.1).quantity
        'qdd'
    """

    data: Dataset
    quantity: str = "qdd"
    noise_std: NoiseStd | None = None


def observations_of(data: Dataset | Sequence[Observation]) -> Sequence[Observation]:
    """A data set as measurements of accelerations, or the measurements as given.

    Raises:
        ModelError: there are none, or this is something else.
    """
    observations = [Observation(data)] if isinstance(data, Dataset) else data
    if not isinstance(observations, Sequence) or not all(isinstance(o, Observation) for o in observations):
        raise ModelError(
            "cannot learn from this type of data",
            expected="a Dataset, or a list of Observation",
            got=type(data).__name__,
        )
    if not observations:
        raise ModelError(
            "there are no samples to learn from", expected="at least one observation", got="none"
        )
    return observations


def states_noise(observations: Sequence[Observation]) -> bool:
    """Whether the data state the noise of their accelerations."""
    return all(
        o.noise_std is not None or o.data.header.noise_std is not None or "qdd_std" in o.data.extras
        for o in observations
    )


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
    observation: Observation, system: ConstrainedSystem, default_noise: NoiseStd | None = None
) -> tuple[Measurement, Tensor]:
    """The measurement that an observation makes, and its noise `(d,)` or `(n, d)`.

    Raises:
        UnknownNameError: the quantity cannot be measured, or a contact is not logged.
        ModelError: the noise is not positive, or not given for a quantity other than qdd.
        DataError: the data's joints are not the robot's.
    """
    data, quantity = observation.data, observation.quantity
    if quantity not in QUANTITIES or quantity not in COLUMNS:
        raise UnknownNameError("measured quantity", quantity, COLUMNS)
    names = system.contact_names
    check_robot(data, system.robot)
    active = contact_table(data, names)
    if not len(data.q):
        raise ModelError("there are no samples to learn from", expected="at least one sample", got="none")
    values = COLUMNS[quantity](data, system)
    std = _checked_noise(_noise_of(observation, default_noise), quantity, values)
    return Measurement(quantity, data.q, data.qd, data.tau, active, values, data.segment, data.t), std


def _noise_of(observation: Observation, default: NoiseStd | None) -> NoiseStd:
    """The noise stated by the observation, the model, the log (`qdd_std`), or the header, in this order."""
    data = observation.data
    if observation.noise_std is not None:
        return observation.noise_std
    if observation.quantity != "qdd":
        raise ModelError(
            f"the noise of {observation.quantity!r} is unknown",
            hint=f"pass Observation(data, {observation.quantity!r}, noise_std=…) in the quantity's unit",
        )
    stated = (default, data.extras.get("qdd_std"), data.header.noise_std)
    return next((noise for noise in stated if noise is not None), DEFAULT_NOISE_STD)


def _checked_noise(noise: NoiseStd, quantity: str, values: Tensor) -> Tensor:
    """A noise as a tensor `(d,)` or `(n, d)`."""
    if isinstance(noise, float) and 0.0 < noise < math.inf:
        return values.new_full(values.shape[-1:], noise)
    try:
        std = torch.as_tensor(noise, dtype=values.dtype, device=values.device)
    except (TypeError, ValueError, RuntimeError) as cause:
        raise ModelError("a noise standard deviation is a number, or one per component", got=noise) from cause
    if std.shape not in ((), (1,), values.shape[-1:], values.shape):
        raise ModelError(
            f"the noise of {quantity!r} does not match its components",
            expected=f"one number, {values.shape[-1]}, or {tuple(values.shape)}",
            got=f"shape {tuple(std.shape)}",
        )
    if not bool(((std > 0.0) & (std < math.inf)).all()):
        raise ModelError("a noise standard deviation must be positive and finite", got=noise)
    return std.clone() if std.ndim == 2 else std.expand(values.shape[-1]).clone()


def training_of(
    data: Dataset | Sequence[Observation],
    system: ConstrainedSystem,
    priors: Sequence[ForcePrior],
    noise_std: NoiseStd | None,
    kept: Mapping[str, Standardization],
    standardize: bool = True,
) -> Training:
    """Measurements with their noise and input scales.

    Args:
        data: measured accelerations, or any mixture of measurements.
        system: robot and contacts.
        priors: the force priors.
        noise_std: of accelerations whose noise is not stated.
        kept: scales of priors, by name, that keep earlier ones.
        standardize: whether inputs of kernels are standardized, or enter in their units.

    Raises:
        ModelError, DataError: there are no data, or they do not fit the system.
    """
    observations = observations_of(data)
    pairs = [measurement_of(o, system, noise_std) for o in observations]
    training = Training(
        measurements=tuple(m for m, _ in pairs),
        noise_std=tuple(std for _, std in pairs),
        scales=(),
        period=_period(observations[0].data),
        filter_span=max(o.data.header.filter_span or 0.0 for o in observations),
    )
    return scaled(training, system, priors, kept, standardize)


def scaled(
    training: Training,
    system: ConstrainedSystem,
    priors: Sequence[ForcePrior],
    kept: Mapping[str, Standardization],
    standardize: bool = True,
) -> Training:
    """Training data with the input scales of priors; the arguments are those of `training_of`."""
    new = [prior for prior in priors if prior.name not in kept]
    at = [m.at(system) for m in training.measurements] if new else []
    scales = dict(kept)
    for prior, features in [(prior, [prior.features(system, a) for a in at]) for prior in new]:
        together = {k: torch.cat([f[k] for f in features]) for k in features[0]}
        own = Standardization.of(together, prior.vectors, prior.centred)
        scales[prior.name] = own if standardize and prior.scaled else Standardization.none(together)
    return dataclasses.replace(training, scales=tuple(scales[prior.name] for prior in priors))


def _period(data: Dataset) -> float:
    """Median time step within the trajectories of a log in order; 0 otherwise [s]."""
    if not data.header.ordered or len(data) < 2:
        return 0.0
    steps = data.t.diff()[data.segment[1:] == data.segment[:-1]]
    return float(steps.median()) if len(steps) else 0.0
