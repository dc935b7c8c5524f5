"""The force sensor of a log as a second measurement: the normal force λ beside the accelerations."""

from __future__ import annotations

import torch

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.forces.measurements import Observation

SENSOR = "F_sensor"
"""Force on the robot at a contact, as `forcegp import` writes it [N]."""


def with_sensor(data: Dataset, system: ConstrainedSystem, noise_std: float) -> list[Observation]:
    """The accelerations of a log, and the normal force λ = n·F of its sensor where the contact is closed.

    Args:
        data: a log with `F_sensor`.
        system: robot with a single contact with a surface.
        noise_std: standard deviation of the normal force, that of the sensor and of what it does not measure,
            such as the tool's inertial force [N].

    Raises:
        ModelError: there is no sensor, no row in contact, or more than one contact.
    """
    contact = system.contacts[0] if len(system.contacts) == 1 else None
    if not isinstance(contact, SurfaceContact):
        raise ModelError(
            "a force sensor measures one contact",
            expected="a single contact with a surface",
            got=", ".join(system.contact_names) or "none",
        )
    logged = data.contact_extras.get(SENSOR, {})
    closed = data.active([contact.name])[:, 0]
    if contact.name not in logged or not bool(closed.any()):
        raise ModelError(
            f"the log has no sensor's force at contact {contact.name!r}",
            expected=f"columns {SENSOR}.{contact.name}.x, .y, .z and rows in contact",
            hint="import the log with a table [wrench], or leave out sensor_noise_std",
        )
    q = data.select(system.robot.joint_names).q
    point = kinematics.point_position(system.robot, q, contact.frame, tuple(contact.point))
    force = (contact.surface.gradient(point) * logged[contact.name]).sum(-1)
    extras = {**data.contact_extras, "multiplier": {contact.name: force}}
    rows = torch.nonzero(closed)[:, 0]
    sensed = data.replace(contact_extras=extras)[rows]
    return [Observation(data), Observation(sensed, "multiplier", noise_std)]
