"""Use of a force sensor to measure the normal force λ in addition to the accelerations.

A model is fitted to both. At a state with a sensor reading s ± σ, the model predicts λ_m ± w, where w
includes motor torque noise. The combined estimate is λ̂ = (λ_m/w² + s/σ²) / (1/w² + 1/σ²), since the two
errors are independent.
"""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.forces.measurements import Observation
from forcegp.forces.noise import white_noise_std
from forcegp.models.structured_fit import StructuredFit

SENSOR = "F_sensor"
"""Name of the force on the robot at a contact [N], as written by `forcegp import`."""
TINY = 1e-12
"""Smallest variance of a predicted force [N²]."""


def with_sensor(data: Dataset, system: ConstrainedSystem, noise_std: float) -> list[Observation]:
    """Return the accelerations in a log, and the measured normal force λ = n·F while the contact is closed.

    Args:
        data: a log that contains `F_sensor`.
        system: a robot with a single surface contact.
        noise_std: standard deviation of errors in the normal force due to the sensor and to unmeasured
            forces, such as the inertial force of the tool [N].

    Raises:
        ModelError: the log has no sensor or no rows in contact, or the system has more than one contact.
    """
    contact = _contact(system)
    closed = data.active([contact.name])[:, 0]
    if not has_sensor(data, system) or not bool(closed.any()):
        raise ModelError(
            f"the log has no sensor force at contact {contact.name!r}",
            expected=f"columns {SENSOR}.{contact.name}.x, .y, .z and rows in contact",
            hint="import the log with a [wrench] table, or omit sensor_noise_std",
        )
    extras = {**data.contact_extras, "multiplier": {contact.name: sensed_force(data, system)}}
    rows = torch.nonzero(closed)[:, 0]
    sensed = data.replace(contact_extras=extras)[rows]
    return [Observation(data), Observation(sensed, "multiplier", noise_std)]


def _contact(system: ConstrainedSystem) -> SurfaceContact:
    """Return the contact at which the sensor measures the force."""
    contact = system.contacts[0] if len(system.contacts) == 1 else None
    if not isinstance(contact, SurfaceContact):
        raise ModelError(
            "a force sensor measures one contact",
            expected="a single contact with a surface",
            got=", ".join(system.contact_names) or "none",
        )
    return contact


def has_sensor(data: Dataset, system: ConstrainedSystem) -> bool:
    """Return whether the log contains the sensor force at the contact of the system."""
    return any(name in data.contact_extras.get(SENSOR, {}) for name in system.contact_names)


def sensed_force(data: Dataset, system: ConstrainedSystem) -> Tensor:
    """Return the normal force n·F measured by the sensor, `(n,)` [N].

    Raises:
        ModelError: the system has more than one contact, or has no surface contact.
    """
    contact = _contact(system)
    q = data.select(system.robot.joint_names).q
    point = kinematics.point_position(system.robot, q, contact.frame, tuple(contact.point))
    return (contact.surface.gradient(point) * data.contact_extras[SENSOR][contact.name]).sum(-1)


def sensor_noise_std(data: Dataset, system: ConstrainedSystem) -> float:
    """Estimate the standard deviation of the white noise in the measured normal force [N] from a log.

    Args:
        data: a log in time order that contains `F_sensor`.
        system: a robot with a single surface contact.

    Raises:
        ModelError: the log does not have five consecutive rows in contact.
    """
    closed, force = data.active([_contact(system).name])[:, 0], sensed_force(data, system)
    steps = data.t.diff()
    follows = (steps < 1.5 * steps.median()) & (data.segment[1:] == data.segment[:-1])
    inner = torch.stack([follows[k : len(closed) - 4 + k] for k in range(4)]).all(0)
    inner &= torch.stack([closed[k : len(closed) - 4 + k] for k in range(5)]).all(0)
    if not bool(inner.any()):
        raise ModelError(
            "the sensor's noise cannot be estimated", expected="five consecutive rows in contact"
        )
    return float(white_noise_std(force[:, None], inner))


@torch.no_grad()
def force_from_sensor(fit: StructuredFit, data: Dataset) -> tuple[Tensor, Tensor]:
    """Return the mean and standard deviation `(n,)` [N] of λ, given the sensor readings.

    Args:
        fit: a model fitted to the accelerations and the sensor (see `with_sensor`).
        data: states for which `F_sensor` is logged.

    Raises:
        ModelError: the fit has no sensor noise, or the log has no sensor.
    """
    if "multiplier" not in fit.noise or not has_sensor(data, fit.system):
        raise ModelError(
            "this model was not fitted to a force sensor",
            expected="a model fitted with sensor_noise_std, and a log with columns F_sensor",
        )
    active = data.active(fit.system.contact_names)
    states = data.q, data.qd, data.tau
    prediction = fit.predict(*states, "multiplier", active=active)
    assert prediction.variance is not None
    noise = fit.noise_variance(*states, "multiplier", active, sensor=False)
    spread = (prediction.variance + noise)[:, 0].clamp(min=TINY)
    sensor = fit.noise["multiplier"][0] ** 2
    weight = spread / (spread + sensor)
    mean = prediction.mean[:, 0] + weight * (sensed_force(data, fit.system) - prediction.mean[:, 0])
    return mean, (weight * sensor).sqrt()
