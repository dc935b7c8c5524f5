"""Feet of legged robots that MuJoCo moves: forces along the log, learned on one gait and tested on another.

    python benchmarks/legs.py --json legs.json            # three robots, three frictions, two seeds
    python benchmarks/legs.py --robot solo12 --friction coulomb --seeds 0
    python benchmarks/legs.py --case touchdown         # labels of closed feet from an imported log
    python benchmarks/legs.py --case rollout --robot solo12 --friction coulomb --seeds 0

The true robot has joint friction, a payload of a tenth of its mass on the trunk, and links that differ from
the file by 5 %. Torques, encoders and the IMU are noisy. Training logs hold standing, swaying and a trot;
the test is a walk. A biped with flat feet of four balls each, waist and arms locked, steps in place and then
walks. The force of each foot along the log is compared with the engine's, as are pushes on the trunk while
swaying.

- `legs`: −J⁻ᵀτ of each leg by itself, with gravity and motion of the leg's links ignored.
- `equations of motion`: M q̈ − Q_K − τ = Σ JᵀF with the file, by generalized least squares.
- `identified`: the same with friction, trunk and links by least squares from the training log.
- `forcegp`: `contact_force` of a default fit.

`--case touchdown` imports a trot and a walk of 30 s each with `source = "multiplier"` for all feet, and
compares touch-down and lift-off with the engine's. A flight is an interval of 50 ms or more without force.
The first second, in which steps grow from zero, counts separately. Encoders are noisy, and the base is either
exact or that of an estimator, which is off by 5 mm.

`--case rollout` predicts half a second of a gait and a hop from single states, with the servos as a feedback
law, with the fit and with the robot file. Errors are the RMS over this time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch
from numpy.typing import NDArray
from real_cases import example_file
from results_page import table
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import forcegp
from forcegp.errors import optional_module
from forcegp.kinematics import frame_jacobian
from forcegp.logs import import_log, parse_mapping
from forcegp.rollout import RolloutOptions
from forcegp.rows import intervals

mujoco = optional_module("mujoco", "This benchmark")
Array = NDArray[np.float64]
FRICTIONS = ("coulomb", "soft", "dahl")
DISTANCE = 0.02
"""Over which Dahl's friction develops [rad]."""
HARD = 0.002
"""Time constant of Coulomb friction [s]. That of `soft`, MuJoCo's default, is 0.02 s: joints creep, and their
friction depends on their acceleration."""
STEP, RATE = 0.0005, 500
"""Time step of the engine [s] and rate of the log [Hz]."""
SECONDS = {"train": 20.0, "test": 10.0, "labels": 30.0, "rollout": 4.0}
STICKS, ROLLED, STARTS = 0.02, 0.5, (1.2, 1.8, 2.4, 3.0)
"""Speed below which feet stick [m/s], and duration and starts [s], in rollouts."""
EVERY, TESTED = 5, 5
"""Every so many rows are learned from, and tested."""
LINKS, PAYLOAD = 0.05, 0.1
"""Relative errors of links, and payload of the trunk over the mass of the robot."""
GYRO, ACCELEROMETER = 4e-3, 0.03
"""White noise of the IMU at 500 Hz [rad/s, m/s²], of 2.4e-4 rad/s/√Hz and 1.7e-3 m/s²/√Hz as in the data
sheet of the Bosch BMI088."""
TURNING, TORQUE = 2.0, 0.005
"""White noise of accelerations from differences of encoders and of the gyro [rad/s²], and of torques over the
largest torque."""
ENCODER = 1.2e-4
"""White noise of encoders [rad], which the default filter turns into `TURNING`."""
DRIFT = {"position": 3e-3, "velocity": 0.01, "correlation": 0.1, "leak": 2.0, "turn": 2e-3}
"""Errors of an estimator of the base: constant [m], of the velocity with its correlation time [m/s, s], which
the position forgets after some seconds, and of the orientation [rad]. The position is off by 5 mm RMS."""
FLIGHT, TOLERANCE, STARTED = 0.05, 0.01 + 1e-9, 1.0
"""Least duration of a flight, tolerance of a found touch-down or lift-off, and duration of the start [s]."""
FALLEN = 0.5
"""Cosine of the tilt of the trunk from which on a robot has fallen."""
METHODS = ("legs", "equations of motion", "identified", "forcegp")


@dataclass(frozen=True)
class Kind:
    """A legged robot of example-robot-data: its file, frames of the feet, radius of a foot [m], angles
    of joints while standing, stiffness of servos [N m/rad], height of a step [m], inertia of drives, usual
    torque, which friction is relative to [N m], damping of servos over their stiffness [s], size and pace of
    the sway over those of quadrupeds, largest push over the weight, joints that are locked, and balls of a
    foot, which are several for a flat one [m]."""

    path: str
    feet: tuple[str, ...]
    radius: float
    stand: dict[str, float]
    stiffness: float
    lift: float
    drive: float
    load: float
    damping: float = 0.03
    sway: tuple[float, float] = (1.0, 1.0)
    push: float = 0.2
    locked: str = "$"
    balls: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)

    @property
    def contacts(self) -> dict[str, tuple[str, tuple[float, float, float]]]:
        """Foot and place of each contact."""
        name = "{}" if len(self.balls) == 1 else "{}_{}"
        return {name.format(foot, k): (foot, ball) for foot in self.feet for k, ball in enumerate(self.balls)}


