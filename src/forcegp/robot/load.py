"""Loading of a robot model from a bundled name, a URDF file or an MJCF file.

The ordered tree of links and joints becomes the robot model. Links are merged across fixed joints.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
import scipy
import torch

from forcegp.errors import (
    InertiaError,
    ParameterError,
    RobotFileError,
    RobotFileWarning,
    ShapeError,
    UnknownNameError,
    UnsupportedRobotError,
    check_name,
)
from forcegp.robot.free_base import without_drives
from forcegp.robot.model import BASE, RobotModel
from forcegp.robot.safety import parse_xml, read_bytes
from forcegp.robot.tree import (
    FRICTION_VELOCITY,
    Base,
    Drive,
    Inertial,
    Joint,
    Tree,
    checked,
    joint_motion,
    lock_joints,
)
from forcegp.robot.urdf import read_urdf

SINGULAR, WEIGHTLESS = 1e-12, 1e-10
"""Eigenvalue of the scaled mass matrix below which the matrix counts as singular in double precision; inertia
of a joint below which it counts as zero, relative to the mass that it moves times its distance squared. Axes
in files have about six digits, so mass on the axis of a joint contributes about 1e-11."""
COMPARED, DIFFERENT = 3, 1e-6
"""Number of random states at which a robot is compared with MuJoCo's model of the file; largest relative
difference. MuJoCo's rounding of inertias is about 1e-9."""
LIMB_JOINTS, WALKING_JOINTS, BODY_MASS = 2, 6, 1.0
"""Minimum number of joints in a limb; minimum number of joints and base mass [kg] of a robot that may walk
(hands are lighter)."""
GRAVITY, UNUSUAL = (0.0, 0.0, -9.81), 0.1
"""Gravitational acceleration unless the caller or the file states it; deviation that causes a note [m/s²]."""
OF_JOINTS = (
    "axis", "damping", "friction", "stribeck", "stribeck_velocity", "armature", "lower", "upper",
    "velocity_limit", "effort_limit",
)  # fmt: skip
"""Joint attributes that are copied unchanged from the file."""
OF_SOME = ("drag", "bristle")
"""Those that are `None` if they are zero for all joints."""


@dataclass(frozen=True)
class _Placed:
    """Moving joints and, for each link of the file, its moving joint and its pose in that joint's link."""

    moving: list[Joint]
    parents: list[int]
    placements: list[np.ndarray]
    links: dict[str, tuple[int, np.ndarray]]


def robot_of(tree: Tree, world: Mapping[str, np.ndarray]) -> RobotModel:
    """Build the robot from a tree; raise typed errors for ambiguous frames and for motion without inertia."""
    remarks, placed = list(tree.remarks), _place(tree.joints)
    remarks += _apply_drives(tree, placed)
    bodies = _merge(tree, placed)
    remarks += _held_base(tree, placed)
    _check_mass_matrix(tree, placed, bodies)
    _compare(tree, placed, bodies)
    frames = _frames(tree, placed, remarks)
    for remark in remarks:
        warnings.warn(remark, RobotFileWarning, stacklevel=3)
    moving = placed.moving
    poses = {"placement": np.stack(placed.placements), "frame": np.stack([T for _, _, T in frames])}
    values = {
        **{name: [getattr(joint, name) for joint in moving] for name in OF_JOINTS},
        **{name: [getattr(body, name) for body in bodies] for name in ("mass", "com", "inertia")},
        **{f"{name}_rotation": T[:, :3, :3] for name, T in poses.items()},
        **{f"{name}_position": T[:, :3, 3] for name, T in poses.items()},
        **{name: x for name in OF_SOME if np.any(x := [getattr(joint, name) for joint in moving])},
        "friction_velocity": np.full(len(moving), FRICTION_VELOCITY),
        **world,
    }
    return RobotModel(
        name=tree.name,
        joint_names=tuple(joint.name for joint in moving),
        joint_types=tuple("prismatic" if joint.kind == "prismatic" else "revolute" for joint in moving),
        parents=tuple(placed.parents),
        frame_names=tuple(name for name, _, _ in frames),
        frame_parents=tuple(index for _, index, _ in frames),
        remarks=tuple(remarks),
        undriven=tuple(joint.name for joint in moving if not joint.driven),
        **{name: torch.tensor(np.asarray(x, dtype=np.float64)) for name, x in values.items()},
    )


