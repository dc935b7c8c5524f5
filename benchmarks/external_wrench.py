"""External wrenches on arms in MuJoCo without a declared contact, beside momentum observers.

    python benchmarks/external_wrench.py --json result.json      # about a quarter of an hour
    python benchmarks/external_wrench.py --arm ur5 --case dahl --seed 2 --free 60

Each arm carries a payload, has masses of links that are off by up to 3 %, and joint friction (Stribeck's, or
Dahl's with memory), none of which its file knows. Every model is trained on 60 s of free motion. Then
something pushes the last link, presses on it, or slides along it, at places that no method knows, while the
arm moves, also through singular poses. The noise of torques and velocities is that of real logs (`NOISE`).

Methods read the same columns through the same filter. The gain of each momentum observer, and the damping of
its pseudo-inverse, are those with the least error on the test log itself, which favours it; nothing of the
learned estimate is chosen there.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from classical_wrench import momentum_residual, quasi_static, wrench_of
from numpy.typing import NDArray
from solver_arms import STEP, Arm, Imperfections, sines
from torch import Tensor

import forcegp
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.forces.external_wrench import WrenchFrame
from forcegp.logs import parse_mapping
from forcegp.models.external_wrench import ExternalWrench
from forcegp.robot.model import RobotModel

Array = NDArray[np.float64]
ARMS = {"kuka_iiwa14": 2.0, "franka_panda": 1.0, "ur5": 1.5}
"""Payload of each arm [kg]."""
NOISE = {"kuka_iiwa14": (0.005, 1e-3), "franka_panda": (0.005, 1e-3), "ur5": (0.03, 6e-3)}
"""Noise of the torque over its largest value, and of the velocity [rad/s].

