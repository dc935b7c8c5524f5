"""URDF files: validated here, parsed by yourdfpy."""

from __future__ import annotations

import io
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import yourdfpy

from forcegp.errors import InertiaError, RobotFileError, UnsupportedRobotError
from forcegp.robot.safety import parse_numbers, xacro_error
from forcegp.robot.tree import Inertial, Joint, Link, Tree, unit_axis

_LINK_PARTS = ("inertial",)
_JOINT_PARTS = ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic")
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
"""What to write for joint types that are not supported."""
_MOVING = ("revolute", "continuous", "prismatic")
WORLD = "world"
"""Name of the fixed surroundings, which some files use as a link without declaring it."""


def read_urdf(root: Element, label: str) -> Tree:
    """Links and joints of a URDF document.

    Args:
        root: its `<robot>` element.
        label: the file name for messages.

    Raises:
        RobotFileError: an element or a number is missing or not valid; the message names it.
        UnsupportedRobotError: a joint is of an unsupported type.
        InertiaError: a mass or an inertia is not a finite number.
    """
    _refuse_xacro(root, label)
    document = Element("robot", name=root.get("name") or "robot")
    for link in root.findall("link"):
        _copy(document, link, _LINK_PARTS, f"{label}: link {_name(link, label)!r}")
    for joint in root.findall("joint"):
        _copy_joint(document, joint, label)
    robot = yourdfpy.URDF.load(
        io.BytesIO(tostring(document, encoding="utf-8")), build_scene_graph=False, load_meshes=False
    ).robot
    joints = tuple(_joint(joint, f"{label}: joint {joint.name!r}") for joint in robot.joints)
    links = tuple(Link(link.name, _inertial(link)) for link in robot.links)
    if not _uses_undeclared_world(links, joints):
        return Tree(robot.name, label, links, joints)
    remark = f"{label}: link {WORLD!r} is used but not declared; it is taken as the base"
    return Tree(robot.name, label, (Link(WORLD), *links), joints, remarks=(remark,))


def _uses_undeclared_world(links: tuple[Link, ...], joints: tuple[Joint, ...]) -> bool:
    """Whether a fixed joint attaches the robot to a `world` that is not a link of the file, as in Drake."""
    attached = any(joint.parent == WORLD and joint.kind == "fixed" for joint in joints)
    return attached and all(link.name != WORLD for link in links)


def _refuse_xacro(root: Element, label: str) -> None:
    for element in root.iter():
        macros = [text for text in element.attrib.values() if "${" in text or "$(" in text]
        if macros or "xacro" in element.tag:
            raise xacro_error(label, macros[0][:80] if macros else f"<{element.tag.rpartition('}')[2]}>")


def _name(element: Element, label: str) -> str:
    name = element.get("name")
    if not name or not name.isprintable() or len(name) > 200:
        raise RobotFileError(
            f"{label}: a <{element.tag}> has no usable name",
            expected="name=... of 1 to 200 printable characters",
            got=repr(name and name[:40]),
        )
    return name


def _copy_joint(document: Element, joint: Element, label: str) -> None:
    where = f"{label}: joint {_name(joint, label)!r}"
    kind = joint.get("type")
    if kind is None:
        raise RobotFileError(f"{where} has no type", expected="type=revolute, prismatic, ...")
    if kind not in (*_MOVING, "fixed"):
        raise UnsupportedRobotError(
            f"{where} is of type {kind!r}",
            expected="revolute, continuous, prismatic or fixed",
            got=kind,
            hint=_INSTEAD.get(kind),
        )
    _copy(document, joint, _JOINT_PARTS, where)
    for part in ("parent", "child"):
        if joint.find(part) is None:
            raise RobotFileError(f"{where} has no <{part}>", expected=f'<{part} link="..."/>')