ROBOTS = {
    "solo12": Kind(
        "solo_description/robots/solo12.urdf",
        ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"),
        0.016,
        {"F._HFE": 0.8, "F._KFE": -1.6, "H._HFE": -0.8, "H._KFE": 1.6},
        8.0,
        0.04,
        5e-4,
        0.8,
    ),
    "a1": Kind(
        "a1_description/urdf/a1.urdf",
        ("FL_foot", "FR_foot", "RL_foot", "RR_foot"),
        0.02,
        {".*thigh.*": 0.8, ".*calf.*": -1.6},
        120.0,
        0.04,
        8e-3,
        12.0,
    ),
    "g1": Kind(
        "g1_description/urdf/g1_29dof_rev_1_0.urdf",
        ("left_ankle_roll_link", "right_ankle_roll_link"),
        0.005,
        {".*hip_pitch.*": -0.6, ".*knee.*": 1.2, ".*ankle_pitch.*": -0.6},
        1000.0,
        0.03,
        0.04,
        30.0,
        damping=0.015,
        sway=(0.5, 0.35),
        push=0.05,
        locked="(waist|.*shoulder|.*elbow|.*wrist).*",
        balls=((-0.05, 0.025, -0.03), (-0.05, -0.025, -0.03), (0.12, 0.03, -0.03), (0.12, -0.03, -0.03)),
    ),
}


@dataclass(frozen=True)
class Gait:
    """Wanted positions of the contacts `(contacts, 3)` in axes of the trunk over time, and shares of the
    weight `(feet,)` for which servos are given torques ahead."""

    places: Callable[[float], Array]
    share: Callable[[float], Array] | None = None


