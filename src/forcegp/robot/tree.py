"""Tree of links and joints, common to URDF and MJCF files, and its validation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import scipy

from forcegp.errors import InertiaError, RobotFileError, UnsupportedRobotError, check_name, did_you_mean

JointKind = Literal["revolute", "prismatic", "fixed"]
Base = Literal["fixed", "free"]
FRICTION_VELOCITY = 0.1
"""Default speed scale of dry friction [rad/s, m/s], which robot files do not specify."""


@dataclass(frozen=True)
class Inertial:
    """Mass [kg], centre of mass [m] and inertia about the centre of mass [kg m²], in link axes."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Link:
    """A rigid link. It becomes a frame of the robot if `frame` is true."""

    name: str
    inertial: Inertial | None = None
    frame: bool = True


@dataclass(frozen=True)
class Coupling:
    """The position of a joint as a polynomial of the position of another, y = y₀ + Σ aᵢ (x − x₀)ⁱ.

    Attributes:
        leader: the other joint. If empty, the joint is held at y₀ + a₀.
        coefficients: a₀, a₁, … [rad, m].
        reference: y₀ [rad, m].
        leader_reference: x₀ [rad, m].
    """

    leader: str
    coefficients: tuple[float, ...]
    reference: float = 0.0
    leader_reference: float = 0.0

    def position(self, x: float) -> float:
        """Return y [rad, m]."""
        powers = enumerate(self.coefficients)
        return self.reference + sum(a * (x - self.leader_reference) ** i for i, a in powers)


@dataclass(frozen=True)
class Drive:
    """Armature, damping and dry friction that act on joints through a transmission, such as a gear.

    Attributes:
        name: description of the element in the file, used in messages.
        ratios: speed of the drive per joint speed; empty if it depends on the configuration.
        armature, damping, friction: parameters of the drive. A joint has ratio² times the first two.
        drag: quadratic and cubic damping of the drive.
        lugre: of dry friction with memory, σ₀, τ_c, τ_s and ω_s; empty without.
        gains: of an actuator, its gear and, of a servo, its stiffness and damping `kp` and `kv`.
    """

    name: str
    ratios: Mapping[str, float]
    armature: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    gains: Mapping[str, float] = field(default_factory=dict)
    drag: tuple[float, float] = (0.0, 0.0)
    lugre: tuple[float, ...] = ()


@dataclass(frozen=True)
class Joint:
    """A joint between two links.

    Attributes:
        drag, stribeck, stribeck_velocity, bristle: see `RobotModel`.
        refused: the reason why the joint must be locked, or an empty string.
        follows: the position that this joint has if it mimics another joint.
        locked: position at which the joint was locked [rad, m].
        driven: whether the joint has a drive, which those of a free base do not have.
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
    drag: tuple[float, float] = (0.0, 0.0)
    stribeck: float = 0.0
    stribeck_velocity: float = FRICTION_VELOCITY
    bristle: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    velocity_limit: float = np.inf
    effort_limit: float = np.inf
    refused: str = ""
    follows: Coupling | None = None
    locked: float | None = None
    driven: bool = True


@dataclass(frozen=True)
class Site:
    """A named frame fixed to a link."""

    name: str
    link: str
    placement: np.ndarray


@runtime_checkable
class Reference(Protocol):
    """The model that another library makes of the same file."""

    def equations(
        self, state: Mapping[str, tuple[float, float]], joints: Sequence[str], gravity: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return M, Q_G and Q_D of the joints at positions and velocities of all joints."""
        ...


@dataclass(frozen=True)
class Tree:
    """All links, joints, drives and sites in a file.

    Attributes:
        label: the file name used in messages.
        gravity: gravitational acceleration in the file [m/s²], or `None` if the format has none.
        reference: another library's model of the file, with which the robot is compared.
    """

    name: str
    label: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    sites: tuple[Site, ...] = ()
    remarks: tuple[str, ...] = ()
    drives: tuple[Drive, ...] = ()
    gravity: tuple[float, ...] | None = None
    reference: Reference | None = None


