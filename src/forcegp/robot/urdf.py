"""Reading of URDF files. All elements that are used are checked, and all others are ignored."""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from forcegp.errors import InertiaError, RobotFileError, UnsupportedRobotError
from forcegp.robot.free_base import WORLD, with_free_base
from forcegp.robot.safety import parse_numbers, xacro_error
from forcegp.robot.tree import Base, Coupling, Inertial, Joint, Link, Tree, transform

_NUMBERS = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "mass": {"value": 1},
    "inertia": {"ixx": 1, "ixy": 1, "ixz": 1, "iyy": 1, "iyz": 1, "izz": 1},
    "limit": {"lower": 1, "upper": 1, "effort": 1, "velocity": 1},
    "dynamics": {"damping": 1, "friction": 1},
    "mimic": {"multiplier": 1, "offset": 1},
}
_NEEDED = {
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "parent": ("link",),
    "child": ("link",),
    "mimic": ("joint",),
}
_INSTEAD = {
    "floating": "attach the robot to the base with a fixed joint",
    "spherical": "write it as three revolute joints with links without mass between them",
    "planar": "write it as two prismatic joints and a revolute one",
}
"""Remedies for unsupported joint types."""
_KINDS = ("revolute", "continuous", "prismatic", "fixed")


def read_urdf(root: Element, label: str, base: Base = "fixed") -> Tree:
    """Return the links and joints of a `<robot>` element. Errors name invalid or unsupported elements."""
    floating = [e for e in root.findall("joint") if e.get("type") == "floating"] if base == "free" else []
    if len(floating) > 1:
        text, names = f"{label}: several joints are floating", ", ".join(_name(e, label) for e in floating)
        raise UnsupportedRobotError(text, expected="one floating joint", got=names)
    for element in floating:
        element.set("type", "fixed")
    for element in root.iter():
        macros = [text for text in element.attrib.values() if "${" in text or "$(" in text]
        if macros or "xacro" in element.tag:
            raise xacro_error(label, macros[0][:80] if macros else f"<{element.tag.rpartition(':')[2]}>")
    links = tuple(_link(element, label) for element in root.findall("link"))
    joints = tuple(_joint(element, label) for element in root.findall("joint"))
    remarks: tuple[str, ...] = ()
    # Some files use the world as a link without declaring it. As in Drake, a fixed joint may attach the robot
    # to it.
    attached = any(joint.parent == WORLD and joint.kind == "fixed" for joint in joints)
    if attached and all(link.name != WORLD for link in links):
        links = (Link(WORLD), *links)
        remarks = (f"{label}: link {WORLD!r} is used but not declared; it is taken as the base",)
    tree = Tree(root.get("name") or "robot", label, links, joints, remarks=remarks)
    if base == "fixed" or not links:
        return tree
    return with_free_base(tree, *(_name(element, label) for element in floating[:1]))


def _name(element: Element, label: str) -> str:
    name = element.get("name")
    if not name or not name.isprintable() or len(name) > 200:
        text, got = f"{label}: a <{element.tag}> has no usable name", repr(name and name[:40])
        raise RobotFileError(text, expected="name=... of 1 to 200 printable characters", got=got)
    return name


def _part(element: Element, tag: str, where: str) -> dict[str, Any]:
    """Return the parsed attributes of the only part with the given tag, or an empty mapping."""
    parts = element.findall(tag)
    if len(parts) > 1:
        raise RobotFileError(f"{where} has several <{tag}>", expected="one", got=len(parts))
    if not parts:
        return {}
    values: dict[str, Any] = dict(parts[0].attrib)
    error = InertiaError if tag in ("mass", "inertia") else RobotFileError
    for name in _NEEDED.get(tag, ()):
        if not values.get(name):
            raise error(f"{where}: <{tag}> has no {name}", expected=f'{name}="..."')
    for name, count in _NUMBERS.get(tag, {}).items():
        if name in values:
            at, infinite = f"{where}: {tag} {name}", tag == "limit"
            numbers = parse_numbers(values[name], at, count, infinite=infinite, error=error)
            values[name] = numbers[0] if count == 1 else np.array(numbers)
    return values


