"""The tree of links and joints that URDF and MJCF files are read into."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import scipy

from forcegp.errors import RobotFileError, UnknownNameError

JointKind = Literal["revolute", "prismatic", "fixed"]


@dataclass(frozen=True)
class Inertial:
    """Mass [kg], centre of mass [m] and inertia about it [kg m²], in the axes of the link."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Link:
    """A rigid link; `frame` says whether the robot keeps its frame."""

    name: str
    inertial: Inertial | None = None
    frame: bool = True


@dataclass(frozen=True)
class Joint:
    """A joint between two links.

    Attributes:
        refused: why the joint is not supported unless it is locked, or "".
        follows: the joint that this one mimics, with multiplier and offset.
    """

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
    follows: tuple[str, float, float] | None = None


@dataclass(frozen=True)
class Site:
    """A named frame fixed in a link."""

    name: str
    link: str
    placement: np.ndarray


@dataclass(frozen=True)
class Tree:
    """All links, joints and sites of a file; `label` is the file name for messages."""

    name: str
    label: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    sites: tuple[Site, ...] = ()
    remarks: tuple[str, ...] = ()


def transform(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Homogeneous matrix `(4, 4)` of a pose."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def joint_motion(kind: JointKind, axis: np.ndarray, q: float) -> np.ndarray:
    """Pose of a link in its joint frame at joint position q."""
    if kind == "prismatic":
        return transform(np.eye(3), q * axis)
    return transform(scipy.spatial.transform.Rotation.from_rotvec(q * axis).as_matrix(), np.zeros(3))


def unit_axis(axis: np.ndarray, where: str) -> np.ndarray:
    """The axis, scaled to unit length.

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
    """The tree with some joints fixed at given positions [rad, m], and with them the joints that follow them.

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

    held = _with_followers(tree, locked)

    def lock(joint: Joint) -> Joint:
        if joint.kind == "fixed" or joint.name not in held:
            return joint
        motion = joint_motion(joint.kind, joint.axis, held[joint.name])
        return replace(joint, kind="fixed", placement=joint.placement @ motion, refused="")

    return replace(tree, joints=tuple(lock(joint) for joint in tree.joints))


def _with_followers(tree: Tree, locked: Mapping[str, float]) -> dict[str, float]:
    """Positions of locked joints and of those that mimic them, q = multiplier · leader + offset."""
    held = {name: float(q) for name, q in locked.items()}
    for _ in tree.joints:  # a follower may lead another joint
        for joint in tree.joints:
            if joint.follows is not None and joint.follows[0] in held:
                leader, multiplier, offset = joint.follows
                held.setdefault(joint.name, multiplier * held[leader] + offset)
    return held