class Legged:
    """A legged robot in MuJoCo that differs from its file, and the servos that make it walk."""

    def __init__(self, name: str, friction: str, seed: int) -> None:
        self.kind, self.random = ROBOTS[name], np.random.default_rng(seed)
        self.path = example_file(self.kind.path)
        movable = forcegp.load_robot(self.path, base="free").joint_names
        self.locked = dict.fromkeys((x for x in movable if re.match(self.kind.locked, x)), 0.0)
        self.robot = forcegp.load_robot(self.path, base="free", locked_joints=self.locked)
        self.names = self.robot.joint_names[6:]
        self.contacts = self.kind.contacts
        self.nominal, self.true = self._model(), self._model()
        model, random = self.true, self.random
        total = model.body_mass.sum()
        factor = 1.0 + LINKS * random.uniform(-1.0, 1.0, model.nbody)
        model.body_mass[:] *= factor
        model.body_inertia[:] *= factor[:, None]
        self.payload = PAYLOAD * total
        self.dof = np.array([model.joint(joint).dofadr[0] for joint in self.names])
        self.at = self.dof + 1
        self.base = int(model.jnt_bodyid[0])
        self.trunk = trunk = int(np.argmax(model.body_mass))
        self.place = random.uniform(-0.1, 0.1, 3) * (1.0, 0.5, 0.3)
        _add_mass(model, trunk, self.payload, self.place)
        load, n = self.kind.load, len(self.names)
        model.dof_armature[self.dof] = self.kind.drive * random.uniform(0.5, 1.5, n)
        self.dry = np.zeros(model.nv)
        self.dry[self.dof] = 0.08 * load * random.uniform(0.5, 1.5, n)
        model.dof_damping[self.dof] = 0.02 * load * random.uniform(0.5, 1.5, n)
        self.friction = friction
        if friction != "dahl":
            model.dof_frictionloss[:] = self.dry
        if friction == "coulomb":
            model.dof_solref[:, 0] = HARD
        self.points = [(model.body(foot).id, np.array(ball)) for foot, ball in self.contacts.values()]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self.stand = self._standing()

    def _model(self) -> Any:
        """The file as MuJoCo reads it, with a free base, balls for feet, and a floor."""
        root = ElementTree.parse(self.path).getroot()
        for link in root.findall("link"):
            for shape in (*link.findall("visual"), *link.findall("collision")):
                link.remove(shape)
        for joint in root.findall("joint"):
            if joint.get("name") in self.locked:
                joint.set("type", "fixed")
        extension = ElementTree.SubElement(root, "mujoco")
        ElementTree.SubElement(extension, "compiler", fusestatic="false")
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.worldbody.first_body().add_freejoint()
        floor = {"solref": [0.005, 1.0], "friction": [0.8, 0.005, 0.0001]}
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[20.0, 20.0, 0.1], **floor)
        for name, (foot, ball) in self.contacts.items():
            sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [self.kind.radius, 0, 0], "mass": 0.0}
            spec.body(foot).add_geom(name=name, pos=ball, **sphere, **floor)
        spec.option.timestep = STEP
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        return spec.compile()

    def _standing(self) -> Array:
        """Angles of the joints while standing."""
        q = np.zeros(len(self.names))
        for pattern, angle in self.kind.stand.items():
            q[[re.match(pattern, name) is not None for name in self.names]] = angle
        return q

    def angles(self, wanted: Callable[[float], Array], times: Array) -> Array:
        """Angles `(n, joints)` that place the contacts at wanted positions `(contacts, 3)`, in trunk axes."""
        model, q, rows = self.nominal, self.stand.copy(), []
        data = mujoco.MjData(model)
        J = np.zeros((3, model.nv))
        for t in times:
            for _ in range(3):
                data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *np.zeros(len(q))]
                data.qpos[self.at] = q
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                A, e = [], []
                for (body, _), point, place in zip(self.points, self._places(data), wanted(t), strict=True):
                    mujoco.mj_jac(model, data, J, None, point, body)
                    A.append(J[:, self.dof].copy())
                    e.append(place - point)
                q = q + np.linalg.lstsq(np.concatenate(A), np.concatenate(e), rcond=1e-3)[0]
            rows.append(q.copy())
        return np.array(rows)

    def _places(self, data: Any) -> Array:
        """Positions of the contacts `(contacts, 3)` in the world."""
        return np.array([data.xpos[b] + data.xmat[b].reshape(3, 3) @ ball for b, ball in self.points])

    def standing_feet(self) -> Array:
        """Positions of the contacts `(contacts, 3)` in axes of the trunk while standing."""
        data = mujoco.MjData(self.nominal)
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *np.zeros(len(self.names))]
        data.qpos[self.at] = self.stand
        mujoco.mj_kinematics(self.nominal, data)
        return self._places(data)

    def steps(self, phases: Array, duty: float, hertz: float, stride: Array) -> Callable[[float], Array]:
        """A gait in which each foot stands for a share `duty` of the period."""
        home, phases = self.standing_feet(), np.repeat(phases, len(self.kind.balls))

        def wanted(t: float) -> Array:
            ramp = min(1.0, t)
            phase = (hertz * t + phases) % 1.0
            swing = np.clip((phase - duty) / (1.0 - duty), 0.0, 1.0)
            along = np.where(phase < duty, 0.5 - phase / duty, smooth(swing) - 0.5)
            up = self.kind.lift * np.sin(np.pi * swing) ** 2
            return home + ramp * (along[:, None] * stride + up[:, None] * (0.0, 0.0, 1.0))

        return wanted

    def stepping(self, duty: float, hertz: float, stride: float, shift: float) -> Gait:
        """A slow walk of a biped, whose trunk shifts sideways [m] over the foot that stands."""
        steps = self.steps(np.array([0.0, 0.5]), duty, hertz, np.array([stride, 0.0, 0.0]))
        home, w = self.standing_feet(), 2.0 * np.pi * hertz
        height, apart = -home[:, 2].mean(), np.abs(home[:, 1]).mean()

        def aside(t: float) -> float:
            return min(1.0, 0.5 * t) * shift * np.cos(w * t - np.pi * duty)

        def wanted(t: float) -> Array:
            start = np.clip(0.5 * t - 1.0, 0.0, 1.0)
            return home + start * (steps(t) - home) - (0.0, aside(t), 0.0)

        def share(t: float) -> Array:
            # the centre of pressure y − ÿ h/g
            y = aside(t) * (1.0 + w**2 * height / 9.81)
            return np.clip(0.5 + np.array([0.5, -0.5]) * y / apart, 0.0, 1.0)

        return Gait(wanted, share)

    def hop(self) -> Gait:
        """All feet push off together; quadrupeds are in the air for a third of the time."""
        home, size = self.standing_feet(), np.array([0.0, 0.0, 0.12])
        return Gait(lambda t: home * (1.0 - size * min(1.0, t) * np.cos(6.0 * np.pi * t)))

    def servo(self, gait: Gait, start: float) -> Callable[..., torch.Tensor]:
        """Torques of the servos for t, q and q̇ after the start, as a feedback law for rollouts."""
        times = start + np.arange(round(2.0 * ROLLED * RATE)) / RATE
        targets = torch.from_numpy(self.angles(gait.places, times))
        speeds = torch.diff(targets, dim=0, prepend=targets[:1]) * RATE

        def law(t: torch.Tensor, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
            k = (t[:, 0] * RATE + 1e-6).long()
            error = targets[k] - q[:, 6:] + self.kind.damping * (speeds[k] - qd[:, 6:])
            return torch.nn.functional.pad(self.kind.stiffness * error, (6, 0))

        return law

    def pushed(self) -> Callable[[float], Array]:
        """Half sines of random sizes and directions, each for half a second."""
        size = self.kind.push * 9.81 * self.true.body_mass.sum()
        forces = size * self.random.uniform(-1.0, 1.0, (100, 3)) / np.sqrt(3.0)

        def push(t: float) -> Array:
            return forces[int(t)] * np.sin(2.0 * np.pi * (t % 1.0)) * (t % 1.0 < 0.5)

        return push

    def sway(self) -> Gait:
        """The trunk moves in all six directions."""
        home = self.standing_feet()
        height = -home[:, 2].mean()
        size, pace = self.kind.sway
        w = 2.0 * np.pi * pace * self.random.uniform(0.4, 1.5, 6)
        most = size * np.array([0.1, 0.08, 0.12, 0.1, 0.12, 0.15]) * np.repeat((height, 1.0), 3)

        def wanted(t: float) -> Array:
            s = min(1.0, t) * np.sin(w * t) * most
            return Rotation.from_euler("xyz", s[3:]).apply(home) + s[:3]

        return Gait(wanted)

    def _feedforward(self, gait: Gait, targets: Array, times: Array) -> Array:
        """Torques `(n, joints)` that hold the robot of the file with its payload on its feet."""
        model, data = self.nominal, mujoco.MjData(self.nominal)
        tau, J = np.zeros_like(targets), np.zeros((3, self.nominal.nv))
        if gait.share is None:
            return tau
        size = 9.81 * (model.body_mass.sum() + self.payload) / len(self.kind.balls)
        for k, t in enumerate(times):
            data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *targets[k]]
            mujoco.mj_forward(model, data)
            force = data.qfrc_bias.copy()
            loads = size * np.repeat(gait.share(t), len(self.kind.balls))
            for (body, _), point, load in zip(self.points, self._places(data), loads, strict=True):
                mujoco.mj_jac(model, data, J, None, point, body)
                force -= load * J[2]
            tau[k] = force[self.dof]
        return tau

    def record(
        self, gait: Gait, seconds: float, push: Callable[[float], Array] | None = None
    ) -> dict[str, Array]:
        """Rows of a log under servos, with exact states, torques and forces of the feet.

        Args:
            push: force on the centre of mass of the trunk `(3,)` over time [N].
        """
        model, data = self.true, mujoco.MjData(self.true)
        every, n = round(1.0 / STEP / RATE), len(self.names)
        times = np.arange(round(seconds * RATE)) / RATE
        targets = self.angles(gait.places, times)
        ahead = self._feedforward(gait, targets, times)
        data.qpos[:] = [0, 0, -self.standing_feet()[:, 2].min() + self.kind.radius, 1, 0, 0, 0, *np.zeros(n)]
        data.qpos[self.at] = targets[0]
        rows: dict[str, list[Array]] = {key: [] for key in ("q", "qd", "qdd", "tau", "force")}
        k_p = self.kind.stiffness
        k_d = self.kind.damping * k_p
        bristles = Dahl(self.dry) if self.friction == "dahl" else None
        mujoco.set_mjcb_passive(bristles)
        for k, target in enumerate(targets):
            speed = (target - targets[max(0, k - 1)]) * RATE
            tau = ahead[k] + k_p * (target - data.qpos[self.at]) + k_d * (speed - data.qvel[self.dof])
            data.qfrc_applied[self.dof] = tau
            if push is not None:
                data.xfrc_applied[self.trunk, :3] = push(times[k])
            mujoco.mj_forward(model, data)
            rows["q"].append(data.qpos.copy())
            rows["qd"].append(data.qvel.copy())
            rows["qdd"].append(data.qacc.copy())
            rows["tau"].append(tau)
            rows["force"].append(self._forces(data))
            for _ in range(every):
                mujoco.mj_step(model, data)
        mujoco.set_mjcb_passive(None)
        log = {"t": times} | {key: np.array(value) for key, value in rows.items()}
        upright = Rotation.from_quat(np.roll(log["q"][:, 3:7], -1, axis=1)).as_matrix()[:, 2, 2]
        if upright.min() < FALLEN:
            raise RuntimeError(f"the robot fell after {times[np.argmax(upright < FALLEN)]:.1f} s")
        return log

    def _forces(self, data: Any) -> Array:
        """Forces of the floor on the contacts `(contacts, 3)` in world axes."""
        forces, wrench, names = np.zeros((len(self.points), 3)), np.zeros(6), list(self.contacts)
        for i, contact in enumerate(data.contact):
            mujoco.mj_contactForce(self.true, data, i, wrench)
            k = names.index(self.true.geom(contact.geom2).name)
            forces[k] += contact.frame.reshape(3, 3).T @ wrench[:3]
        return forces


