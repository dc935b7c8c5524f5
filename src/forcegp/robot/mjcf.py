"""Reading of MJCF files, which are reduced to their mechanics and compiled by MuJoCo.

Classes, defaults and frames are resolved by MuJoCo. Its compiled model is the reference for the robot: the
loader compares both at random states. This module is imported only to read MJCF files, since it requires the
optional package `mujoco`.
"""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np
from scipy.spatial.transform import Rotation

from forcegp.errors import InertiaError, RobotFileError, UnsupportedRobotError, optional_module
from forcegp.robot.mjcf_reduce import reduce_mjcf, unsupported_equality
from forcegp.robot.tree import (
    Base,
    Coupling,
    Drive,
    Inertial,
    Joint,
    JointKind,
    Link,
    Site,
    Tree,
    joint_motion,
    transform,
)

mujoco = optional_module("mujoco", "Reading MJCF files")
_KINDS: dict[int, JointKind] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
}


def read_mjcf(root: Element, path: Path, base: Base = "fixed") -> Tree:
    """Return the links and joints of a `<mujoco>` document.

    Bodies become links, and bodies and sites become frames. Multiple joints of a body are separated by
    massless links. Typed errors quote MuJoCo's compiler, or name unsupported or unphysical elements.
    """
    document, remarks = reduce_mjcf(root, path, base)
    with _warnings_of_mujoco(str(path), remarks):
        model, gains, bristles = _compile(document, path)
        remarks += [f"{path}: {text} off by a flag" for text in _switched_off(model)]
    names = _names("body", [model.body(i).name for i in range(model.nbody)])
    joint_names = _names("joint", [model.joint(i).name for i in range(model.njnt)])
    coupled = _couplings(model, joint_names, path)
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
    weightless = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    return Tree(
        name=root.get("model", path.stem),
        label=str(path),
        links=tuple(links),
        joints=tuple(joints),
        sites=sites,
        remarks=(*remarks, *_tendon_forces(model, path), *_memory(model, bristles, path)),
        drives=tuple(_drives(model, joint_names, gains, bristles)),
        gravity=(0.0, 0.0, 0.0) if weightless else tuple(model.opt.gravity.tolist()),
        reference=_Compiled(model, joint_names),
    )


def _switched_off(model: Any) -> Iterator[str]:
    """Remove the forces that flags of a file switch off, and yield what they are."""
    bits, flags = mujoco.mjtDisableBit, model.opt.disableflags
    damper = int(bits.mjDSBL_DAMPER) if hasattr(bits, "mjDSBL_DAMPER") else int(bits.mjDSBL_PASSIVE)  # pyright: ignore[reportAttributeAccessIssue]
    for bit, force in ((damper, "damping"), (int(bits.mjDSBL_FRICTIONLOSS), "frictionloss")):
        if flags & bit:
            for owner in ("dof", "tendon", "actuator"):
                for name in (f"{owner}_{force}", f"{owner}_{force}poly"):
                    if hasattr(model, name):
                        getattr(model, name)[:] = 0.0
            yield f"{force} is switched"


def _names(kind: str, names: list[str]) -> list[str]:
    """Return names in which unnamed elements have their number, as in `body_3`, made unique by `_`."""
    taken = set(names)
    for i, name in enumerate(names):
        if not name:
            name = f"{kind}_{i}"
            while name in taken:
                name += "_"
            names[i] = name
            taken.add(name)
    return names


