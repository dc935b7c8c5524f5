"""Reading of MJCF files, which are reduced to their mechanics and compiled by MuJoCo.

This module is imported only to read MJCF files, since it requires the optional package `mujoco`.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np
from scipy.spatial.transform import Rotation

from forcegp.errors import InertiaError, RobotFileError, UnsupportedRobotError, optional_module
from forcegp.robot.mjcf_reduce import Coupling, reduce_mjcf
from forcegp.robot.tree import Inertial, Joint, JointKind, Link, Site, Tree, joint_motion, transform

mujoco = optional_module("mujoco", "Reading MJCF files")
_KINDS: dict[int, JointKind] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
}


def read_mjcf(root: Element, path: Path) -> Tree:
    """Return the links and joints of a `<mujoco>` document.

    Bodies become links, and bodies and sites become frames. Multiple joints of a body are separated by
    massless links. Typed errors quote MuJoCo's compiler, or name unsupported or unphysical elements.
    """
    document, coupled, remarks = reduce_mjcf(root, path)
    with _warnings_of_mujoco(str(path), remarks):
        model = _compile(document, str(path))
    names = [model.body(i).name or f"body_{i}" for i in range(model.nbody)]
    joint_names = [model.joint(i).name or f"joint_{i}" for i in range(model.njnt)]
    links = [Link(names[0])]
    joints: list[Joint] = []
    for b in range(1, model.nbody):
        if model.body_gravcomp[b] != 0.0:
            raise UnsupportedRobotError(f"{path}: body {names[b]!r} has gravity compensation")
        links.append(Link(names[b], _inertial(model, b)))
        chain = _chain(model, b, names, joint_names, coupled, str(path))
        links += [Link(joint.child, frame=False) for joint in chain[:-1]]
        joints += chain
    sites = tuple(
        Site(name, names[model.site_bodyid[i]], _pose(model.site_pos[i], model.site_quat[i]))
        for i in range(model.nsite)
        if (name := model.site(i).name)
    )
    name = root.get("model", path.stem)
    return Tree(name, str(path), tuple(links), tuple(joints), sites, tuple(remarks))


_HANDLER = threading.RLock()
"""Lock held while MuJoCo's warning handler is replaced."""


@contextmanager
def _warnings_of_mujoco(label: str, remarks: list[str]) -> Iterator[None]:
    """Collect MuJoCo's warnings, which would otherwise be written to a log file in the working directory.

    The handler is global to the process. Only one reader at a time replaces and restores it. Warnings from
    other threads are passed on.
    """
    thread = threading.get_ident()
    with _HANDLER:
        before = mujoco.get_mju_user_warning()

        def note(text: str) -> None:
            if threading.get_ident() == thread:
                remarks.append(f"{label}: MuJoCo warns: {text}")
            elif before is not None:
                before(text)

        mujoco.set_mju_user_warning(note)
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(before)


def _compile(document: Element, label: str) -> Any:
    try:
        return mujoco.MjModel.from_xml_string(tostring(document, encoding="unicode"))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        kind = InertiaError if re.search(r"mass|inertia", text) else RobotFileError
        message = f"{label}: MuJoCo's compiler rejects the file"
        raise kind(message, expected="a valid MJCF model", got=text) from error


def _pose(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    # MuJoCo puts the real part of a quaternion first, SciPy last.
    return transform(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix(), position)


def _inertial(model: Any, b: int) -> Inertial | None:
    if model.body_mass[b] == 0.0 and not model.body_inertia[b].any():
        return None
    R = _pose(model.body_ipos[b], model.body_iquat[b])[:3, :3]
    inertia = R @ np.diag(model.body_inertia[b]) @ R.T
    return Inertial(float(model.body_mass[b]), model.body_ipos[b].copy(), inertia)


def _chain(
    model: Any, b: int, names: list[str], joint_names: list[str], coupled: dict[str, Coupling], label: str
) -> list[Joint]:
    """Return the joints of body b in order, each at its anchor, followed by the fixed joint to its frame."""
    parent, placement = names[model.body_parentid[b]], _pose(model.body_pos[b], model.body_quat[b])
    chain: list[Joint] = []
    anchor = np.zeros(3)
    for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
        step = transform(np.eye(3), model.jnt_pos[j] - anchor)
        joint = _joint(model, j, joint_names[j], names[b], coupled.get(joint_names[j]), label)
        chain.append(replace(joint, parent=parent, placement=placement @ step @ joint.placement))
        parent, placement, anchor = joint.child, np.eye(4), model.jnt_pos[j].copy()
    chain.append(Joint("", "fixed", parent, names[b], placement @ transform(np.eye(3), -anchor)))
    return chain


def _joint(model: Any, j: int, name: str, body: str, follows: Coupling | None, label: str) -> Joint:
    """Return joint j of a body, placed at zero joint position, before links are assigned to it."""
    kind, dof = _KINDS.get(int(model.jnt_type[j])), model.jnt_dofadr[j]
    if kind is None:
        word = "free (floating)" if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE else "ball"
        text = f"{label}: joint {name!r} of link {body!r} is a {word} joint"
        hint = "remove the free joint to hold the robot by its base" if "free" in word else None
        raise UnsupportedRobotError(text, expected="hinge and slide joints", got=word, hint=hint)
    relation = f"mimics joint {follows.leader!r}" if follows and follows.leader else "is held in place"
    refused = f"{relation} by an equality constraint" if follows else ""
    if model.jnt_stiffness[j] or model.jnt_stiffnesspoly[j].any() or model.dof_dampingpoly[dof].any():
        refused = "has a spring or nonlinear damping, which is not modelled"
    axis = model.jnt_axis[j].copy()
    start = float(model.qpos0[model.jnt_qposadr[j]])
    limits = model.jnt_range[j] if model.jnt_limited[j] else (-np.inf, np.inf)
    return Joint(
        name=name,
        kind=kind,
        parent="",
        child=f"{body}/{name}",
        placement=joint_motion(kind, axis, -start),
        axis=axis,
        damping=float(model.dof_damping[dof]),
        friction=float(model.dof_frictionloss[dof]),
        armature=float(model.dof_armature[dof]),
        lower=float(limits[0]),
        upper=float(limits[1]),
        effort_limit=_effort(model, j),
        refused=refused,
        follows=follows,
    )


def _effort(model: Any, j: int) -> float:
    """Return the largest force that the limits of the joint, its actuators and its motors allow."""
    effort = float(np.abs(model.jnt_actfrcrange[j]).max()) if model.jnt_actfrclimited[j] else np.inf
    of_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    efforts = []
    for a in np.flatnonzero(of_joint & (model.actuator_trnid[:, 0] == j)).tolist():
        gear, limit = abs(float(model.actuator_gear[a, 0])), np.inf
        if model.actuator_forcelimited[a]:
            limit = float(np.abs(model.actuator_forcerange[a]).max())
        if model.actuator_ctrllimited[a] and model.actuator(a).name.startswith("motor"):
            limit = min(limit, float(np.abs(model.actuator_ctrlrange[a]).max()))
        efforts.append(gear * limit if limit < np.inf else np.inf)
    return min(effort, sum(efforts)) if efforts else effort
