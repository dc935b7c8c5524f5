"""Arms that MuJoCo moves, with what a robot file does not say: the defaults beside least squares.

    python benchmarks/solver_arms.py --json result.json          # some minutes
    python benchmarks/solver_arms.py --arm ur5 --seed 3

Each arm differs from its file in masses of links, inertia of drives, dry and viscous friction, offsets and
gains of the torque sensors, all drawn at random. Encoders are rounded, torques noisy, and accelerations come
from the encoders alone. None of this library's equations of motion plays a part. Errors are counted as on
real logs (`real_logs.py`), on another motion than that of the training.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from real_cases import Case, moving
from real_logs import scores
from real_models import rigid, structured

import forcegp
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.robot.model import RobotModel
from forcegp.simulate.mujoco import import_mujoco
from forcegp.simulate.urdf import write_urdf

ARMS = ("franka_panda", "kuka_iiwa14", "ur5")
DT, STEPS = 0.004, 8
"""Sampling period [s], and steps of the engine in one."""
SECONDS = {"train": 40.0, "test": 20.0}
REACH = 0.35
"""Share of each joint's range that the motion spans."""


@dataclass(frozen=True)
class Imperfections:
    """How far an arm and its sensors may be from the robot file; the draws are uniform, but for the noise.

    Attributes:
        mass: relative error of the mass and the inertia of each link.
        drive: inertia of a drive, over the mean of its joint's diagonal entry of the mass matrix.
        dry: dry friction, over the largest torque of gravity and motion.
        viscous: viscous friction at 1 rad/s, likewise.
        gain: relative error of each torque sensor.
        offset: of each torque sensor, over the largest torque.
        noise: standard deviation of the torque's noise, over the largest torque.
        encoder: resolution [rad].
    """

    mass: float = 0.15
    drive: float = 0.3
    dry: float = 0.05
    viscous: float = 0.05
    gain: float = 0.02
    offset: float = 0.01
    noise: float = 0.005
    encoder: float = 2e-5


