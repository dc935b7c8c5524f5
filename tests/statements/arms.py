"""Arms in MuJoCo that differ from their robot files in a known way, logged and imported as a user would."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import forcegp
from forcegp.logs import parse_mapping
from forcegp.robot.model import RobotModel
from forcegp.simulate.urdf import write_urdf
from robots import ARMS

mujoco: Any = pytest.importorskip("mujoco")
STEP, PERIOD = 0.001, 0.004
ENCODER, SPEED_NOISE, TORQUE_NOISE = 2e-5, 1e-3, 0.005
"""Resolution [rad], noise of the velocity [rad/s], and of the torque over the largest torque of a joint."""
STIFF = 0.9999
"""Impedance d of MuJoCo's dry friction, which is viscous, with a factor M b d/(1 − d), until it reaches the
stated value. With the default of 0.9, a wrist of 0.4 g m² never reaches it."""
MAPPING = b"""
time = { column = "t" }
position = { column = "q.{joint}", unit = "rad" }
velocity = { column = "qd.{joint}", unit = "rad/s" }
torque = { column = "tau.{joint}", unit = "Nm" }
derivatives = { window = 21 }
"""


@dataclass(frozen=True)
class Truth:
    """What the robot file does not say.

    Attributes:
        arm: name of the arm in `robots.ARMS`.
        heavier: factor of the mass and the inertia of each link.
        drives: inertia of each drive [kg m²].
        dry, viscous: friction of each joint [N m, N m s/rad].
        payload: point mass at the origin of the last link's frame [kg].
        memory: distance over which dry friction builds up after a reversal [rad] (Dahl's model).
    """

    arm: str
    heavier: float = 1.0
    drives: tuple[float, ...] = ()
    dry: tuple[float, ...] = ()
    viscous: tuple[float, ...] = ()
    payload: float = 0.0
    memory: float = 0.0


@cache
def file_of(arm: str) -> RobotModel:
    """The robot file, without friction."""
    robot = next(each for each in ARMS if each.name == arm).load()
    return robot.replace(damping=torch.zeros_like(robot.damping), friction=torch.zeros_like(robot.friction))


def true_robot(truth: Truth) -> RobotModel:
    """The robot with its true links and drives."""
    robot = file_of(truth.arm)
    armature = robot.armature + torch.tensor(truth.drives or (0.0,) * robot.nq, dtype=robot.mass.dtype)
    links = {"mass": truth.heavier * robot.mass, "inertia": truth.heavier * robot.inertia}
    return robot.replace(armature=armature, **links)


def last_frame(robot: RobotModel) -> str:
    """Name of the last frame of the last link."""
    pairs = zip(robot.frame_names, robot.frame_parents, strict=True)
    return [name for name, parent in pairs if parent == robot.nq - 1][-1]


def _engine(truth: Truth) -> Any:
    robot = true_robot(truth)
    model = mujoco.MjModel.from_xml_string(write_urdf(robot))
    model.opt.timestep, model.opt.gravity[:] = STEP, robot.gravity.numpy()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    model.dof_armature[:] = robot.armature.numpy()
    if not truth.memory:
        model.dof_frictionloss[:] = truth.dry or (0.0,) * robot.nq
        model.dof_solimp[:, :2] = STIFF
    model.dof_damping[:] = truth.viscous or (0.0,) * robot.nq
    if truth.payload:
        _attach(model, robot, truth.payload)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _attach(model: Any, robot: RobotModel, mass: float) -> None:
    """Add a point mass at the origin of the last link's frame to the last body."""
    body, place = model.nbody - 1, robot.frame_position[robot.frame_index(last_frame(robot))].numpy()
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    R, own, c = rotation.reshape(3, 3), model.body_mass[body], model.body_ipos[body].copy()
    centre = (own * c + mass * place) / (own + mass)
    inertia = R @ np.diag(model.body_inertia[body]) @ R.T
    for m, d in ((own, c - centre), (mass, place - centre)):
        inertia = inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
    moments, axes = np.linalg.eigh(inertia)
    mujoco.mju_mat2Quat(model.body_iquat[body], (axes * np.sign(np.linalg.det(axes))).flatten())
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = own + mass, centre, moments


def motion(
    robot: RobotModel, seconds: float, seed: int, home: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and accelerations of five sines about the middle of the ranges, or a pose."""
    t, random = np.arange(round(seconds / STEP)) * STEP, np.random.default_rng(seed)
    low = np.maximum(np.nan_to_num(robot.lower.numpy(), neginf=-2.0), -2.0)
    high = np.minimum(np.nan_to_num(robot.upper.numpy(), posinf=2.0), 2.0)
    q = np.tile(home or (low + high) / 2.0, (len(t), 1))
    qd, qdd = np.zeros_like(q), np.zeros_like(q)
    for k in range(1, 6):
        w = 0.3 * np.pi * k * random.uniform(0.8, 1.2, robot.nq)
        size = 0.35 * (high - low) / 5.0 * random.uniform(0.4, 1.0, robot.nq) / k**0.5
        angle = w * t[:, None] + random.uniform(0.0, 2.0 * np.pi, robot.nq)
        q, qd = q + size * np.sin(angle), qd + size * w * np.cos(angle)
        qdd = qdd - size * w * w * np.sin(angle)
    return q, qd, qdd


def recorded(
    truth: Truth, path: Path, seconds: float, seed: int, home: tuple[float, ...] = (), push: float = 0.0
) -> torch.Tensor:
    """Write a log of the arm under a computed-torque controller that knows the links of the robot file alone.

    In every other second, a random force of up to `push` [N] per axis acts at the last frame.

    Returns:
        The force at each row, `(n, 3)` [N].
    """
    robot, random = file_of(truth.arm), np.random.default_rng(seed + 1000)
    file, true = mujoco.MjModel.from_xml_string(write_urdf(robot)), _engine(truth)
    file.opt.gravity[:] = robot.gravity.numpy()
    known, data = mujoco.MjData(file), mujoco.MjData(true)
    q, qd, qdd = motion(robot, seconds, seed, home)
    data.qpos[:], data.qvel[:] = q[0], qd[0]
    drives = np.array(truth.drives or (0.0,) * robot.nq)
    dry, bristle = np.array(truth.dry or (0.0,) * robot.nq), np.zeros(robot.nq)
    rows, forces, force, tau = [], [], np.zeros(3), np.zeros(robot.nq)
    for k in range(len(q)):
        if push and k % round(1.0 / STEP) == 0:
            force = random.uniform(-push, push, 3) if k // round(1.0 / STEP) % 2 else np.zeros(3)
        if k % round(PERIOD / STEP) == 0:
            wanted = qdd[k] + 400.0 * (q[k] - data.qpos) + 40.0 * (qd[k] - data.qvel)
            known.qpos[:], known.qvel[:], known.qacc[:] = q[k], qd[k], wanted
            mujoco.mj_inverse(file, known)
            tau = known.qfrc_inverse + drives * wanted + true.dof_damping * qd[k]
            tau += dry * np.tanh(qd[k] / 0.02)
        elif k % round(PERIOD / STEP) == round(0.5 * PERIOD / STEP):  # halfway
            rows.append([k * STEP, *data.qpos, *data.qvel, *tau])
            forces.append(force)
        data.qfrc_applied[:] = tau
        if truth.memory:  # dz/dt = (q̇ − |q̇| z)/δ
            end = np.sign(data.qvel)
            bristle = end + (bristle - end) * np.exp(-np.abs(data.qvel) * STEP / truth.memory)
            data.qfrc_applied[:] -= dry * bristle
        if push:
            _push(true, data, robot, force)
        mujoco.mj_step(true, data)
    _write(path, robot, np.array(rows), random)
    return torch.from_numpy(np.array(forces))


def _push(model: Any, data: Any, robot: RobotModel, force: np.ndarray) -> None:
    """Apply a force at the origin of the last link's frame."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    frame = robot.frame_position[robot.frame_index(last_frame(robot))].numpy()
    place = data.xmat[-1].reshape(3, 3) @ frame + data.xpos[-1]
    data.xfrc_applied[-1] = np.concatenate([force, np.cross(place - data.xipos[-1], force)])


def _write(path: Path, robot: RobotModel, table: np.ndarray, random: np.random.Generator) -> None:
    """Write the log with the resolution and noise of sensors."""
    n = robot.nq
    table[:, 1 : n + 1] = ENCODER * np.round(table[:, 1 : n + 1] / ENCODER)
    table[:, n + 1 : 2 * n + 1] += SPEED_NOISE * random.normal(size=(len(table), n))
    size = np.abs(table[:, 2 * n + 1 :]).max(0)
    table[:, 2 * n + 1 :] += TORQUE_NOISE * size * random.normal(size=(len(table), n))
    header = ",".join(["t", *(f"{x}.{name}" for x in ("q", "qd", "tau") for name in robot.joint_names)])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=header, comments="")


def imported(path: Path, arm: str) -> forcegp.Dataset:
    """A log as a user imports it."""
    return forcegp.read_log(path, file_of(arm), parse_mapping(MAPPING, "mapping"))


@cache
def log_of(truth: Truth, seconds: float = 20.0, seed: int = 0) -> forcegp.Dataset:
    """The imported log of free motion of an arm."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        recorded(truth, path, seconds, seed)
        return imported(path, truth.arm)


def pushed(
    truth: Truth, home: tuple[float, ...], seconds: float = 20.0, seed: int = 5, push: float = 30.0
) -> tuple[forcegp.Dataset, torch.Tensor]:
    """The imported log of an arm that is pushed, and the force on its last frame `(n, 3)` [N]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        forces = recorded(truth, path, seconds, seed, home, push)
        return imported(path, truth.arm), forces


def inertia(robot: RobotModel, data: forcegp.Dataset) -> torch.Tensor:
    """Mean diagonal of the mass matrix over a log `(nq,)` [kg m²]."""
    return forcegp.dynamics.mass_matrix(robot, data.q[::20]).diagonal(dim1=-2, dim2=-1).mean(0)
