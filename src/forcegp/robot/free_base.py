"""A floating base as six joints: three slides along the world axes, then rotations about z, y and x.

The pose of the base in the world is p = (x, y, z) and R = R_z(yaw) R_y(pitch) R_x(roll), so all parts of the
library see ordinary joints. Angles are singular at a pitch of ±90°, where M is singular too. The joints have
no motor, no friction and no limits.
"""

from __future__ import annotations

from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np

from forcegp.errors import RobotFileError, UnsupportedRobotError
from forcegp.robot.tree import Base, Joint, JointKind, Link, Tree

KINDS: dict[str, JointKind] = {
    "base_x": "prismatic",
    "base_y": "prismatic",
    "base_z": "prismatic",
    "base_yaw": "revolute",
    "base_pitch": "revolute",
    "base_roll": "revolute",
}
BASE_JOINTS = tuple(KINDS)
"""Names of the joints, in order."""
_AXES = ("1 0 0", "0 1 0", "0 0 1", "0 0 1", "0 1 0", "1 0 0")
WORLD = "world"
"""Name of the fixed world."""
_POSE = ("pos", "quat", "axisangle", "euler", "xyaxes", "zaxis")


def with_free_base(tree: Tree, floating: str | None = None) -> Tree:
    """Return the tree with six joints between the world and the root link, or the child of a floating joint.

    Args:
        tree: links and joints, in which a floating joint counts as a fixed one.
        floating: name of this joint, if there is one.

    Raises:
        RobotFileError: a joint has the name of one of the six, or it is not clear which link is the base.
    """
    for joint in tree.joints:
        if joint.name in KINDS:
            text = f"{tree.label}: joint {joint.name!r} has the name of a joint of the free base"
            raise RobotFileError(text, expected=f"other names than {', '.join(BASE_JOINTS)}")
    children = {joint.child for joint in tree.joints}
    (root, *_) = [link.name for link in tree.links if link.name not in children] or [tree.links[0].name]
    below = [joint for joint in tree.joints if joint.parent == root]
    of_world = [joint for joint in tree.joints if joint.name == floating] if floating else below
    if floating is None and root == WORLD and [joint.kind for joint in below] != ["fixed"]:
        raise _unclear(tree.label, [joint.child for joint in below])
    if floating is not None and of_world[0].parent != root:
        raise _unclear(tree.label, [of_world[0].child])
    replaced = of_world if floating is not None or root == WORLD else []
    body = replaced[0].child if replaced else root
    ground = replaced[0].parent if replaced else WORLD
    links = tree.links if replaced or root == ground else (Link(ground), *tree.links)
    parents = (ground, *(f"{ground}/{name}" for name in BASE_JOINTS[:-1]))
    ends = zip(BASE_JOINTS, parents, (*parents[1:], body), _AXES, strict=True)
    joints = (
        Joint(name, KINDS[name], parent, child, np.eye(4), axis=np.array(axis.split(), dtype=float))
        for name, parent, child, axis in ends
    )
    others = (joint for joint in tree.joints if joint not in replaced)
    links = (*links, *(Link(name, frame=False) for name in parents[1:]))
    return replace(tree, links=links, joints=(*joints, *others))


def without_drives(tree: Tree, base: Base) -> Tree:
    """Return the tree in which the joints of a free base have no drive."""
    base_joints = BASE_JOINTS if base == "free" else ()
    joints = (replace(joint, driven=joint.driven and joint.name not in base_joints) for joint in tree.joints)
    return replace(tree, joints=tuple(joints))


def free_mjcf(root: Element, label: str) -> None:
    """Replace the free joint of an MJCF document by six joints, or add them to its only body in the world.

    Raises:
        RobotFileError: several bodies could be the base.
        UnsupportedRobotError: an actuator acts on the free joint.
    """
    worlds = root.findall("worldbody")
    bodies = [body for world in worlds for body in world.findall("body")]
    free = [body for body in bodies if _free_joints(body)]
    moving = free or [body for body in bodies if next(body.iter("joint"), None) is not None]
    names = [body.get("name", "(unnamed)") for body in moving]
    inside = any(part.tag == "freejoint" for world in worlds for part in world.iter()) and not free
    if len(moving) != 1 or inside or (not free and moving[0].find("joint") is not None):
        raise _unclear(label, names)
    (body,) = moving
    for joint in _free_joints(body):
        driven = [e for e in root.iter() if joint.get("name") and e.get("joint") == joint.get("name")]
        if driven:
            text = f"{label}: <{driven[0].tag}> acts on the free joint {joint.get('name')!r}"
            raise UnsupportedRobotError(text, expected="actuators of other joints only", hint="remove it")
        body.remove(joint)
    for name in _POSE:
        body.attrib.pop(name, None)
    for k, (name, kind) in enumerate(KINDS.items()):
        slide = "slide" if kind == "prismatic" else "hinge"
        values = {"name": name, "type": slide, "axis": _AXES[k], "pos": "0 0 0", "limited": "false"}
        plain = {"damping": "0", "frictionloss": "0", "armature": "0", "stiffness": "0", "ref": "0"}
        plain |= {"springdamper": "0 0", "actuatorfrclimited": "false"}
        body.insert(k, Element("joint", {**values, **plain}))


def _unclear(label: str, names: list[str]) -> RobotFileError:
    return RobotFileError(
        f"{label}: the base of the robot is not clear",
        expected="one link fixed to the world or with a floating joint; or one body in <worldbody> with a "
        "free joint, or without joints of its own",
        got=", ".join(map(repr, names)) or "no such link",
        hint="attach the robot to the world by one joint, outside of a <frame>",
    )


def _free_joints(body: Element) -> list[Element]:
    return [x for x in body if x.tag == "freejoint" or (x.tag == "joint" and x.get("type") == "free")]
