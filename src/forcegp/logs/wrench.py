"""A force-torque sensor's reading as force and moment of the environment at the contact, in the world.

The sensor sits in a frame of the robot, at p_S with rotation R. With f and m its reading as the environment
and gravity act on the robot beyond it, the tool's weight m_T g at its centre of mass p_T is taken off and the
moment carried to the contact point p_C:

    F = R f − m_T g,   M = R m − (p_T − p_S) × m_T g − (p_C − p_S) × F.

The tool's inertial force m_T p̈_T is not taken off: it is small for light tools and slow motion.
"""

from __future__ import annotations

import numpy as np
import torch

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.logs.mapping import Mapping
from forcegp.logs.sections import WrenchSection
from forcegp.logs.signals import Array, Signals
from forcegp.robot import RobotModel

CHUNK = 1 << 14
"""Rows that are computed at a time."""


def at_sensor(signals: Signals, robot: RobotModel, mapping: Mapping) -> tuple[Array, Array]:
    """Force, and moment about the sensor, in world axes, without the tool's weight; `(n, 3)` each [N], [N m].

    Raises:
        MappingError: the sensor's frame is none of the robot.
    """
    section = mapping.sections.wrench
    assert section is not None
    if section.frame not in robot.frame_names:
        listing = ", ".join(robot.frame_names)
        raise mapping.error(("wrench", "frame"), "no such frame of the robot", listing, repr(section.frame))
    force, moment = np.empty((len(signals), 3)), np.empty((len(signals), 3))
    for start in range(0, len(signals), CHUNK):
        rows = slice(start, start + CHUNK)
        reading = torch.from_numpy(signals.vectors["wrench"][rows])
        q = torch.from_numpy(np.ascontiguousarray(signals.vectors["q"][rows]))
        f, m = contact_wrench(robot, section, q, reading)
        force[rows], moment[rows] = f.numpy(), m.numpy()
    return force, moment


def contact_wrench(
    robot: RobotModel, section: WrenchSection, q: torch.Tensor, reading: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Force and moment about the sensor that the environment exerts on the robot, in world axes.

    Args:
        robot: the robot.
        section: the sensor.
        q: `(n, nq)` positions.
        reading: `(n, 6)` force and moment in the sensor's axes or the world's [N], [N m].
    """
    rotation, _ = kinematics.frame_pose(robot, q, section.frame)
    sign = 1.0 if section.acts_on == "robot" else -1.0
    force, moment = sign * reading[:, :3], sign * reading[:, 3:]
    if section.axes == "frame":
        force = (rotation @ force[..., None])[..., 0]
        moment = (rotation @ moment[..., None])[..., 0]
    weight = section.tool_mass * robot.gravity
    arm = rotation @ torch.tensor(section.tool_com, dtype=q.dtype)
    return force - weight, moment - torch.linalg.cross(arm, weight.expand_as(arm))


def at_contact(
    signals: Signals,
    robot: RobotModel,
    mapping: Mapping,
    contact: SurfaceContact,
    force: Array,
    moment: Array,
) -> Array:
    """`(n, 3)` moment about the touching point [N m], from the one about the sensor."""
    section = mapping.sections.wrench
    assert section is not None
    result = np.empty_like(moment)
    for start in range(0, len(signals), CHUNK):
        rows = slice(start, start + CHUNK)
        q = torch.from_numpy(np.ascontiguousarray(signals.vectors["q"][rows]))
        _, sensor = kinematics.frame_pose(robot, q, section.frame)
        arm = kinematics.point_position(robot, q, contact.frame, tuple(contact.point)) - sensor
        result[rows] = moment[rows] - np.cross(arm.numpy(), force[rows])
    return result


def per_contact(signals: Signals, system: ConstrainedSystem, mapping: Mapping) -> dict[str, dict[str, Array]]:
    """The sensor's force and moment at each contact with a surface, `F_sensor` and `M_sensor` of a data set.

    Raises:
        MappingError: the sensor's frame is none of the robot.
    """
    force, moment = at_sensor(signals, system.robot, mapping)
    found: dict[str, dict[str, Array]] = {"F_sensor": {}, "M_sensor": {}}
    for contact in system.contacts:
        if isinstance(contact, SurfaceContact):
            found["F_sensor"][contact.name] = force
            found["M_sensor"][contact.name] = at_contact(
                signals, system.robot, mapping, contact, force, moment
            )
    return found