class _Compiled:
    """MuJoCo's model of a file as the `Reference`, without contacts, limits and tendon springs."""

    def __init__(self, model: Any, joint_names: list[str]) -> None:
        disabled = mujoco.mjtDisableBit
        model.opt.disableflags &= ~int(disabled.mjDSBL_GRAVITY)
        model.opt.disableflags |= int(disabled.mjDSBL_CONSTRAINT) | int(disabled.mjDSBL_CONTACT)
        model.tendon_stiffness[:] = 0.0
        self._model, self._data = model, mujoco.MjData(model)
        self._joints = {name: model.joint(i) for i, name in enumerate(joint_names)}

    def equations(
        self, state: Mapping[str, tuple[float, float]], joints: Sequence[str], gravity: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with _warnings_of_mujoco("", []):
            return self._equations(state, joints, gravity)

    def _equations(
        self, state: Mapping[str, tuple[float, float]], joints: Sequence[str], gravity: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model, data = self._model, self._data
        for name, (q, _) in state.items():
            data.qpos[self._joints[name].qposadr] = q
        data.qvel[:] = 0.0
        model.opt.gravity[:] = gravity
        mujoco.mj_forward(model, data)
        Q_G = -data.qfrc_bias
        for name, (_, qd) in state.items():
            data.qvel[self._joints[name].dofadr] = qd
        mujoco.mj_forward(model, data)
        dofs = np.concatenate([self._joints[name].dofadr for name in joints])
        M = np.zeros((len(dofs), model.nv))
        for row, unit in zip(M, np.eye(model.nv)[dofs], strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        return M[:, dofs], Q_G[dofs], data.qfrc_passive[dofs].copy()


_HANDLER = threading.RLock()
"""Lock held while MuJoCo's warning handler is replaced."""


@contextmanager
def _warnings_of_mujoco(label: str, remarks: list[str]) -> Iterator[None]:
    """Collect MuJoCo's warnings, which would otherwise be written to a log file in the working directory.

    The handler is global to the process. Only one reader at a time replaces and restores it. Warnings from
    other threads are passed on. `MjSpec.compile` issues Python warnings instead.
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
            with warnings.catch_warnings(record=True) as issued:
                warnings.simplefilter("always")
                yield
            remarks += [f"{label}: MuJoCo warns: {warning.message}" for warning in issued]
        finally:
            mujoco.set_mju_user_warning(before)


def _compile(document: Element, path: Path) -> tuple[Any, list[dict[str, float]], list[tuple[float, ...]]]:
    """Return MuJoCo's model of the document without meshes, and the gains and bristles of its actuators.

    Raise typed errors with the compiler's text."""
    spec = None
    try:
        spec = mujoco.MjSpec.from_string(tostring(document, encoding="unicode"))
        _drop_meshes(spec, path)
        bristles = [_bristle(actuator) for actuator in spec.actuators]
        gains = _reduce_constraints(spec, path)
        return spec.compile(), gains, bristles
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        if isinstance(error, UnsupportedRobotError):
            raise
        text = " ".join(str(error).split())
        message, kind = f"{path}: MuJoCo's compiler rejects the file", RobotFileError
        if re.search(r"mass|inertia", text):
            kind = InertiaError
            bodies = [] if spec is None else [b for b in spec.bodies if f"name '{b.name}'" in text]
            joints = [repr(joint.name) for body in bodies for joint in body.joints]
            message += f", at the body of joint {', '.join(joints)}" if joints else ""
        raise kind(message, expected="a valid MJCF model", got=text) from error


def _drop_meshes(spec: Any, path: Path) -> None:
    """Delete geoms that need a file; raise `UnsupportedRobotError` if a body takes its inertia from one."""
    compiler = spec.compiler
    for body, moves in _bodies(spec.worldbody, False):
        for geom in list(body.geoms):
            from_file = geom.meshname or geom.hfieldname or geom.type == mujoco.mjtGeom.mjGEOM_SDF
            if not from_file:
                continue
            if (moves or compiler.settotalmass > 0.0) and _has_mass(geom, body, compiler):
                name = body.name or "(unnamed)"
                raise UnsupportedRobotError(
                    f"{path}: body {name!r} takes its inertia from the mesh {from_file!r}",
                    expected="an <inertial>, or geoms that are primitive shapes",
                    hint="copy the inertia that MuJoCo computes from the mesh into an <inertial>",
                )
            spec.delete(geom)


def _bodies(parent: Any, moves: bool) -> Iterator[tuple[Any, bool]]:
    """Yield a body and its descendants, each with whether a joint moves it."""
    moves = moves or len(parent.joints) > 0
    yield parent, moves
    for body in parent.bodies:
        yield from _bodies(body, moves)


def _has_mass(geom: Any, body: Any, compiler: Any) -> bool:
    """Return whether the compiler would add the mass of a geom to its body."""
    always = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    never = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    first, last = compiler.inertiagrouprange
    if never or (body.explicitinertial and not always) or not first <= geom.group <= last:
        return False
    return geom.density != 0.0 if np.isnan(geom.mass) else geom.mass != 0.0


def _reduce_constraints(spec: Any, path: Path) -> list[dict[str, float]]:
    """Delete inactive equalities, refuse those that do not couple joints, and make motors of all actuators.

    The gain of a motor is that of an actuator whose control is a force, and 0 otherwise. Return the gear of
    each actuator and, of a servo, its stiffness `kp` and its damping `kv`, if it is not relative.
    """
    for equality in list(spec.equalities):
        if not equality.active:
            spec.delete(equality)
        elif equality.type != mujoco.mjtEq.mjEQ_JOINT:
            kind = equality.type.name.removeprefix("mjEQ_").lower()
            raise unsupported_equality(path, kind, equality.name1)
    plain = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE
    gains = []
    for actuator in spec.actuators:
        gain, bias = actuator.gainprm, actuator.biasprm
        servo = {"kp": gain[0] if bias[1] else 0.0, "kv": max(0.0, -bias[2])}
        gains.append({name: float(value) for name, value in {"gear": actuator.gear[0], **servo}.items()})
        of_force = (actuator.gaintype, actuator.biastype, actuator.dyntype) == plain
        gain = actuator.gainprm[0] if of_force else 0.0
        actuator.set_to_motor()
        actuator.gainprm[0], actuator.inheritrange, actuator.actdim = gain, 0.0, -1
        actuator.ctrlspec = 0  # MuJoCo before 4.0 keeps that of a passive motor
        actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    return gains


def _bristle(actuator: Any) -> tuple[float, ...]:
    """Return σ₀, τ_c, τ_s and ω_s of the LuGre friction of a DC motor, or an empty tuple without."""
    if actuator.dyntype != mujoco.mjtDyn.mjDYN_DCMOTOR or not actuator.dynprm[5] > 0.0:
        return ()
    dry, static, speed = (float(x) for x in actuator.biasprm[3:6])
    return float(actuator.dynprm[5]), dry, static if speed > 0.0 else dry, speed


def _couplings(model: Any, names: list[str], path: Path) -> dict[str, Coupling]:
    """Return y = y₀ + Σ aᵢ (x − x₀)ⁱ by the name of joint y. The references are the joints' `qpos0`."""
    coupled: dict[str, Coupling] = {}
    for e in range(model.neq):
        y, x, a = int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e, :5].tolist()
        y0 = float(model.qpos0[model.jnt_qposadr[y]])
        if names[y] in coupled:
            text = f"{path}: joint {names[y]!r} has several equality constraints"
            raise UnsupportedRobotError(text, expected="at most one for each joint")
        if x < 0:
            coupled[names[y]] = Coupling("", (a[0],), y0)
        else:
            coupled[names[y]] = Coupling(names[x], tuple(a), y0, float(model.qpos0[model.jnt_qposadr[x]]))
    return coupled


def _drives(
    model: Any, names: list[str], gains: list[dict[str, float]], bristles: list[tuple[float, ...]]
) -> Iterator[Drive]:
    """Yield the armature and damping of actuators and tendons, which act on the joints besides their own."""
    joint_types = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    tendons: list[dict[str, float]] = []
    for t in range(model.ntendon):
        wraps = range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
        fixed = all(model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT for w in wraps)
        ratios: dict[str, float] = {}
        for w in wraps if fixed else ():
            joint = names[model.wrap_objid[w]]
            ratios[joint] = ratios.get(joint, 0.0) + float(model.wrap_prm[w])
        tendons.append(ratios)
        yield Drive(
            f"tendon {model.tendon(t).name or t!r}",
            ratios,
            _parameter(model, "tendon_armature", t),
            _parameter(model, "tendon_damping", t),
            _parameter(model, "tendon_frictionloss", t),
            drag=_drag(model.tendon_dampingpoly[t]),
        )
    for a in range(model.nu):
        kind, target, gear = (
            int(model.actuator_trntype[a]),
            model.actuator_trnid[a, 0],
            model.actuator_gear[a, 0],
        )
        ratios = {names[target]: 1.0} if kind in joint_types else {}
        ratios = tendons[target] if kind == int(mujoco.mjtTrn.mjTRN_TENDON) else ratios
        yield Drive(
            f"actuator {model.actuator(a).name or a!r}",
            {joint: float(gear) * ratio for joint, ratio in ratios.items()},
            _parameter(model, "actuator_armature", a),
            _parameter(model, "actuator_damping", a),
            gains=gains[a],
            # MuJoCo multiplies all three coefficients by gear², at the speed of the joint or tendon.
            drag=_drag(model.actuator_dampingpoly[a] / (np.array([abs(gear), gear**2]) if gear else 1.0)),
            lugre=bristles[a],
        )


def _drag(coefficients: np.ndarray) -> tuple[float, float]:
    """Return b and c of the damping force (d + b |q̇| + c q̇²) q̇."""
    quadratic, cubic = coefficients.tolist()
    return quadratic, cubic


def _parameter(model: Any, name: str, index: int) -> float:
    """Return a parameter of an actuator or tendon, which is 0 in versions of MuJoCo that do not have it."""
    values = getattr(model, name, None)
    return 0.0 if values is None else float(values[index])


def _tendon_forces(model: Any, path: Path) -> Iterator[str]:
    """Yield a note for each tendon whose spring or limit is ignored."""
    for t in range(model.ntendon):
        forces = {"stiffness": model.tendon_stiffness[t] != 0.0, "limit": model.tendon_limited[t]}
        ignored = " and ".join(name for name, acts in forces.items() if acts)
        if ignored:
            yield f"{path}: the {ignored} of tendon {model.tendon(t).name or t!r} is ignored"


def _memory(model: Any, bristles: list[tuple[float, ...]], path: Path) -> Iterator[str]:
    """Yield a note on the friction with memory of actuators."""
    for name in (model.actuator(a).name or repr(a) for a, bristle in enumerate(bristles) if bristle):
        yield f"{path}: LuGre friction of actuator {name} is that of a joint that keeps sliding"


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
    if model.jnt_stiffness[j] or model.jnt_stiffnesspoly[j].any():
        refused = "has a spring, which is not modelled"
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
        drag=_drag(model.dof_dampingpoly[dof]),
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
        gain = abs(float(model.actuator_gainprm[a, 0]))
        if model.actuator_ctrllimited[a] and gain > 0.0:
            limit = min(limit, gain * float(np.abs(model.actuator_ctrlrange[a]).max()))
        efforts.append(gear * limit if limit < np.inf else np.inf)
    return min(effort, sum(efforts)) if efforts else effort