def smooth(s: Array) -> Array:
    """From 0 to 1 without a jump of the velocity."""
    return s * s * (3.0 - 2.0 * s)


class Dahl:
    """Dry friction with memory as a callback of MuJoCo."""

    def __init__(self, dry: Array) -> None:
        self.dry, self.bristle, self.time = dry, np.zeros(len(dry)), 0.0

    def __call__(self, model: Any, data: Any) -> None:
        """Add the force; the bristles move on with the time of the engine."""
        speed = data.qvel
        end = np.sign(speed)
        change = np.exp(-np.abs(speed) * (data.time - self.time) / DISTANCE)
        self.bristle, self.time = end + (self.bristle - end) * change, data.time
        data.qfrc_passive -= self.dry * self.bristle


def _add_mass(model: Any, body: int, mass: float, place: Array) -> None:
    """Add a point mass at a place [m] in axes of a body."""
    m, c = float(model.body_mass[body]), model.body_ipos[body].copy()
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body_iquat[body])
    R = R.reshape(3, 3)
    com = (m * c + mass * place) / (m + mass)
    inertia = R @ np.diag(model.body_inertia[body]) @ R.T
    for weight, at in ((m, c), (mass, place)):
        d = at - com
        inertia += weight * (d @ d * np.eye(3) - np.outer(d, d))
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = m + mass, com, moments
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.flatten())


def euler(quat: Array) -> Array:
    """Yaw, pitch and roll `(n, 3)` of quaternions (w, x, y, z)."""
    angles = Rotation.from_quat(np.roll(quat, -1, axis=1)).as_euler("ZYX")
    return np.unwrap(angles, axis=0)


def rates(angles: Array, spin: Array) -> Array:
    """Rates of yaw, pitch and roll `(n, 3)` from the angular velocity in axes of the body."""
    pitch, roll = angles[:, 1], angles[:, 2]
    turned = np.cos(roll) * spin[:, 1] - np.sin(roll) * spin[:, 2]
    yaw = (np.sin(roll) * spin[:, 1] + np.cos(roll) * spin[:, 2]) / np.cos(pitch)
    return np.stack([yaw, turned, spin[:, 0] + np.sin(pitch) * yaw], axis=1)


def accelerations(angles: Array, speeds: Array, spin: Array, change: Array) -> Array:
    """Second derivatives of yaw, pitch and roll from ω̇ in axes of the body."""
    h = 1e-6
    # d/dt of rates(angles, ω) = rates(angles, ω̇) + ∂rates/∂angles · speeds
    moved = (rates(angles + h * speeds, spin) - rates(angles - h * speeds, spin)) / (2.0 * h)
    return rates(angles, change) + moved


