"""Units of joints in messages: radians and newton metres, or metres and newtons where a joint slides."""

from __future__ import annotations

import numpy as np

from forcegp.robot.model import RobotModel


def position_unit(robot: RobotModel, j: int | np.integer) -> str:
    """Unit of the position of joint j."""
    return "rad" if robot.joint_types[j] == "revolute" else "m"


def force_unit(robot: RobotModel, j: int | np.integer) -> str:
    """Unit of the force of joint j."""
    return "N m" if robot.joint_types[j] == "revolute" else "N"


def displacement(robot: RobotModel, j: int | np.integer, offset: float) -> str:
    """An offset of the position of joint j in words, an angle in degrees too."""
    degrees = f" ({np.degrees(offset):+.2f}°)" if robot.joint_types[j] == "revolute" else ""
    return f"{offset:+.4f} {position_unit(robot, j)}{degrees}"