def _place(joints: tuple[Joint, ...]) -> _Placed:
    placed = _Placed([], [], [], {joints[0].parent: (BASE, np.eye(4))})
    for joint in joints:
        index, T = placed.links[joint.parent]
        T = T @ joint.placement
        if joint.kind == "fixed":
            placed.links[joint.child] = (index, T)
        else:
            placed.links[joint.child] = (len(placed.moving), np.eye(4))
            placed.moving.append(joint)
            placed.parents.append(index)
            placed.placements.append(T)
    return placed


def _held_base(tree: Tree, placed: _Placed) -> list[str]:
    """Return a note if a fixed base with mass carries several limbs, as in a walking robot."""
    limb: list[int] = []
    for i, parent in enumerate(placed.parents):
        limb.append(i if parent == BASE else limb[parent])
    limbs = [limb.count(i) for i in set(limb) if limb.count(i) >= LIMB_JOINTS]
    held = (link.inertial for link in tree.links if placed.links[link.name][0] == BASE)
    mass, root = sum(body.mass for body in held if body is not None), tree.joints[0].parent
    if len(limbs) < 2 or sum(limbs) < WALKING_JOINTS or mass < BODY_MASS:
        return []
    return [
        f"{tree.label}: no joint connects the base {root!r} ({mass:.3g} kg, with {len(limbs)} limbs) to the "
        'world, so it is fixed; a walking robot needs a floating base (base = "free")'
    ]


def _merge(tree: Tree, placed: _Placed) -> list[Inertial]:
    """Return the mass, centre of mass and inertia of each moving link, including links fixed to it."""
    parts: list[list[Inertial]] = [[] for _ in placed.moving]
    for link in tree.links:
        index, T = placed.links[link.name]
        if link.inertial is not None and index != BASE:
            body, R = link.inertial, T[:3, :3]
            parts[index].append(Inertial(body.mass, R @ body.com + T[:3, 3], R @ body.inertia @ R.T))
    return [_sum(bodies) for bodies in parts]


def _sum(bodies: list[Inertial]) -> Inertial:
    mass, com, inertia = sum((body.mass for body in bodies), 0.0), np.zeros(3), np.zeros((3, 3))
    for body in bodies:
        com += body.mass / (mass or 1.0) * body.com
    for body in bodies:
        d = body.com - com
        inertia += body.inertia + body.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Inertial(mass, com, 0.5 * (inertia + inertia.T))


def _apply_drives(tree: Tree, placed: _Placed) -> list[str]:
    """Add drives that act on one moving joint to that joint. Return a note for each friction that is lost.

    Armature and damping of other drives are left out, so `_compare` finds them. With a ratio N, a force F(q̇)
    of a drive acts on its joint as N F(N q̇).
    """
    index = {joint.name: i for i, joint in enumerate(placed.moving)}
    remarks = []
    for drive in tree.drives:
        ratios = {index[name]: ratio for name, ratio in drive.ratios.items() if ratio and name in index}
        if len(ratios) == 1:
            ((i, ratio),) = ratios.items()
            joint, size, square = placed.moving[i], abs(ratio), ratio * ratio
            b, c = joint.drag
            joint = replace(
                joint,
                armature=joint.armature + square * drive.armature,
                damping=joint.damping + square * drive.damping,
                friction=joint.friction + size * drive.friction,
                drag=(b + size * square * drive.drag[0], c + square * square * drive.drag[1]),
            )
            placed.moving[i] = _with_bristle(tree, joint, drive, size) if drive.lugre else joint
        elif (drive.friction or drive.lugre) and (ratios or not drive.ratios):
            remarks.append(f"{tree.label}: the frictionloss of {drive.name} is ignored")
    return remarks


def _with_bristle(tree: Tree, joint: Joint, drive: Drive, ratio: float) -> Joint:
    """Return a joint with the dry friction with memory of a drive."""
    if joint.bristle:
        raise UnsupportedRobotError(
            f"{tree.label}: joint {joint.name!r} has several kinds of dry friction with memory",
            expected="at most one actuator with lugre for each joint",
            got=drive.name,
        )
    stiffness, dry, static, speed = drive.lugre
    return replace(
        joint,
        friction=joint.friction + ratio * dry,
        stribeck=ratio * (static - dry),
        stribeck_velocity=speed / ratio if speed else FRICTION_VELOCITY,
        bristle=ratio * ratio * stiffness,
    )