def dataset(legged: Legged, rows: dict[str, Array]) -> forcegp.Dataset:
    """The log with noise, with the base as six joints."""
    random = legged.random

    def noisy(x: Array, std: float) -> Array:
        return x + std * random.standard_normal(x.shape)

    angles, spin = euler(rows["q"][:, 3:7]), rows["qd"][:, 3:6]
    speeds = rates(angles, noisy(spin, GYRO))
    turning = accelerations(angles, speeds, spin, noisy(rows["qdd"][:, 3:6], TURNING))
    q = np.concatenate([rows["q"][:, :3], angles, rows["q"][:, legged.at]], axis=1)
    qd = np.concatenate([rows["qd"][:, :3], speeds, rows["qd"][:, legged.dof]], axis=1)
    linear = noisy(rows["qdd"][:, :3], ACCELEROMETER)
    qdd = np.concatenate([linear, turning, noisy(rows["qdd"][:, legged.dof], TURNING)], axis=1)
    tau = noisy(rows["tau"], TORQUE * np.abs(rows["tau"]).max())
    tau = np.concatenate([np.zeros((len(tau), 6)), tau], axis=1)
    force = {name: torch.from_numpy(rows["force"][:, k].copy()) for k, name in enumerate(legged.contacts)}
    contact = {name: F.norm(dim=-1) > 0.0 for name, F in force.items()}
    columns = (torch.from_numpy(x.copy()) for x in (rows["t"], q, qd, tau, qdd))
    extras = {"F": force}
    return forcegp.Dataset(*columns, legged.robot.joint_names, contact=contact, contact_extras=extras)


class Plain:
    """Equations of motion with unknown forces of all closed feet, by generalized least squares.

    M q̈ − Q_K − τ = Σ JᵀF + e with e ~ N(0, S). S holds torques of the joints, whose unknown part is that of
    the training log, and the noise of q̈. `identified` adds columns of viscous and dry friction, offsets and
    drives of the joints, and of the ten parameters of the trunk.
    """

    def __init__(self, system: forcegp.ConstrainedSystem, train: forcegp.Dataset, identifies: bool) -> None:
        self.system, self.identifies = system, identifies
        self.sigma = torch.full((system.robot.nq - 6,), 0.1, dtype=train.dtype)
        self.weights = torch.zeros(0, dtype=train.dtype)
        for _ in range(3):
            J, r, L, X = self._rows(train)
            # U spans what forces of the feet leave, Uᵀ L⁻¹ Jᵀ = 0
            B, e = (torch.linalg.solve_triangular(L, x, upper=False) for x in (J.mT, r[..., None]))
            X = torch.linalg.solve_triangular(L, X, upper=False)
            P = torch.eye(B.shape[-2]).to(B) - B @ torch.linalg.pinv(B, rtol=1e-9)
            e, X = P @ e, P @ X
            if identifies:
                size = X.square().mean((0, 1)).sqrt().clamp(min=1e-12)
                A = (X / size).flatten(0, 1)
                gram = A.mT @ A + 1e-8 * len(A) * torch.eye(A.shape[-1]).to(A)
                self.weights = torch.linalg.solve(gram, A.mT @ e.flatten(0, 1))[:, 0] / size
                e = e - X @ self.weights[:, None]
            left = (L @ e)[:, 6:, 0]
            share = P.diagonal(dim1=-2, dim2=-1)[:, 6:].mean(0)
            self.sigma = (left.square().mean(0) / share).sqrt()

    def _rows(self, data: forcegp.Dataset) -> tuple[torch.Tensor, ...]:
        eom, n = self.system.equations(data.q, data.qd), data.nq
        feet = self.system.contact_names
        J = torch.cat([eom.contact_points[f].jacobian * data.contact[f][:, None, None] for f in feet], dim=1)
        r = (eom.M @ data.qdd[..., None])[..., 0] - eom.Q_K - data.tau
        noise = torch.cat([torch.full((3,), ACCELEROMETER), torch.full((n - 3,), TURNING)]).to(r)
        S = (eom.M * noise**2) @ eom.M.mT
        S = S + torch.diag_embed(torch.nn.functional.pad(self.sigma**2, (6, 0), value=1e-12))
        dry = torch.tanh(data.qd / 0.02)
        each = [torch.diag_embed(x)[..., 6:] for x in (data.qd, dry, torch.ones_like(dry), data.qdd)]
        Y = forcegp.identification.regressor(self.system.robot, data.q, data.qd, data.qdd)
        X = -torch.cat([*each, Y[..., 50:60]], dim=-1)
        return J, r, torch.linalg.cholesky(S), X

    def forces(
        self, data: forcegp.Dataset, trunk: tuple[str, tuple[float, ...]] | None = None
    ) -> torch.Tensor:
        """Forces of all contacts, and on a point of the trunk, `(n, 3 contacts)` or `(n, 3 contacts + 3)`."""
        J, r, L, X = self._rows(data)
        if trunk is not None:
            J = torch.cat([J, frame_jacobian(self.system.robot, data.q, *trunk)[:, 3:]], dim=1)
        r = r - (X @ self.weights) if self.identifies else r
        B, e = (torch.linalg.solve_triangular(L, x, upper=False) for x in (J.mT, r[..., None]))
        return (torch.linalg.pinv(B, rtol=1e-9) @ e)[..., 0]


def of_legs(legged: Legged, system: forcegp.ConstrainedSystem, data: forcegp.Dataset) -> torch.Tensor:
    """−J⁻ᵀ τ of each leg with the closed contacts of its foot `(n, 3 contacts)`."""
    eom, own = system.equations(data.q, data.qd), []
    for foot in legged.kind.feet:
        names = [name for name, (frame, _) in legged.contacts.items() if frame == foot]
        J = [eom.contact_points[x].jacobian[..., 6:] * data.contact[x][:, None, None] for x in names]
        own.append(torch.linalg.pinv(torch.cat(J, dim=1).mT, rtol=1e-9) @ -data.tau[:, 6:, None])
    return torch.cat(own, dim=1)[..., 0]