def transform(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the homogeneous matrix `(4, 4)` of a pose."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def joint_motion(kind: JointKind, axis: np.ndarray, q: float) -> np.ndarray:
    """Return the pose `(4, 4)` of a link in its joint frame at joint position q."""
    if kind == "prismatic":
        return transform(np.eye(3), q * axis)
    return transform(scipy.spatial.transform.Rotation.from_rotvec(q * axis).as_matrix(), np.zeros(3))


def lock_joints(tree: Tree, locked: Mapping[str, float]) -> Tree:
    """Lock the given joints [rad, m] and the joints that mimic them; raise typed errors for invalid names."""
    names = [joint.name for joint in tree.joints if joint.kind != "fixed"]
    for name, q in locked.items():
        check_name(f"joint of {tree.label} to lock", name, names)
        if not np.isfinite(q):
            raise RobotFileError(f"{tree.label}: joint {name!r} cannot be locked", expected="a number", got=q)

    held = {name: float(q) for name, q in locked.items()}
    followers = [(joint.name, joint.follows) for joint in tree.joints if joint.follows is not None]
    remarks = list(tree.remarks)
    # A follower may itself be the leader of another joint.
    for _, (name, follows) in product(followers, followers):
        if follows.leader in held:
            held.setdefault(name, follows.position(held[follows.leader]))
    for name, follows in followers:
        if name in locked and follows.leader and follows.leader not in held:
            text = f"is locked at {held[name]:g}, and in the file follows {follows.leader!r}"
            remarks.append(f"{tree.label}: joint {name!r} {text}")
        elif name in locked:
            q = follows.position(held.get(follows.leader, 0.0))
            if abs(held[name] - q) > ROUNDING * max(1.0, abs(q)):
                remarks.append(
                    f"{tree.label}: joint {name!r} is locked at {held[name]:g}, and in the file at {q:g}"
                )

    def lock(joint: Joint) -> Joint:
        if joint.kind == "fixed" or joint.name not in held:
            return joint
        q = held[joint.name]
        placement = joint.placement @ joint_motion(joint.kind, joint.axis, q)
        return replace(joint, kind="fixed", placement=placement, refused="", locked=q)

    return replace(tree, joints=tuple(lock(joint) for joint in tree.joints), remarks=tuple(remarks))


MAX_JOINTS = 500
ROUNDING = 1e-6
"""Relative error in principal moments due to rounding of the numbers in files."""


def checked(tree: Tree) -> Tree:
    """Validate a tree, and sort its joints depth-first with siblings in file order."""
    _check_names(tree)
    root = _root(tree)
    children: dict[str, list[Joint]] = {}
    for joint in tree.joints:
        children.setdefault(joint.parent, []).append(joint)
    joints: list[Joint] = []
    stack = children.get(root, [])[::-1]
    while stack:
        joint = stack.pop()
        joints.append(joint)
        stack.extend(children.get(joint.child, [])[::-1])
    if len(joints) < len(tree.joints):
        reached = {id(joint) for joint in joints}
        cyclic = next(joint for joint in tree.joints if id(joint) not in reached)
        raise RobotFileError(
            f"{tree.label}: joint {cyclic.name!r} is part of a cycle",
            expected="a tree of links",
            got=f"link {cyclic.parent!r} is its own ancestor",
            hint="open the loop and close it with a point constraint",
        )
    _check_kinds(tree)
    remarks = (*tree.remarks, *_check_inertia(tree, joints))
    return replace(tree, joints=tuple(joints), remarks=remarks)


def _check_inertia(tree: Tree, joints: list[Joint]) -> list[str]:
    """Check the inertia of each link. For a link that never moves, invalid inertia only causes a note."""
    moving: set[str] = set()
    for joint in joints:
        if joint.kind != "fixed" or joint.parent in moving:
            moving.add(joint.child)
    remarks = []
    for link in tree.links:
        if link.inertial is None:
            continue
        reason = inertia_error(link.inertial)
        if reason and link.name in moving:
            raise InertiaError(
                f"{tree.label}: the inertia of link {link.name!r} is not physical",
                expected="positive mass and a positive definite inertia",
                got=reason,
                hint="correct the <inertial> of this link",
            )
        doubt = reason or inertia_doubt(link.inertial)
        if doubt:
            remarks.append(f"{tree.label}: the inertia of link {link.name!r} is not physical: {doubt}")
    return remarks


def inertia_error(body: Inertial) -> str:
    """Return the reason why inertial parameters are unphysical, or an empty string (see `inertia_doubt`)."""
    mass, com, inertia = body.mass, body.com, body.inertia
    if not (np.isfinite(mass) and np.isfinite(com).all() and np.isfinite(inertia).all()):
        return "a value is not finite"
    if mass < 0.0:
        return f"the mass {mass:g} kg is negative"
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] < -ROUNDING * max(abs(moments[2]), 1e-12):
        return f"the inertia is not positive definite: a principal moment is {moments[0]:.6g} kg m²"
    return ""