def sines(
    robot: RobotModel, seconds: float, random: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Positions, velocities and accelerations of a sum of five sines at each step of the engine."""
    t = np.arange(round(seconds / DT * STEPS)) * (DT / STEPS)
    low, high = (np.nan_to_num(x.numpy(), posinf=2.0, neginf=-2.0) for x in (robot.lower, robot.upper))
    low, high = np.maximum(low, -2.0), np.minimum(high, 2.0)
    q = np.tile((low + high) / 2.0, (len(t), 1))
    qd, qdd = np.zeros_like(q), np.zeros_like(q)
    for k in range(1, 6):
        w = 0.2 * np.pi * k * random.uniform(0.8, 1.2, robot.nq)  # a motion that does not repeat itself
        size = REACH * (high - low) / 5.0 * random.uniform(0.3, 1.0, robot.nq) / k**0.5
        angle = w * t[:, None] + random.uniform(0.0, 2.0 * np.pi, robot.nq)
        q, qd, qdd = (
            q + size * np.sin(angle),
            qd + size * w * np.cos(angle),
            qdd - size * w * w * np.sin(angle),
        )
    return q, qd, qdd


class Arm:
    """An arm in MuJoCo that differs from its robot file.

    Args:
        robot: what the robot file says.
        wrong: how much is drawn.
        random: generator of the draws.
    """

    def __init__(self, robot: RobotModel, wrong: Imperfections, random: np.random.Generator) -> None:
        self.mujoco = mujoco = import_mujoco()
        self.robot, self.wrong, self.random = robot, wrong, random
        self.file = mujoco.MjModel.from_xml_string(write_urdf(robot))
        self.file.opt.gravity[:] = robot.gravity.numpy()
        self.true = true = mujoco.MjModel.from_xml_string(write_urdf(robot))
        true.opt.gravity[:] = robot.gravity.numpy()
        true.opt.timestep = DT / STEPS
        true.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        true.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        factor = 1.0 + wrong.mass * random.uniform(-1.0, 1.0, true.nbody)
        true.body_mass[:] *= factor
        true.body_inertia[:] *= factor[:, None]
        q, qd, qdd = sines(robot, 10.0, np.random.default_rng(0))
        self.scale = np.abs(
            [self.torque(*rows) for rows in zip(q[::200], qd[::200], qdd[::200], strict=True)]
        )
        self.scale = self.scale.max(0)
        n = robot.nq
        M = forcegp.dynamics.mass_matrix(robot, torch.from_numpy(q[::200]))
        inertia = M.diagonal(dim1=-2, dim2=-1).mean(0).numpy()
        true.dof_armature[:] = wrong.drive * random.uniform(0.0, 1.0, n) * inertia
        true.dof_frictionloss[:] = wrong.dry * random.uniform(0.2, 1.0, n) * self.scale
        true.dof_damping[:] += wrong.viscous * random.uniform(0.2, 1.0, n) * self.scale
        self.gain = 1.0 + wrong.gain * random.uniform(-1.0, 1.0, n)
        self.offset = wrong.offset * random.uniform(-1.0, 1.0, n) * self.scale

    def torque(self, q: NDArray, qd: NDArray, qdd: NDArray) -> NDArray[np.float64]:
        """Inverse dynamics of the robot file, as the controller knows it."""
        data = self.mujoco.MjData(self.file)
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        self.mujoco.mj_inverse(self.file, data)
        return data.qfrc_inverse.copy()

    def record(self, seconds: float, path: Path) -> None:
        """A log in CSV of the arm under a computed-torque controller."""
        mujoco, random = self.mujoco, self.random
        wanted = sines(self.robot, seconds, random)
        data = mujoco.MjData(self.true)
        data.qpos[:], data.qvel[:] = wanted[0][0], wanted[1][0]
        rows = []
        for k in range(0, len(wanted[0]), STEPS):
            q, qd, qdd = (x[k] for x in wanted)
            feedback = 100.0 * (q - data.qpos) + 20.0 * (qd - data.qvel)
            tau = self.torque(q, qd, qdd + feedback)
            logged = (
                self.gain * tau + self.offset + self.wrong.noise * self.scale * random.normal(size=len(q))
            )
            encoder = self.wrong.encoder * np.round(data.qpos / self.wrong.encoder)
            rows.append([k / STEPS * DT, *encoder, *logged])
            data.qfrc_applied[:] = tau
            mujoco.mj_step(self.true, data, STEPS)
        names = self.robot.joint_names
        header = ",".join(["t", *(f"q.{name}" for name in names), *(f"tau.{name}" for name in names)])
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=header, comments="")


def case_of(name: str, seed: int, wrong: Imperfections, folder: Path) -> Case:
    """The logs of one arm, imported."""
    robot = forcegp.load_robot(name)
    arm = Arm(robot, wrong, np.random.default_rng(seed))
    read = {}
    for part, seconds in SECONDS.items():
        path = folder / f"{name}_{seed}_{part}.csv"
        arm.record(seconds, path)
        read[part] = forcegp.read_log(path, robot)
    return Case(
        f"{name}, seed {seed}", forcegp.ConstrainedSystem(robot), read["train"], {"test": read["test"]}
    )


def compare(case: Case) -> dict:
    """Scores of the defaults and of least squares, and their ratios."""
    test = moving(case.tests["test"])
    found: dict = {}
    fits = {
        "least squares": lambda: rigid(lambda: identify_rigid(case.system, case.train)),
        "defaults": lambda: structured(case),
    }
    for model, fit in fits.items():
        began = time.perf_counter()
        fitted = fit()
        found[model] = scores(fitted.predict(test), test, case.system.robot)
        found[model] |= {"seconds": time.perf_counter() - began, "notes": fitted.notes}
    ratio = np.array(found["defaults"]["torque_rmse"]) / found["least squares"]["torque_rmse"]
    squared = np.array(found["defaults"]["acceleration_mse"]) / found["least squares"]["acceleration_mse"]
    found["ratios"] = {
        "torque": float(np.exp(np.log(ratio).mean())),
        "worst_joint": float(ratio.max()),
        "worst_acceleration": float(squared.max()),
        "coverage": found["defaults"]["torque_coverage"],
    }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=list(ARMS))
    parser.add_argument("--seed", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    result = {}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in options.arm:
            for seed in options.seed:
                case = case_of(name, seed, Imperfections(), Path(folder))
                result[case.name] = found = compare(case)
                print(case.name, json.dumps(found["ratios"]), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