def system_of(legged: Legged, stick_speed: float | None = None) -> forcegp.ConstrainedSystem:
    """The robot file and its feet on the floor."""
    floor, radius = forcegp.Plane(offset=0.0), legged.kind.radius
    balls = [
        forcegp.SurfaceContact(x, foot, ball, floor, radius=radius, stick_speed=stick_speed)
        for x, (foot, ball) in legged.contacts.items()
    ]
    return forcegp.ConstrainedSystem(legged.robot, balls)


def score(
    legged: Legged, data: forcegp.Dataset, force: torch.Tensor, covariance: torch.Tensor | None = None
) -> dict[str, Any]:
    """RMSE of each axis over the total force on each foot [N], median σ and coverage of ±2σ.

    Args:
        force: forces of all contacts `(n, 3 contacts)` with their covariance. Those of the balls of a flat
            foot are scored in `balls`, too.
    """
    count, each = len(legged.kind.feet), len(legged.kind.balls)
    closed = torch.stack([data.contact[x] for x in legged.contacts], dim=-1)
    true = torch.cat([data.contact_extras["F"][x] for x in legged.contacts], dim=-1)
    sums = torch.eye(3 * count).to(true).unflatten(1, (count, 3)).repeat_interleave(each, dim=1).flatten(1)
    result: dict[str, Any] = _errors(
        sums, closed.unflatten(1, (count, each)).any(-1), force - true, covariance
    )
    if each > 1:
        result["balls"] = _errors(torch.eye(true.shape[-1]).to(true), closed, force - true, covariance)
    return result


def _errors(
    sums: torch.Tensor, closed: torch.Tensor, error: torch.Tensor, covariance: torch.Tensor | None
) -> dict[str, Any]:
    """Scores of sums of forces, `sums @ error`, where they are `closed` `(n, sums)`."""
    e = (error @ sums.mT).unflatten(1, (-1, 3))[closed]
    result: dict[str, Any] = {"rmse_N": e.square().mean(0).sqrt().tolist()}
    if covariance is not None:
        sigma = (sums @ covariance @ sums.mT).diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
        sigma = sigma.unflatten(1, (-1, 3))[closed]
        result["median_std_N"] = sigma.median(0).values.tolist()
        result["coverage"] = (e.abs() <= 2.0 * sigma).double().mean(0).tolist()
    return result


def case(name: str, friction: str, seed: int) -> dict[str, Any]:
    """Scores of all methods on one robot."""
    legged = Legged(name, friction, seed)
    system = system_of(legged)
    learned, walk = gaits(legged).values()
    parts = [(legged.sway(), 0.4 * SECONDS["train"]), (learned, 0.6 * SECONDS["train"])]
    train = forcegp.Dataset.concatenate([dataset(legged, legged.record(*part)) for part in parts])
    test = dataset(legged, legged.record(walk, SECONDS["test"]))[::TESTED]
    began = time.perf_counter()
    fit = forcegp.StructuredGP(system).fit(train[::EVERY])
    seconds = time.perf_counter() - began
    result: dict[str, Any] = {"legs": score(legged, test, of_legs(legged, system, test))}
    for label, identifies in {"equations of motion": False, "identified": True}.items():
        result[label] = score(legged, test, Plain(system, train[::EVERY], identifies).forces(test))
    read = fit.contact_force(test)
    result["forcegp"] = {**score(legged, test, read.mean, read.covariance), "seconds": seconds}
    push = legged.pushed()
    rows = legged.record(legged.sway(), SECONDS["test"], push)
    true = torch.tensor(np.array([push(t) for t in rows["t"]]))[::TESTED]
    data, point = dataset(legged, rows)[::TESTED], tuple(legged.true.body_ipos[legged.trunk].tolist())
    frame = legged.true.body(legged.trunk).name
    plain = Plain(system, train[::EVERY], False).forces(data, (frame, point))[:, -3:]
    wrench = fit.external_wrench(data, frame, axes=("fx", "fy", "fz"), point=point)
    acts = true.norm(dim=-1) > 0.0
    before, after = ((x - true)[acts].square().sum(-1).mean().sqrt() for x in (plain, wrench.mean))
    assert wrench.std is not None
    covered = ((wrench.mean - true).abs() <= 2.0 * wrench.std)[acts].double().mean()
    result["push"] = {"equations_N": float(before), "rmse_N": float(after), "coverage": float(covered)}
    state, active = (test.q, test.qd, test.tau, "qdd"), test.active(system.contact_names)
    forward, file = (
        fit.predict(*state, active=active),
        forcegp.AnalyticalModel(system).nominal().predict(*state, active=active),
    )
    e, before = forward.mean - test.qdd, file.mean - test.qdd
    ratio = (e.square().mean(0) / before.square().mean(0)).log().mean().mul(0.5).exp()
    covered = (e.abs() <= 2.0 * (forward.std.square() + fit.noise["qdd"].square()).sqrt()).double().mean()
    result["predicted_qdd"] = {"over_file": float(ratio), "coverage": float(covered)}
    for each in fit.robot_parameters():
        if (each.name, each.of) != ("link mass", "base_roll"):
            continue
        rigid = legged.true.body_weldid == legged.base
        true = float((legged.true.body_mass - legged.nominal.body_mass)[rigid].sum())
        result["trunk"] = {"true_kg": true, "found_kg": each.value, "std_kg": each.std}
    return result


