"""What both file formats are read into: links and joints by name, before anything is checked or folded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from forcegp.errors import RobotFileError, UnknownNameError, UnsupportedRobotError

MAX_JOINTS = 500
JointKind = Literal["revolute", "prismatic", "fixed"]


@dataclass(frozen=True)
class Inertial:
    """Mass [kg], centre of mass [m] and inertia about it [kg m²], in the axes of the link."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Link:
    """A rigid link; `frame` tells whether its frame keeps a name in the robot."""

    name: str
    inertial: Inertial | None = None
    frame: bool = True


@dataclass(frozen=True)
class Joint:
    """A joint between two links; `refused` says why it is unsupported unless it is locked."""

    name: str
    kind: JointKind
    parent: str
    child: str
    placement: np.ndarray
    axis: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    refused: str = ""


@dataclass(frozen=True)
class Site:
    """A named frame fixed in a link."""

    name: str
    link: str
    placement: np.ndarray


@dataclass(frozen=True)
class Tree:
    """All links, joints and sites of a file; `label` is the file for messages."""

    name: str
    label: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    sites: tuple[Site, ...] = ()
    remarks: tuple[str, ...] = ()


def transform(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Homogeneous matrix of a pose."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def joint_motion(kind: JointKind, axis: np.ndarray, q: float) -> np.ndarray:
    """Pose of a link in its joint frame at joint position q."""
    if kind == "prismatic":
        return transform(np.eye(3), q * axis)
    return transform(Rotation.from_rotvec(q * axis).as_matrix(), np.zeros(3))


def unit_axis(axis: np.ndarray, where: str) -> np.ndarray:
    """The axis at length one.

    Raises:
        RobotFileError: its length is zero.
    """
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise RobotFileError(
            f"{where} has an axis of length zero", expected="a direction such as 0 0 1", got=axis.tolist()
        )
    return axis / length


def lock_joints(tree: Tree, locked: Mapping[str, float]) -> Tree:
    """The tree with some joints fixed at given positions [rad, m].

    Raises:
        UnknownNameError: a joint does not exist.
        RobotFileError: a position is not finite.
    """
    names = [joint.name for joint in tree.joints if joint.kind != "fixed"]
    for name, q in locked.items():
        if name not in names:
            raise UnknownNameError(f"joint of {tree.label} to lock", name, names)
        if not np.isfinite(q):
            raise RobotFileError(f"{tree.label}: joint {name!r} cannot be locked", expected="a number", got=q)

    def lock(joint: Joint) -> Joint:
        if joint.kind == "fixed" or joint.name not in locked:
            return joint
        motion = joint_motion(joint.kind, joint.axis, float(locked[joint.name]))
        return replace(joint, kind="fixed", placement=joint.placement @ motion, refused="")

    return replace(tree, joints=tuple(lock(joint) for joint in tree.joints))


def ordered_joints(tree: Tree) -> tuple[str, list[Joint]]:
    """The root link, and the joints depth first, parents before children, siblings as in the file.

    Raises:
        RobotFileError: the links and joints form no single tree.
        UnsupportedRobotError: a joint is of a kind that is not modelled.
    """
    _check_names(tree)
    root = _root(tree)
    children: dict[str, list[Joint]] = {}
    for joint in tree.joints:
        children.setdefault(joint.parent, []).append(joint)
    ordered: list[Joint] = []
    stack = children.get(root, [])[::-1]
    while stack:
        joint = stack.pop()
        ordered.append(joint)
        stack.extend(children.get(joint.child, [])[::-1])
    if len(ordered) < len(tree.joints):
        reached = {id(joint) for joint in ordered}
        cyclic = next(joint for joint in tree.joints if id(joint) not in reached)
        raise RobotFileError(
            f"{tree.label}: joint {cyclic.name!r} is part of a cycle",
            expected="a tree of links",
            got=f"link {cyclic.parent!r} hangs on itself",
            hint="open the loop and close it with a point constraint",
        )
    _check_kinds(tree)
    return root, ordered


def _check_names(tree: Tree) -> None:
    for kind, names in (("link", [link.name for link in tree.links]), ("joint", _joint_names(tree))):
        name, count = Counter(names).most_common(1)[0] if names else ("", 0)
        if count > 1:
            raise RobotFileError(
                f"{tree.label}: {kind} name {name!r} is not unique", expected="one of each", got=count
            )
    links = {link.name for link in tree.links}
    for joint in tree.joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                near = get_close_matches(link, links, n=1)
                raise RobotFileError(
                    f"{tree.label}: joint {joint.name!r} has an unknown {role} link {link!r}",
                    expected="one of " + _shown([link.name for link in tree.links]),
                    hint=f"did you mean {near[0]!r}?" if near else None,
                )
    for name, count in Counter(joint.child for joint in tree.joints).items():
        if count > 1:
            several = [joint.name for joint in tree.joints if joint.child == name]
            raise RobotFileError(
                f"{tree.label}: link {name!r} is the child of several joints",
                expected="one parent joint a link",
                got=_shown(several),
                hint="open the loop and close it with a point constraint",
            )


def _joint_names(tree: Tree) -> list[str]:
    return [joint.name for joint in tree.joints if joint.name]


def _root(tree: Tree) -> str:
    moved = {joint.child for joint in tree.joints}
    roots = [link.name for link in tree.links if link.name not in moved]
    if len(roots) == 1:
        return roots[0]
    if not tree.links:
        raise RobotFileError(f"{tree.label}: the file has no links", expected="at least one link", got=0)
    if not roots:
        raise RobotFileError(
            f"{tree.label}: joint {tree.joints[0].name!r} is part of a cycle",
            expected="one link that no joint moves, the base",
            got="every link is the child of a joint",
        )
    raise RobotFileError(
        f"{tree.label}: the links form several trees",
        expected="one link that no joint moves, the base",
        got=_shown(roots),
        hint="join them with fixed joints, or remove the links that nothing holds",
    )


def _check_kinds(tree: Tree) -> None:
    refused = [joint for joint in tree.joints if joint.refused]
    if refused:
        lock = ", ".join(f"{joint.name!r}: 0.0" for joint in refused)
        raise UnsupportedRobotError(
            f"{tree.label}: joint {refused[0].name!r} {refused[0].refused}",
            expected="revolute, continuous, prismatic or fixed joints that move independently",
            hint=f"lock it: load_robot(..., locked_joints={{{lock}}})",
        )
    moving = sum(joint.kind != "fixed" for joint in tree.joints)
    if not 1 <= moving <= MAX_JOINTS:
        raise RobotFileError(
            f"{tree.label}: the number of moving joints is not usable",
            expected=f"1 to {MAX_JOINTS} moving joints",
            got=moving,
        )


def _shown(names: list[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