def _pose(element: Element, where: str) -> np.ndarray:
    origin = _part(element, "origin", where)
    rotation = Rotation.from_euler("xyz", origin.get("rpy", np.zeros(3)))
    return transform(rotation.as_matrix(), origin.get("xyz", np.zeros(3)))


def _link(element: Element, label: str) -> Link:
    name = _name(element, label)
    where = f"{label}: link {name!r}"
    inertials = element.findall("inertial")
    if len(inertials) > 1:
        raise RobotFileError(f"{where} has several <inertial>", expected="one", got=len(inertials))
    return Link(name, _inertial(inertials[0], where) if inertials else None)


def _inertial(element: Element, where: str) -> Inertial:
    mass, I = _part(element, "mass", where), _part(element, "inertia", where)
    for part, values in (("mass", mass), ("inertia", I)):
        if not values:
            raise InertiaError(f"{where} has an <inertial> without <{part}>", expected=f"<{part} .../>")
    rows = [["ixx", "ixy", "ixz"], ["ixy", "iyy", "iyz"], ["ixz", "iyz", "izz"]]
    T, inertia = _pose(element, where), np.array([[I[name] for name in row] for row in rows])
    return Inertial(mass["value"], T[:3, 3], T[:3, :3] @ inertia @ T[:3, :3].T)


def _joint(element: Element, label: str) -> Joint:
    name, kind = _name(element, label), element.get("type")
    where = f"{label}: joint {name!r}"
    if kind is None:
        raise RobotFileError(f"{where} has no type", expected="type=revolute, prismatic, ...")
    if kind not in _KINDS:
        text, expected = f"{where} is of type {kind!r}", "revolute, continuous, prismatic or fixed"
        raise UnsupportedRobotError(text, expected=expected, got=kind, hint=_INSTEAD.get(kind))
    tags = ("parent", "child", "axis", "limit", "dynamics", "mimic")
    parent, child, axis, limit, dynamics, mimic = (_part(element, tag, where) for tag in tags)
    for part, values in (("parent", parent), ("child", child)):
        if not values:
            raise RobotFileError(f"{where} has no <{part}>", expected=f'<{part} link="..."/>')
    ends = parent["link"], child["link"], _pose(element, where)
    if kind == "fixed":
        return Joint(name, "fixed", *ends)
    damping, friction = dynamics.get("damping", 0.0), dynamics.get("friction", 0.0)
    if min(damping, friction) < 0.0:
        text = f"{where} has negative friction"
        raise RobotFileError(text, expected="damping and friction ≥ 0", got=(damping, friction))
    return Joint(
        name,
        "prismatic" if kind == "prismatic" else "revolute",
        *ends,
        axis=_unit(axis.get("xyz", np.array([1.0, 0.0, 0.0])), where),
        damping=damping,
        friction=friction,
        drag=(0.0, 0.0),
        driven=True,
        **_limits(limit, kind, where),
        refused=f"mimics joint {mimic['joint']!r}" if mimic else "",
        follows=_coupling(mimic) if mimic else None,
    )


def _coupling(mimic: dict[str, Any]) -> Coupling:
    """Return q = offset + multiplier · leader."""
    return Coupling(mimic["joint"], (mimic.get("offset", 0.0), mimic.get("multiplier", 1.0)))


def _unit(axis: np.ndarray, where: str) -> np.ndarray:
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        text = f"{where} has an axis of length zero"
        raise RobotFileError(text, expected="a direction such as 0 0 1", got=axis.tolist())
    return axis / length


def _limits(limit: dict[str, Any], kind: str, where: str) -> dict[str, float]:
    """Return the limits of a joint. Missing or zero effort and velocity limits become infinite."""
    effort, velocity = (limit.get(name) or np.inf for name in ("effort", "velocity"))
    if min(effort, velocity) < 0.0:
        text = f"{where} has a negative limit"
        raise RobotFileError(text, expected="effort and velocity ≥ 0", got=(effort, velocity))
    limits = {"effort_limit": effort, "velocity_limit": velocity}
    if kind == "continuous" or not ("lower" in limit or "upper" in limit):
        return limits
    lower, upper = limit.get("lower", 0.0), limit.get("upper", 0.0)
    if lower > upper:
        text = f"{where} has its lower limit above its upper limit"
        raise RobotFileError(text, expected="lower ≤ upper", got=(lower, upper))
    return limits | {"lower": lower, "upper": upper}