def _copy(document: Element, source: Element, parts: tuple[str, ...], where: str) -> None:
    """Copy the validated parts of a link or joint, so that nothing else reaches the parser."""
    copy = SubElement(document, source.tag, dict(source.attrib))
    for part in parts:
        elements = source.findall(part)
        if len(elements) > 1:
            raise RobotFileError(f"{where} has several <{part}>", expected="one", got=len(elements))
        if not elements:
            continue
        if part == "inertial":
            _check_inertial(elements[0], where)
            _copy(copy, elements[0], ("origin", "mass", "inertia"), where)
        else:
            _check_attributes(elements[0], where)
            SubElement(copy, part, dict(elements[0].attrib))


def _check_inertial(inertial: Element, where: str) -> None:
    for part in ("mass", "inertia"):
        if inertial.find(part) is None:
            raise InertiaError(f"{where} has an <inertial> without <{part}>", expected=f"<{part} .../>")


def _check_attributes(element: Element, where: str) -> None:
    tag = element.tag
    error = InertiaError if tag in ("mass", "inertia") else RobotFileError
    for attribute in _NEEDED.get(tag, ()):
        if not element.get(attribute):
            raise error(f"{where}: <{tag}> has no {attribute}", expected=f'{attribute}="..."')
    for attribute, count in _NUMBERS.get(tag, {}).items():
        text = element.get(attribute)
        if text is not None:
            infinite = tag == "limit"
            parse_numbers(text, f"{where}: {tag} {attribute}", count, infinite=infinite, error=error)


def _pose(origin: np.ndarray | None) -> np.ndarray:
    return np.eye(4) if origin is None else origin


def _inertial(link: yourdfpy.Link) -> Inertial | None:
    body = link.inertial
    if body is None or body.mass is None or body.inertia is None:
        return None
    T = _pose(body.origin)
    R = T[:3, :3]
    return Inertial(body.mass, T[:3, 3], R @ body.inertia @ R.T)


def _joint(joint: yourdfpy.Joint, where: str) -> Joint:
    placement = _pose(joint.origin)
    if joint.type == "fixed":
        return Joint(joint.name, "fixed", joint.parent, joint.child, placement)
    lower, upper, effort, velocity = _limits(joint, where)
    # yourdfpy leaves these two as strings.
    dynamics = joint.dynamics or yourdfpy.Dynamics()
    damping, friction = float(dynamics.damping or 0.0), float(dynamics.friction or 0.0)
    if min(damping, friction) < 0.0:
        raise RobotFileError(
            f"{where} has negative friction", expected="damping and friction ≥ 0", got=(damping, friction)
        )
    return Joint(
        name=joint.name,
        kind="prismatic" if joint.type == "prismatic" else "revolute",
        parent=joint.parent,
        child=joint.child,
        placement=placement,
        axis=unit_axis(joint.axis, where),
        damping=damping,
        friction=friction,
        lower=lower,
        upper=upper,
        velocity=velocity,
        effort=effort,
        refused=f"mimics joint {joint.mimic.joint!r}" if joint.mimic is not None else "",
        follows=_follows(joint.mimic),
    )


def _follows(mimic: yourdfpy.Mimic | None) -> tuple[str, float, float] | None:
    if mimic is None:
        return None
    # yourdfpy fills in the format's defaults, 1 and 0, where the file leaves them out.
    return mimic.joint, float(mimic.multiplier or 0.0), float(mimic.offset or 0.0)


def _limits(joint: yourdfpy.Joint, where: str) -> tuple[float, float, float, float]:
    """Position, effort and velocity limits; a limit of effort or velocity that is 0 or missing is none."""
    limit = joint.limit or yourdfpy.Limit()
    effort, velocity = limit.effort or np.inf, limit.velocity or np.inf
    if min(effort, velocity) < 0.0:
        raise RobotFileError(
            f"{where} has a negative limit", expected="effort and velocity ≥ 0", got=(effort, velocity)
        )
    if joint.type == "continuous" or (limit.lower is None and limit.upper is None):
        return -np.inf, np.inf, effort, velocity
    # The format's default for one that is left out is 0.
    lower, upper = limit.lower or 0.0, limit.upper or 0.0
    if lower > upper:
        raise RobotFileError(
            f"{where} has its lower limit above its upper limit", expected="lower ≤ upper", got=(lower, upper)
        )
    return lower, upper, effort, velocity