def wander(random: np.random.Generator, rows: int, std: float, seconds: float) -> Array:
    """Three Ornstein-Uhlenbeck processes `(rows, 3)` with a correlation time."""
    keep = np.exp(-1.0 / (RATE * seconds))
    steps = std * random.standard_normal((rows, 3))
    steps[1:] *= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], steps, axis=0))


def columns(legged: Legged, rows: dict[str, Array], estimated: bool) -> dict[str, Array]:
    """Columns of a logger, `name.part`, with a base that is exact or estimated."""
    random, n, base = legged.random, len(rows["t"]), float(estimated)
    R = Rotation.from_quat(np.roll(rows["q"][:, 3:7], -1, axis=1))
    error = base * wander(random, n, DRIFT["velocity"], DRIFT["correlation"])
    moved = lfilter([1.0 / RATE], [1.0, -np.exp(-1.0 / (RATE * DRIFT["leak"]))], error, axis=0)
    p = rows["q"][:, :3] + moved + base * DRIFT["position"] * random.standard_normal(3)
    turn = Rotation.from_rotvec(base * wander(random, n, DRIFT["turn"], DRIFT["leak"]))

    def noisy(x: Array, std: float) -> Array:
        return x + std * random.standard_normal(x.shape)

    vectors = {
        "p": (p, "xyz"),
        "r": (np.roll((turn * R).as_quat(), 1, axis=1), "wxyz"),
        "v": (rows["qd"][:, :3] + error, "xyz"),
        "w": (noisy(rows["qd"][:, 3:6], GYRO), "xyz"),
        "f": (noisy(R.inv().apply(rows["qdd"][:, :3] + [0.0, 0.0, 9.81]), ACCELEROMETER), "xyz"),
        "q": (noisy(rows["q"][:, legged.at], ENCODER), legged.names),
        "tau": (noisy(rows["tau"], TORQUE * np.abs(rows["tau"]).max()), legged.names),
    }
    parts = {f"{name}.{part}": x[:, k] for name, (x, of) in vectors.items() for k, part in enumerate(of)}
    return {"t": rows["t"], **parts}


def mapping(legged: Legged) -> str:
    """Mapping of such a log."""
    robot = legged.robot
    frame = next(x for k, x in enumerate(robot.frame_names) if robot.frame_parents[k] == 5)
    three = {name: [f"{name}.{axis}" for axis in "xyz"] for name in "pvwf"}
    feet = "".join(f'[contact.{foot}]\nsource = "multiplier"\n' for foot in legged.contacts)
    return f"""
        time = {{ column = "t" }}
        position = {{ column = "q.{{joint}}", unit = "rad" }}
        torque = {{ column = "tau.{{joint}}", unit = "Nm" }}
        [base]
        position = {three["p"]}
        quaternion = ["r.w", "r.x", "r.y", "r.z"]
        quaternion_order = "wxyz"
        linear_velocity = {three["v"]}
        linear_axes = "world"
        imu_frame = "{frame}"
        gyro = {three["w"]}
        accelerometer = {three["f"]}
        gravity = true
        {feet}"""


def gaits(legged: Legged) -> dict[str, Gait]:
    """A gait to learn from and one for tests: a trot and a walk, or steps in place and a walk of a biped."""
    if len(legged.kind.feet) == 2:
        return {"steps": legged.stepping(0.8, 0.3, 0.0, 0.11), "walk": legged.stepping(0.8, 0.4, 0.05, 0.105)}
    trot = legged.steps(np.array([0.0, 0.5, 0.5, 0.0]), 0.55, 1.8, np.array([0.04, 0.0, 0.0]))
    walk = legged.steps(np.array([0.0, 0.5, 0.75, 0.25]), 0.78, 1.0, np.array([0.05, 0.0, 0.0]))
    return {"trot": Gait(trot), "walk": Gait(walk)}


def switches(closed: Array, t: Array) -> tuple[Array, Array]:
    """Times of touch-down and of lift-off, apart from contacts and flights that are too short."""
    least = round(FLIGHT * RATE)
    spans = [s for s in intervals(closed, join=least - 1) if s[1] - s[0] >= least]
    return t[[a for a, _ in spans if a > 0]], t[[b for _, b in spans if b < len(t)]]


def apart(times: Array, others: Array) -> Array:
    """Time from the nearest of some times to each of the others [s], infinite if there is none."""
    if not len(times):
        return np.full(len(others), np.inf)
    return others - times[np.abs(others[:, None] - times).argmin(axis=1)]


def labels(legged: Legged, spans: list[Any], acts: Array, t: Array) -> dict[str, Any]:
    """Scores of the closed intervals of all contacts, against rows with a force `(contacts, n)`.

    A flat foot is closed if one of its balls is.
    """
    shape = len(legged.kind.feet), len(legged.kind.balls), len(t)
    closed = [np.any([(t >= a - 1e-6) & (t <= b + 1e-6) for a, b in each], axis=0) for each in spans]
    feet, truths = (np.reshape(x, shape).any(axis=1) for x in (closed, acts))
    errors: dict[str, list[Array]] = {"touch_down": [], "lift_off": []}
    began, false, same = [], 0, []
    for foot, truth in zip(feet, truths, strict=True):
        same.append(float((foot == truth).mean()))
        for key, true, found in zip(errors, switches(truth, t), switches(foot, t), strict=True):
            off, early = -apart(found, true), true < STARTED
            errors[key].append(off[~early])
            began.append(off[early])
            false += int((np.abs(apart(true, found[found >= STARTED])) > TOLERANCE).sum())
    joined = {key: np.concatenate(x) for key, x in errors.items()}
    hit = np.abs(np.concatenate(list(joined.values()))) <= TOLERANCE
    return {
        "switches": len(hit),
        "found": float(hit.mean()),
        "found_in_first_second": float((np.abs(np.concatenate(began)) <= TOLERANCE).mean()),
        "false_per_minute": 60.0 * false / float(t[-1] - STARTED),
        **{f"{key}_ms": (1e3 * np.quantile(x, [0.05, 0.5, 0.95])).tolist() for key, x in joined.items()},
        "rows_agree": float(np.mean(same)),
    }