def inertia_doubt(body: Inertial) -> str:
    """Return the reason why parameters are only approximately physical, or an empty string."""
    low, mid, high = np.linalg.eigvalsh(body.inertia)
    if body.mass == 0.0 and high > 0.0:
        return f"it has a rotational inertia of {high:.4g} kg m² but no mass"
    if high > (low + mid) * (1.0 + ROUNDING) + 1e-15:
        return (
            "its principal moments violate the triangle inequality "
            f"({low:.6g} + {mid:.6g} < {high:.6g} kg m²), so no mass distribution has them"
        )
    return ""


def _check_names(tree: Tree) -> None:
    joints = [joint.name for joint in tree.joints if joint.name]
    for kind, names in (("link", [link.name for link in tree.links]), ("joint", joints)):
        name, count = Counter(names).most_common(1)[0] if names else ("", 0)
        if count > 1:
            text = f"{tree.label}: {kind} name {name!r} is not unique"
            raise RobotFileError(text, expected="unique names", got=count)
    links = {link.name for link in tree.links}
    for joint in tree.joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                text = f"{tree.label}: joint {joint.name!r} has an unknown {role} link {link!r}"
                expected = "one of " + _shown([link.name for link in tree.links])
                raise RobotFileError(text, expected=expected, hint=did_you_mean(link, links))
    for name, count in Counter(joint.child for joint in tree.joints).items():
        if count > 1:
            several = [joint.name for joint in tree.joints if joint.child == name]
            text = f"{tree.label}: link {name!r} is the child of several joints"
            hint = "open the loop and close it with a point constraint"
            raise RobotFileError(text, expected="one parent joint per link", got=_shown(several), hint=hint)


def _root(tree: Tree) -> str:
    moved = {joint.child for joint in tree.joints}
    roots = [link.name for link in tree.links if link.name not in moved]
    if len(roots) == 1:
        return roots[0]
    if not tree.links:
        raise RobotFileError(f"{tree.label}: the file has no links", expected="at least one link", got=0)
    if not roots:
        text = f"{tree.label}: joint {tree.joints[0].name!r} is part of a cycle"
        got = "every link is the child of a joint"
        raise RobotFileError(text, expected="one link without a parent joint, the base", got=got)
    raise RobotFileError(
        f"{tree.label}: the links form several trees",
        expected="one link without a parent joint, the base",
        got=_shown(roots),
        hint="join them with fixed joints, or remove the links without a parent joint",
    )


def _check_kinds(tree: Tree) -> None:
    refused = [joint for joint in tree.joints if joint.refused]
    if refused:
        raise UnsupportedRobotError(
            f"{tree.label}: joint {refused[0].name!r} {refused[0].refused}",
            expected="revolute, continuous, prismatic or fixed joints that move independently",
            hint=f"lock these joints: load_robot(..., locked_joints={_lock(tree, refused)}), "
            "or locked_joints under [robot] in a scene file",
        )
    moving = sum(joint.kind != "fixed" for joint in tree.joints)
    if not 1 <= moving <= MAX_JOINTS:
        text = f"{tree.label}: {'too many moving joints' if moving else 'nothing in this file moves'}"
        hint = None if moving else "the file describes an object; a robot has revolute or prismatic joints"
        raise RobotFileError(text, expected=f"1 to {MAX_JOINTS} moving joints", got=moving, hint=hint)


def _lock(tree: Tree, refused: list[Joint]) -> dict[str, float]:
    """Return positions at which to lock the unsupported joints and the joints that they follow."""
    joints = {joint.name: joint for joint in tree.joints if joint.kind != "fixed"}
    lock: dict[str, float] = {}

    def position(name: str, followers: tuple[str, ...] = ()) -> float:
        joint, follows = joints[name], joints[name].follows
        q = float(np.clip(0.0, joint.lower, joint.upper))
        if follows is not None and not follows.leader:
            q = follows.position(0.0)
        elif follows is not None and follows.leader in joints and follows.leader not in followers:
            q = follows.position(position(follows.leader, (*followers, name)))
        return lock.setdefault(name, q)

    for joint in refused:
        position(joint.name)
    return lock


def _shown(names: list[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