That of the UR5 is what `ur3/id1.mat` has, whose torques are motor currents. The log of the iiwa is smooth
beyond measure (1e-4 and 1e-7), so arms with torque sensors have more than that.
"""
CASES = {
    "stribeck": Imperfections(mass=0.03, drive=0.0, gain=0.0, offset=0.0, memory=0.005, stribeck=0.5),
    "dahl": Imperfections(mass=0.03, drive=0.0, gain=0.0, offset=0.0, memory=0.05),
}
TRAIN, TEST, FREE = 30.0, 60.0, 100.0
"""Length of each training log (the whole range of the joints, and the home pose), each test log, and of the
free motion for false alarms [s]."""
HOME = {
    "kuka_iiwa14": (0.0, 0.6, 0.0, -1.4, 0.0, 1.0, 0.0),
    "franka_panda": (0.0, -0.4, 0.0, -2.0, 0.0, 1.8, 0.8),
    "ur5": (0.0, -1.2, 1.6, -1.9, -1.57, 0.0),
}
"""Pose that the arm works around."""
SINGULAR_HOME = {
    "kuka_iiwa14": (0.0, 0.6, 0.0, -0.2, 0.0, 0.2, 0.0),
    "franka_panda": (0.0, -0.4, 0.0, -0.5, 0.0, 0.4, 0.8),
    "ur5": (0.0, -1.2, 0.3, -1.9, -0.2, 0.0),
}
"""Pose between singular ones: elbow and wrist nearly straight."""
AROUND = 1.0
"""Largest distance of a joint from these poses [rad]."""
EPISODE, RAMP = 4.0, 0.25
"""Time from one contact to the next, of which every second half is contact, and its rise [s]."""
FORCE, REACH, MU = (10.0, 60.0), 0.1, 0.3
"""Range of forces [N], largest distance of the place from the flange [m], friction of sliding."""
LARGEST = 100.0
"""Force at which a surface gives way [N]."""
STIFFNESS, DAMPING, SLIP = 2e3, 30.0, 0.01
"""Of what is pressed on [N/m, N s/m], and the speed at which its friction is fully developed [m/s]."""
DRIVE, LEAST = 0.1, 0.1
"""Inertia of each drive [kg m²], which the robot file has, and the least scale of friction and noise of a
joint over that of the strongest."""
KINDS = ("push", "press", "slide")
GAINS = (3.0, 5.0, 10.0, 20.0, 40.0, 80.0)
"""Gains of the momentum observers [1/s]."""
EVERY = 6
"""Every which sample is trained on."""
DAMPINGS = (0.0, 0.03, 0.1, 0.2)
"""Of their pseudo-inverse: singular values σ [m] count as σ/(σ² + damping²)."""
FALSE_ALARM = 600.0
"""Free motion in which one false alarm is accepted [s]."""
METHODS = ("acceleration", "momentum")
MAPPING = """
time = { column = "t" }
position = { column = "q.{joint}", unit = "rad" }
velocity = { column = "qd.{joint}", unit = "rad/s" }
torque = { column = "tau.{joint}", unit = "Nm" }
derivatives = { window = 21 }
"""


@dataclass(frozen=True)
class Contact:
    """An episode of contact.

    Attributes:
        kind: of `KINDS`.
        start: [s].
        point: on the last link, in its frame [m].
        direction: of the force in the world.
        force: at its largest [N].
    """

    kind: str
    start: float
    point: Array
    direction: Array
    force: float

    def share(self, t: float) -> float:
        """How far the contact has developed, from 0 to 1."""
        return float(np.clip(min(t - self.start, self.start + EPISODE / 2.0 - t) / RAMP, 0.0, 1.0))


def contacts(seconds: float, flange: Array, random: np.random.Generator) -> list[Contact]:
    """Episodes of all kinds in turn."""
    found = []
    for i, start in enumerate(np.arange(EPISODE / 2.0, seconds, EPISODE)):
        point, direction = random.normal(size=3), random.normal(size=3)
        point = flange + REACH * random.uniform() ** (1.0 / 3.0) * point / np.linalg.norm(point)
        direction = direction / np.linalg.norm(direction)
        found.append(Contact(KINDS[i % 3], float(start), point, direction, random.uniform(*FORCE)))
    return found


class TouchedArm(Arm):
    """An arm with a payload that something may touch."""

    def __init__(self, robot: RobotModel, wrong: Imperfections, payload: float, random: Any) -> None:
        super().__init__(robot, wrong, random)
        for model in (self.file, self.true):
            model.dof_armature[:] = robot.armature.numpy()
        # The least joints have some friction and noise too.
        larger = np.maximum(self.scale, LEAST * self.scale.max()) / self.scale
        self.scale, self.dry = larger * self.scale, larger * self.dry
        self.true.dof_damping[:] *= larger
        self.body, self.begins = self.true.nbody - 1, {}
        index = len(robot.frame_names) - 1
        self.frame = robot.frame_names[index]
        assert robot.frame_parents[index] == robot.nq - 1
        self.flange = robot.frame_position[index].numpy()
        self._attach(payload, self.flange + random.uniform(-0.05, 0.05, 3))

    def _attach(self, mass: float, place: Array) -> None:
        """Add a point mass to the last link."""
        true, mujoco, i = self.true, self.mujoco, self.body
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, true.body_iquat[i])
        R = R.reshape(3, 3)
        own, c = true.body_mass[i], true.body_ipos[i].copy()
        centre = (own * c + mass * place) / (own + mass)
        inertia = R @ np.diag(true.body_inertia[i]) @ R.T
        for m, d in ((own, c - centre), (mass, place - centre)):
            inertia = inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
        moments, axes = np.linalg.eigh(inertia)
        axes = axes * np.sign(np.linalg.det(axes))
        mujoco.mju_mat2Quat(true.body_iquat[i], axes.flatten())
        true.body_mass[i], true.body_ipos[i], true.body_inertia[i] = own + mass, centre, moments
        mujoco.mj_setConst(true, mujoco.MjData(true))

    def place(self, data: Any, point: Array) -> tuple[Array, Array]:
        """Position and velocity of a point of the last link, in the world."""
        x = data.xpos[self.body] + data.xmat[self.body].reshape(3, 3) @ point
        jacobian = np.zeros((3, self.robot.nq))
        self.mujoco.mj_jac(self.true, data, jacobian, None, x, self.body)
        return x, jacobian @ data.qvel

    def touch(self, contact: Contact, t: float, data: Any, wanted: Any) -> Array:
        """Force on the arm, and where it acts; `wanted` is the arm where the controller wants it."""
        x, v = self.place(data, contact.point)
        if contact.kind == "push":
            return np.concatenate([contact.share(t) * contact.force * contact.direction, x])
        # A surface along the planned path, through the point where the contact begins, moved into the arm.
        planned, speed = self.place(wanted, contact.point)
        n, depth = contact.direction, contact.share(t) * contact.force / STIFFNESS
        begin = self.begins.setdefault(contact.start, n @ (planned - x))
        normal = STIFFNESS * (depth + n @ (planned - x) - begin) - DAMPING * (n @ (v - speed))
        normal = float(np.clip(normal, 0.0, LARGEST)) if depth > 0.0 else 0.0
        slip = v - n * (n @ v)
        drag = -MU * normal * slip / np.sqrt(slip @ slip + SLIP**2)
        return np.concatenate([normal * n + drag, x])

    def record_touched(
        self,
        seconds: float,
        path: Path,
        episodes: list[Contact],
        noise: tuple[float, float],
        home: tuple[float, ...] | None,
    ) -> tuple[Array, Array]:
        """A log in CSV around a pose, or over the range of the joints; returns time and the wrench on the
        flange (force, moment), world axes, by row."""
        mujoco, random, wrong = self.mujoco, self.random, self.wrong
        plan = sines(around(self.robot, home), seconds, random)
        pace = np.ones(len(plan[0]))
        for contact in episodes:
            # The arm presses at rest.
            if contact.kind == "press":
                first = round((contact.start - RAMP) / STEP)
                pace[first : first + round((EPISODE / 2.0 + 2.0 * RAMP) / STEP)] = 0.0
        kernel = np.hanning(round(RAMP / STEP))
        pace = np.convolve(pace, kernel / kernel.sum(), mode="same")
        change, way = np.gradient(pace, STEP), np.cumsum(pace) * STEP
        data, wanted = mujoco.MjData(self.true), mujoco.MjData(self.true)
        data.qpos[:], data.qvel[:] = plan[0][0], plan[1][0]
        bristle, every = np.zeros(self.robot.nq), round(wrong.period / STEP)
        rows, truth, torque = [], [], np.zeros(self.robot.nq)
        for k in range(len(pace)):
            t, i = k * STEP, min(int(way[k] / STEP), len(pace) - 1)
            q, qd = plan[0][i], plan[1][i] * pace[k]
            current = [c for c in episodes if c.start <= t <= c.start + EPISODE / 2.0]
            force, x = np.zeros(3), np.zeros(3)
            if current:
                mujoco.mj_kinematics(self.true, data)
                mujoco.mj_comPos(self.true, data)
                wanted.qpos[:], wanted.qvel[:] = q, qd
                mujoco.mj_kinematics(self.true, wanted)
                mujoco.mj_comPos(self.true, wanted)
                force, x = np.split(self.touch(current[0], t, data, wanted), 2)
            arm = x - data.xipos[self.body]
            data.xfrc_applied[self.body] = np.concatenate([force, np.cross(arm, force)])
            if k % every == 0:
                qdd = plan[2][i] * pace[k] ** 2 + plan[1][i] * change[k]
                feedback = 100.0 * (q - data.qpos) + 20.0 * (qd - data.qvel)
                torque = self.torque(q, qd, qdd + feedback)
                angle = data.qpos + wrong.jitter * random.normal(size=len(q))
                speed = data.qvel + noise[1] * random.normal(size=len(q))
                logged = torque + noise[0] * self.scale * random.normal(size=len(q))
                rows.append([t, *(wrong.encoder * np.round(angle / wrong.encoder)), *speed, *logged])
                flange = data.xpos[self.body] + data.xmat[self.body].reshape(3, 3) @ self.flange
                moment = np.cross(x - flange, force) if current else np.zeros(3)
                truth.append(np.concatenate([[t], force, moment]))
            data.qfrc_applied[:] = torque - self.losses(data, bristle)
            mujoco.mj_step(self.true, data)
        header = [f"{name}.{joint}" for name in ("q", "qd", "tau") for joint in self.robot.joint_names]
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(["t", *header]), comments="")
        truth = np.array(truth)
        return truth[:, 0], truth[:, 1:]


def around(robot: RobotModel, home: tuple[float, ...] | None) -> RobotModel:
    """The robot with joint limits around a pose, which the motion spans."""
    if home is None:
        return robot
    pose = torch.tensor(home, dtype=robot.dtype)
    return robot.replace(lower=pose - AROUND, upper=pose + AROUND)


@dataclass(frozen=True)
class Logs:
    """The logs of one arm, imported: free motion for training, contacts by pose with the true wrenches
    `(n, 6)`, and free motion for false alarms."""

    arm: TouchedArm
    train: forcegp.Dataset
    tests: dict[str, tuple[forcegp.Dataset, Tensor]]
    free: forcegp.Dataset


def recorded(name: str, wrong: Imperfections, seed: int, free: float) -> Logs:
    """Simulate an arm, and import its logs."""
    robot = forcegp.load_robot(name)
    robot = robot.replace(armature=torch.full_like(robot.mass, DRIVE))
    arm = TouchedArm(robot, wrong, ARMS[name], np.random.default_rng(seed))
    mapping, read = parse_mapping(MAPPING.encode(), "mapping"), {}
    parts = {
        "train": (TRAIN, False, None),
        "train home": (TRAIN, False, HOME[name]),
        "home": (TEST, True, HOME[name]),
        "singular": (TEST, True, SINGULAR_HOME[name]),
        "free": (free, False, HOME[name]),
    }
    with tempfile.TemporaryDirectory() as folder:
        for part, (seconds, touched, home) in parts.items():
            path = Path(folder) / f"{part}.csv"
            episodes = contacts(seconds, arm.flange, arm.random) if touched else []
            arm.begins.clear()
            t, wrench = arm.record_touched(seconds, path, episodes, NOISE[name], home)
            data = forcegp.read_log(path, robot, mapping)
            rows = np.searchsorted(t, data.t.numpy() - 1e-6)
            read[part] = data, torch.from_numpy(wrench[rows])
    train = forcegp.Dataset.concatenate([read["train"][0], read["train home"][0]])
    return Logs(arm, train, {part: read[part] for part in ("home", "singular")}, read["free"][0])


def condition(robot: RobotModel, q: Tensor) -> float:
    """Share of poses at which the arm feels some wrench, of forces and of moments over 0.2 m, ten times less
    than another: the singular values of (J_p; J_ω · 0.2 m)."""
    J = WrenchFrame(robot.frame_names[-1]).jacobian(robot, q)
    values = torch.linalg.svdvals(torch.cat([J[:, :3], 0.2 * J[:, 3:]], dim=1))
    return float((values[:, 5] < 0.1 * values[:, 0]).double().mean())


def rmse(found: Tensor, truth: Tensor) -> dict[str, float]:
    """Root mean square of the length of the errors of the force [N] and of the moment [N m]."""
    square = (found - truth).square()
    force, moment = (float(part.sum(-1).mean().sqrt()) for part in (square[:, :3], square[:, 3:]))
    return {"force": force, "moment": moment}


def best(by_gain: dict[float, Tensor], J: Tensor, truth: Tensor, rows: Tensor) -> dict[str, float]:
    """The least error of the force of an observer on the test log, over its gain and over the damping of the
    pseudo-inverse, which keeps it finite at singular poses."""
    found = []
    for gain, residual in by_gain.items():
        for damping in DAMPINGS:
            errors = rmse(wrench_of(J, residual, damping)[rows], truth[rows])
            found.append({"gain": gain, "damping": damping, **errors})
    return min(found, key=lambda each: each["force"])


def learned_scores(
    wrench: ExternalWrench, truth: Tensor, rows: Tensor, detected: Mapping[str, float]
) -> dict[str, Any]:
    """Errors, also in contact alone, coverage of each component, and the share of contacts found."""
    assert wrench.std is not None
    inside = (wrench.mean - truth).abs() <= 2.0 * wrench.std
    touched = truth[:, :3].norm(dim=-1) > 0.0
    return {
        **rmse(wrench.mean[rows], truth[rows]),
        "force in contact": rmse(wrench.mean[rows & touched], truth[rows & touched])["force"],
        "coverage": inside[rows].double().mean(0).tolist(),
        "std": wrench.std[rows].median(0).values.tolist(),
        "found": float(wrench.detect(**detected)[truth[:, :3].norm(dim=-1) > FORCE[0]].double().mean()),
    }


def alarms(found: Tensor, period: float) -> int:
    """Number of alarms: runs of detections that are at least half a second apart."""
    rows = found.nonzero()[:, 0]
    return 0 if not len(rows) else 1 + int((rows.diff() > 0.5 / period).sum())


def compare(logs: Logs) -> dict[str, Any]:
    """Scores of all methods on one arm, by pose."""
    arm = logs.arm
    robot, frame = arm.robot, WrenchFrame(arm.frame)
    system = forcegp.ConstrainedSystem(robot)
    began = time.perf_counter()
    fit = forcegp.StructuredGP(system, "analytical").fit(logs.train[::EVERY])
    result: dict[str, Any] = {
        "fit_seconds": time.perf_counter() - began,
        "priors": [prior.name for prior in fit.force_priors],
    }
    identified = identify_rigid(system, logs.train)
    known = {"file": (robot, None), "identified": (identified.system.robot, identified.losses)}
    # Errors of friction last: what they exceed once in ten minutes is read off the training log.
    background = fit.external_wrench(logs.train[::2], arm.frame)
    limit = background.exceeded_once_in(FALSE_ALARM, logs.train.t[::2])
    detected = {"acceleration": {"limit": limit}, "momentum": {}}
    for part, (test, truth) in logs.tests.items():
        rows = test.t > 1.0
        result[part] = found = {"quasi-static": rmse(quasi_static(robot, test, frame)[rows], truth[rows])}
        found["condition"] = condition(robot, test.q)
        for name, (model, losses) in known.items():
            by_gain = {gain: momentum_residual(model, test, gain, losses) for gain in GAINS}
            J = frame.jacobian(model, test.q)
            found[f"observer, {name}"] = best(by_gain, J, truth, rows)
        for method in METHODS:
            began = time.perf_counter()
            wrench = fit.external_wrench(test, arm.frame, method=method)
            found[method] = learned_scores(wrench, truth, rows, detected[method])
            found[method]["seconds"] = time.perf_counter() - began
            for name in known:
                ratio = found[method]["force"] / found[f"observer, {name}"]["force"]
                found[method][f"over {name}"] = ratio
    for method in METHODS:
        free = fit.external_wrench(logs.free, arm.frame, method=method)
        result[f"false_alarms, {method}"] = alarms(free.detect(**detected[method]), arm.wrong.period)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=tuple(ARMS), nargs="*", default=list(ARMS))
    parser.add_argument("--case", choices=tuple(CASES), nargs="*", default=list(CASES))
    parser.add_argument("--seed", type=int, nargs="*", default=[1])
    parser.add_argument("--free", type=float, default=FREE, help="free motion for false alarms [s]")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    result = {}
    for name, case, seed in itertools.product(options.arm, options.case, options.seed):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            logs = recorded(name, replace(CASES[case]), seed, options.free)
            result[f"{name}, {case}, seed {seed}"] = found = compare(logs)
        print(f"{name}, {case}, seed {seed}: {json.dumps(found)}", flush=True)
        if options.json is not None:
            options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
