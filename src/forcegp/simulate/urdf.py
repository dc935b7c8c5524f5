"""Conversion of a robot model to URDF, which gives all physics engines the same parameters."""

from __future__ import annotations

import warnings
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import torch
from scipy.spatial.transform import Rotation as ScipyRotation
from torch import Tensor

from forcegp.errors import InertiaError
from forcegp.robot.model import BASE, RobotModel

WORLD = "world"


def write_urdf(robot: RobotModel) -> str:
    """Return the robot as URDF text with inertial parameters and joints, mounted at its base pose.

    Shapes, joint limits, damping and friction are omitted, so that engines add no other forces.
    """
    root = Element("robot", name=robot.name)
    _link(root, WORLD, 1.0, torch.zeros(3), torch.eye(3), torch.ones(3))
    for i, joint in enumerate(robot.joint_names):
        moments, axes = principal_axes(robot.inertia[i])
        _link(root, link_name(robot, i), float(robot.mass[i]), robot.com[i], axes, moments)
        _joint(root, robot, i, joint)
    indent(root)
    return tostring(root, encoding="unicode")


ROUNDING = 1e-12
"""Relative rounding error of principal moments."""


def principal_axes(inertia: Tensor) -> tuple[Tensor, Tensor]:
    """Return the principal moments in ascending order, and right-handed axes as columns.

    The largest moment of a thin plate is the sum of the others. It is reduced by `ROUNDING`, since engines
    reject a plate whose largest moment exceeds the sum by rounding.
    """
    moments, axes = torch.linalg.eigh(inertia)
    low, mid, high = moments.unbind()
    if abs(high - low - mid) <= ROUNDING * high:
        moments = torch.stack([low, mid, (low + mid) * (1.0 - ROUNDING)])
    return moments, axes * torch.linalg.det(axes).sign()


def compile_spec(spec: Any, robot: RobotModel) -> Any:
    """Compile a MuJoCo specification (`MjSpec`) of the robot; raise `InertiaError` for unphysical inertia."""
    try:
        return spec.compile()
    except ValueError as error:
        if "inertia" not in str(error):
            raise
        raise InertiaError(
            f"MuJoCo rejects the inertia of robot {robot.name!r}",
            expected="links whose principal moments obey the triangle inequality",
            got=" ".join(str(error).split()),
            hint="correct the <inertial> of the link in the robot file",
        ) from error


def link_name(robot: RobotModel, index: int) -> str:
    """Return the name of a link in the written file."""
    return WORLD if index == BASE else f"link_of_{robot.joint_names[index]}"


def _link(root: Element, name: str, mass: float, com: Tensor, axes: Tensor, moments: Tensor) -> None:
    """Write a link with its inertia in principal axes, so that engines need not diagonalize it."""
    inertial = SubElement(SubElement(root, "link", name=name), "inertial")
    SubElement(inertial, "origin", xyz=_numbers(com), rpy=_numbers(_roll_pitch_yaw(axes)))
    SubElement(inertial, "mass", value=repr(mass))
    ixx, iyy, izz = (repr(value) for value in moments.tolist())
    SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")


def _joint(root: Element, robot: RobotModel, i: int, name: str) -> None:
    parent = robot.parents[i]
    rotation, position = robot.placement_rotation[i], robot.placement_position[i]
    if parent == BASE:
        position = robot.base_rotation @ position + robot.base_position
        rotation = robot.base_rotation @ rotation
    slides = robot.joint_types[i] == "prismatic"
    joint = SubElement(root, "joint", name=name, type="prismatic" if slides else "continuous")
    SubElement(joint, "origin", xyz=_numbers(position), rpy=_numbers(_roll_pitch_yaw(rotation)))
    SubElement(joint, "parent", link=link_name(robot, parent))
    SubElement(joint, "child", link=link_name(robot, i))
    SubElement(joint, "axis", xyz=_numbers(robot.axis[i]))
    if slides:
        SubElement(joint, "limit", lower="-1e6", upper="1e6", effort="1e9", velocity="1e9")


def _roll_pitch_yaw(rotation: Tensor) -> list[float]:
    """Return the angles about the fixed axes x, y and z, as used in URDF."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at a pitch of 90°, roll and yaw share an axis and one becomes zero
        return ScipyRotation.from_matrix(rotation.numpy()).as_euler("xyz").tolist()


def _numbers(values: Tensor | list[float]) -> str:
    numbers = values.tolist() if isinstance(values, Tensor) else values
    return " ".join(repr(float(value)) for value in numbers)