def touchdown(name: str, friction: str, seed: int) -> list[dict[str, Any]]:
    """Touch-down and lift-off of all feet in imported logs, by gait and base."""
    legged, results = Legged(name, friction, seed), []
    system = system_of(legged)
    for gait, wanted in gaits(legged).items():
        rows = legged.record(wanted, SECONDS["labels"])
        t, acts = rows["t"], np.linalg.norm(rows["force"], axis=-1) > 0.0
        for base in ("exact", "estimated"):
            log = columns(legged, rows, base == "estimated")
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "log.csv"
                np.savetxt(
                    path, np.column_stack(list(log.values())), "%.9g", ",", header=",".join(log), comments=""
                )
                read = import_log(path, system, parse_mapping(mapping(legged).encode(), "mapping"))
            results.append({"gait": gait, "base": base, "rows_kept": len(read.data) / len(t)})
            results[-1] |= labels(legged, [each.intervals for each in read.contacts], acts.T, t)
    return results


def rollouts(name: str, friction: str, seed: int) -> list[dict[str, Any]]:
    """Errors over half a second from states of the gait that is learned from, and of a hop."""
    legged, results = Legged(name, friction, seed), []
    system, gait = system_of(legged, STICKS), next(iter(gaits(legged).values()))
    parts = [(legged.sway(), 0.4 * SECONDS["train"]), (gait, 0.6 * SECONDS["train"])]
    train = forcegp.Dataset.concatenate([dataset(legged, legged.record(*part)) for part in parts])
    fit = forcegp.StructuredGP(system).fit(train[::EVERY])
    models = {"fit": fit, "file": forcegp.AnalyticalModel(system).nominal()}
    options = RolloutOptions(dt=1.0 / RATE, unilateral=True, sticking=False)
    for (motion, wanted), start in itertools.product({"gait": gait, "hop": legged.hop()}.items(), STARTS):
        data = dataset(legged, legged.record(wanted, SECONDS["rollout"]))
        first, law = round(start * RATE), legged.servo(wanted, start)
        for label, model in models.items():
            path = model.rollout(data.q[first], data.qd[first], law, duration=ROLLED, options=options)
            e = (path.q - data.q[first : first + len(path.q)]).square().mean(0)
            columns = {"base_mm": slice(3), "base_mrad": slice(3, 6), "joints_mrad": slice(6, None)}
            sizes = {key: 1e3 * float(e[part].mean().sqrt()) for key, part in columns.items()}
            results.append({"motion": motion, "start_s": start, "model": label} | sizes)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", choices=("forces", "touchdown", "rollout"), default="forces")
    parser.add_argument("--robot", choices=tuple(ROBOTS), action="append")
    parser.add_argument("--friction", choices=FRICTIONS, action="append")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    robots, frictions = options.robot or tuple(ROBOTS), options.friction or FRICTIONS
    head = ["case", "RMSE [N]", "÷ legs", "÷ equations", "÷ identified", "coverage of ±2σ"]
    if options.case == "touchdown":
        head = ["case", "within 10 ms", "false per minute", "touch-down [ms]", "lift-off [ms]", "rows"]
    if options.case == "rollout":
        head = ["case", "base [mm]", "base [mrad]", "joints [mrad]"]
    results, lines = [], []
    for seed, name, friction in itertools.product(options.seeds, robots, frictions):
        label, of = f"{name}, {friction}, {seed}", {"robot": name, "friction": friction, "seed": seed}
        if options.case == "touchdown":
            for each in touchdown(name, friction, seed):
                results.append(of | each)
                down, up = (
                    " ".join(f"{x:.0f}" for x in each[key]) for key in ("touch_down_ms", "lift_off_ms")
                )
                shares = f"{each['found']:.3f} of {each['switches']}", f"{each['false_per_minute']:.0f}"
                more = f"{each['rows_agree']:.3f}"
                lines.append([f"{label}, {each['gait']}, {each['base']}", *shares, down, up, more])
                print(lines[-1], flush=True)
            continue
        if options.case == "rollout":
            for each in rollouts(name, friction, seed):
                results.append(of | each)
                sizes = [f"{each[key]:.1f}" for key in ("base_mm", "base_mrad", "joints_mrad")]
                lines.append([f"{label}, {each['motion']}, {each['start_s']:.1f} s, {each['model']}", *sizes])
                print(lines[-1], flush=True)
            continue
        scores = case(name, friction, seed)
        results.append(of | scores)
        print(json.dumps(results[-1]), flush=True)
        size = {key: float(np.linalg.norm(scores[key]["rmse_N"])) for key in METHODS}
        ratios = [f"{size['forcegp'] / size[key]:.2f}" for key in METHODS[:3]]
        covered = " ".join(f"{x:.2f}" for x in scores["forcegp"]["coverage"])
        lines.append([label, f"{size['forcegp']:.2f}", *ratios, covered])
    print(table(head, lines))
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