def _check_mass_matrix(tree: Tree, placed: _Placed, bodies: list[Inertial]) -> None:
    """Reject robots that can move without kinetic energy. The test uses a generic configuration."""
    # The golden ratio spreads the joint positions, so that no axes are aligned by coincidence.
    q = 0.3 + (0.618034 * np.arange(1, len(bodies) + 1)) % 1.0
    rigid, _, size = _rigid_body(placed, bodies, q, np.zeros(3))
    M = rigid + np.diag([joint.armature for joint in placed.moving])
    light = np.flatnonzero(np.diag(M) <= WEIGHTLESS * size)
    if len(light) == 0:
        scale = np.sqrt(np.diag(M))
        values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
        if values[0] > SINGULAR:
            return
        index = int(np.abs(vectors[:, 0]).argmax())
    else:
        index = int(light[-1])
    joint, mass = placed.moving[index], bodies[index].mass
    raise InertiaError(
        f"{tree.label}: link {joint.child!r} of joint {joint.name!r} moves without inertia",
        expected="mass beyond every moving joint, for a positive definite mass matrix",
        got=f"link mass {mass:g} kg, and no link beyond it that resists the motion",
        hint="give the link an <inertial>, at least an estimate, or lock the joint with locked_joints",
    )


def _rigid_body(
    placed: _Placed, bodies: list[Inertial], q: np.ndarray, gravity: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return M without armature, Q_G, and Σ m d² of the mass beyond each joint at distance d from its origin.

    The distance includes those of both points from the base, since they determine the rounding error.
    """
    n = len(placed.moving)
    axes, origins = np.zeros((n, 3)), np.zeros((n, 3))
    poses, moves, M = list[np.ndarray](), np.zeros((n, n), dtype=bool), np.zeros((n, n))
    Q_G, size = np.zeros(n), np.zeros(n)
    turns = np.array([joint.kind == "revolute" for joint in placed.moving])
    for i, joint in enumerate(placed.moving):
        parent = placed.parents[i]
        start = placed.placements[i] if parent == BASE else poses[parent] @ placed.placements[i]
        poses.append(start @ joint_motion(joint.kind, joint.axis, float(q[i])))
        axes[i], origins[i] = start[:3, :3] @ joint.axis, start[:3, 3]
        moves[i] = moves[parent] if parent != BASE else False
        moves[i, i] = True
        J = np.flatnonzero(moves[i])
        R, body = poses[i][:3, :3], bodies[i]
        com = R @ body.com + poses[i][:3, 3]
        w = axes[J] * turns[J, None]
        v = np.where(turns[J, None], np.cross(axes[J], com - origins[J]), axes[J])
        M[np.ix_(J, J)] += body.mass * v @ v.T + w @ (R @ body.inertia @ R.T) @ w.T
        Q_G[J] += body.mass * v @ gravity
        distance = np.linalg.norm(com) + np.linalg.norm(origins[J], axis=-1)
        size[J] += body.mass * np.where(turns[J], distance**2, 1.0)
    return M, Q_G, size


def _compare(tree: Tree, placed: _Placed, bodies: list[Inertial]) -> None:
    """Compare M, Q_G and Q_D with the reference at random states; raise `UnsupportedRobotError`."""
    if tree.reference is None:
        return
    random, moving = np.random.default_rng(0), placed.moving
    held = {joint.name: (joint.locked, 0.0) for joint in tree.joints if joint.locked is not None}
    armature, damping, drag = (
        np.array([getattr(joint, name) for joint in moving]) for name in ("armature", "damping", "drag")
    )
    for _ in range(COMPARED):
        q, qd, gravity = (random.uniform(-1.0, 1.0, n) for n in (len(moving), len(moving), 3))
        state = {joint.name: (x, xd) for joint, x, xd in zip(moving, q, qd, strict=True)}
        theirs = tree.reference.equations(state | held, list(state), gravity)
        M, Q_G, _ = _rigid_body(placed, bodies, q, gravity)
        M += np.diag(armature)
        scale, size = np.sqrt(np.diag(M)), np.abs(qd)
        viscous = (damping + drag[:, 0] * size + drag[:, 1] * size**2) * qd
        checks = {
            "armature": np.abs(theirs[0] - M) / np.outer(scale, scale),
            "gravity": np.abs(theirs[1] - Q_G) / (np.abs(Q_G).max() + 1e-9),
            "damping": np.abs(theirs[2] + viscous) / (np.abs(viscous).max() + 1e-9),
        }
        for name, difference in checks.items():
            if difference.max() > DIFFERENT:
                raise _different(tree, moving, name, difference)


def _different(tree: Tree, moving: list[Joint], name: str, difference: np.ndarray) -> UnsupportedRobotError:
    """Return the error for a force or inertia in the file that the robot does not have."""
    names = {joint.name for joint in moving}
    acting = [d for d in tree.drives if not d.ratios or len(names & d.ratios.keys()) > 1]
    among = [d.name for d in acting if getattr(d, name, 0.0) or (name == "damping" and any(d.drag))]
    joint = moving[int(np.unravel_index(difference.argmax(), difference.shape)[0])].name
    what = "mass matrix" if name == "armature" else name
    return UnsupportedRobotError(
        f"{tree.label}: the {name} of {', '.join(among)} couples joints or depends on the configuration"
        if among
        else f"{tree.label}: the {what} at joint {joint!r} differs from that in MuJoCo",
        expected="armature and damping of single joints, and no other passive forces",
        got=f"a relative difference of {difference.max():.3g} at joint {joint!r}",
        hint=f"remove the {name}, or lock all but one of the joints with locked_joints",
    )


def _frames(tree: Tree, placed: _Placed, remarks: list[str]) -> list[tuple[str, int, np.ndarray]]:
    frames = [(link.name, *placed.links[link.name]) for link in tree.links if link.frame]
    taken = {name for name, _, _ in frames}
    for site in tree.sites:
        name, (index, T) = site.name, placed.links[site.link]
        if name in taken:  # in MJCF, a site and a body may share a name
            doubt = f"{tree.label}: site {name!r} shares its name with a body"
            name = f"site/{name}"
            if name in taken:
                raise UnsupportedRobotError(doubt, expected="different names")
            remarks.append(f"{doubt}; its frame is {name!r}")
        frames.append((name, index, T @ site.placement))
        taken.add(name)
    return frames


BUNDLED = ("double_pendulum", "franka_panda", "kuka_iiwa", "kuka_iiwa14", "ur5")


def load_robot(
    source: str | Path,
    *,
    base: Base = "fixed",
    base_position: Sequence[float | int] = (0.0, 0.0, 0.0),
    base_rpy: Sequence[float | int] = (0.0, 0.0, 0.0),
    gravity: Sequence[float | int] | None = None,
    locked_joints: Mapping[str, float] | None = None,
    coupling: Mapping[str, Mapping[str, float]] | Sequence[Sequence[float]] | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> RobotModel:
    """Load a robot model by the name of a bundled robot, or from a URDF or MJCF file.

    A usable but questionable file triggers a `RobotFileWarning`, which `robot.remarks` also lists.

    Args:
        source: `"kuka_iiwa"`, `"kuka_iiwa14"`, `"franka_panda"`, `"ur5"`, `"double_pendulum"`, or a file
            path.
        base: `"fixed"`, or `"free"` for a robot whose base moves. Its pose is given by six joints, `base_x`,
            `base_y`, `base_z`, `base_yaw`, `base_pitch` and `base_roll` (rotations about z, y, x), which
            replace a floating joint. They are singular at a pitch of ±90°.
        base_position: position of the root link in the world [m].
        base_rpy: roll, pitch and yaw of the root link about the world axes [rad].
        gravity: gravitational acceleration in the world [m/s²]. The default is that of an MJCF file, and
            (0, 0, −9.81) for other files.
        locked_joints: positions [rad, m] of joints to treat as fixed, such as those of a gripper.
        coupling: drives that also move with other joints. With `{"joint_6": {"joint_5": 1.0}}`, the drive of
            joint_6, behind its gear, moves by q₆ + q₅. Alternatively, the whole matrix C, whose rows are the
            drives: they move by C q, and torques τ on them act on the joints as Cᵀ τ.
        dtype: floating-point type of all constants.
        device: device of all constants.

    Returns:
        The frozen robot.

    Example:
        >>> robot = load_robot("kuka_iiwa", gravity=(0.0, 0.0, -9.8))
        >>> robot.nq, robot.joint_names[0]
        (7, 'lbr_iiwa_joint_1')

    Raises:
        UnknownNameError: the robot, the kind of base, or a joint to lock or to couple does not exist.
        ParameterError: the coupling is singular or not finite.
        RobotFileError: the file cannot be read or is invalid. The message names the link or joint.
        UnsupportedRobotError: a joint is a floating, planar, ball or mimic joint. The hint is to lock it.
        MissingDependencyError: the file is MJCF and MuJoCo is not installed.
        InertiaError: the inertia of a link is not physical.
        ShapeError: base_position, base_rpy or gravity is not a vector of three finite numbers, or the matrix
            of the coupling has the wrong shape.
    """
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", _vector(base_rpy, "base_rpy"))
    world = {"base_rotation": turn.as_matrix(), "base_position": _vector(base_position, "base_position")}
    world["gravity"] = _vector(GRAVITY if gravity is None else gravity, "gravity")
    check_name("base", base, get_args(Base))
    path = robot_path(source)
    tree = checked(lock_joints(read_tree(read_bytes(path), path, base), locked_joints or {}))
    if gravity is None and tree.gravity is not None:
        world["gravity"] = np.array(tree.gravity)
        if abs(np.linalg.norm(tree.gravity) - np.linalg.norm(GRAVITY)) > UNUSUAL:
            listed = ", ".join(f"{x:g}" for x in tree.gravity)
            text = f"{tree.label}: the gravity of the file is used, ({listed}) m/s²"
            tree = replace(tree, remarks=(*tree.remarks, text))
    robot = robot_of(tree, world)
    return robot.replace(coupling=coupling_of(coupling, robot.joint_names)).to(device, dtype)


def coupling_of(
    coupling: Mapping[str, Mapping[str, float]] | Sequence[Sequence[float]] | None, joints: Sequence[str]
) -> torch.Tensor | None:
    """Return the matrix C `(nq, nq)` of coupled drives, or `None` if each joint has its own drive.

    Raises:
        UnknownNameError, ShapeError, ParameterError: see `load_robot`.
    """
    if coupling is None or not len(coupling):
        return None
    C = np.eye(len(joints))
    if isinstance(coupling, Mapping):
        for drive, others in coupling.items():
            for joint, factor in others.items():
                for name in (drive, joint):
                    check_name("joint of the coupling", name, joints)
                C[joints.index(drive), joints.index(joint)] = factor
    else:
        rows = [len(row) for row in coupling]
        if rows != [len(joints)] * len(joints):
            expected = f"{len(joints)} rows of {len(joints)} numbers, for {', '.join(joints)}"
            raise ShapeError("the coupling of the drives has the wrong shape", expected=expected, got=rows)
        C = np.array(coupling, dtype=np.float64)
    if not np.isfinite(C).all() or not np.linalg.cond(C) < 1.0 / SINGULAR:
        raise ParameterError(
            "the coupling of the drives is singular",
            expected="a matrix C, with drives that move by C q, from whose motion that of all joints follows",
            got=C.tolist(),
        )
    return torch.from_numpy(C)


def robot_path(source: str | Path) -> Path:
    """Return the file for a bundled robot name or a path; raise `UnknownNameError` if neither exists."""
    path = Path(os.path.expanduser(source))  # an unknown user name is left unchanged
    if str(source) in BUNDLED:
        return Path(__file__).parent / "bundled" / f"{source}.urdf"
    if not path.suffix and path.name == str(source):
        raise UnknownNameError("robot", source, (*BUNDLED, "path of a .urdf or .xml file"))
    return path


def read_tree(data: bytes, path: Path, base: Base = "fixed") -> Tree:
    """Return the links and joints in the content of a file; raise `RobotFileError` if it is invalid."""
    root = parse_xml(data, str(path))
    if root.tag == "robot":
        return without_drives(read_urdf(root, str(path), base), base)
    if root.tag == "mujoco":
        from forcegp.robot.mjcf import read_mjcf  # loads MuJoCo, which is optional

        return without_drives(read_mjcf(root, path, base), base)
    expected = "a <robot> or a <mujoco> document"
    raise RobotFileError(f"{path}: neither URDF nor MJCF", expected=expected, got=f"<{root.tag[:60]}>")


def _vector(value: Sequence[float | int], name: str) -> np.ndarray:
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ShapeError(f"{name} is not valid", expected="three finite numbers", got=value)
    return vector
