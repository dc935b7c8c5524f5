"""Drives with gears that MuJoCo moves: their inertia as identified by a default fit, beside the truth.

    python benchmarks/geared_drives.py --json result.json          # five minutes

xArm 7, UR10 and Z1 have links 15 % heavier than their files, drives that the files lack, and friction with
memory (LuGre's model). Angles are rounded, torques noisy, and velocities pass a filter of second order at
30 Hz, so that they lag by 7 ms. Accelerations come from the import. Drive and link of the first joint are
known by their sum only.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from scipy.signal import butter, lfilter
from solver_arms import STEP, Arm, Imperfections, sines

import forcegp
from forcegp.errors import optional_module
from forcegp.logs import parse_mapping

ARMS = {
    "xarm7": (
        "xarm_description/urdf/xarm7.urdf",
        (0.6, 0.6, 0.4, 0.4, 0.2, 0.15, 0.12),
        (3.0, 3.0, 2.0, 2.0, 1.0, 1.0, 0.8),
    ),
    "ur10": (
        "ur_description/urdf/ur10_robot.urdf",
        (1.0, 1.0, 0.7, 0.3, 0.3, 0.2),
        (8.0, 8.0, 6.0, 3.0, 2.5, 2.0),
    ),
    "z1": (
        "z1_description/urdf/z1.urdf",
        (0.2, 0.2, 0.15, 0.06, 0.06, 0.04, 0.04),
        (1.5, 1.5, 1.0, 0.5, 0.5, 0.3, 0.3),
    ),
}
"""File in example-robot-data, and means of drive inertia [kg m²] and dry friction [N m]."""
WRONG = Imperfections(mass=0.0, drive=0.0, memory=0.05, stribeck=0.5, gain=0.0, period=0.002, window=21)
HEAVIER = 1.15
CUTOFF = 30.0
"""Frequency of the velocity's filter [Hz]."""
SECONDS = 40.0
MAPPING = """
time = { column = "t" }
position = { column = "q.{joint}", unit = "rad" }
velocity = { column = "qd.{joint}", unit = "rad/s" }
torque = { column = "tau.{joint}", unit = "Nm" }
"""


class Geared(Arm):
    """An arm with geared drives."""

    def __init__(
        self,
        robot: forcegp.RobotModel,
        drives: tuple[float, ...],
        dry: tuple[float, ...],
        random: np.random.Generator,
    ) -> None:
        super().__init__(robot, WRONG, random)
        self.true.body_mass[:] *= HEAVIER
        self.true.body_inertia[:] *= HEAVIER
        self.drives = np.array(drives) * random.uniform(0.5, 1.5, robot.nq)
        self.true.dof_armature[:] = self.drives
        self.true.dof_frictionloss[:] = 0.0
        self.dry = np.array(dry) * random.uniform(0.5, 1.5, robot.nq)
        self.true.dof_damping[:] = 0.6 * self.dry
        self.mujoco.mj_setConst(self.true, self.mujoco.MjData(self.true))

    def log(self, path: Path) -> forcegp.Dataset:
        """The imported log of a controller that compensates drives and friction."""
        data, n = self.mujoco.MjData(self.true), self.robot.nq
        q, qd, qdd = sines(self.robot, SECONDS, self.random)
        data.qpos[:], data.qvel[:] = q[0], qd[0]
        bristle, every, rows, tau = np.zeros(n), round(WRONG.period / STEP), [], np.zeros(n)
        for k in range(len(q)):
            if k % every == 0:
                wanted = qdd[k] + 400.0 * (q[k] - data.qpos) + 40.0 * (qd[k] - data.qvel)
                tau = self.torque(q[k], qd[k], wanted) + self.drives * wanted
                tau = tau + self.true.dof_damping * qd[k] + self.dry * np.tanh(qd[k] / 0.02)
                rows.append([k * STEP, *data.qpos, *data.qvel, *tau])
            data.qfrc_applied[:] = tau - self.losses(data, bristle)
            self.mujoco.mj_step(self.true, data)
        table = np.array(rows)
        own = slice(n + 1, 2 * n + 1)
        b, a = butter(2, CUTOFF, fs=1.0 / WRONG.period)
        table[:, own] = lfilter(b, a, table[:, own], axis=0)
        table[:, 1 : n + 1] = WRONG.encoder * np.round(table[:, 1 : n + 1] / WRONG.encoder)
        size = np.abs(table[:, 2 * n + 1 :]).max(0)
        table[:, 2 * n + 1 :] += WRONG.noise * size * self.random.normal(size=(len(table), n))
        names = [f"{x}.{name}" for x in ("q", "qd", "tau") for name in self.robot.joint_names]
        # The filter starts from zero.
        header = ",".join(["t", *names])
        np.savetxt(path, table[50:], fmt="%.9g", delimiter=",", header=header, comments="")
        text = f"{MAPPING}derivatives = {{ window = {WRONG.window} }}"
        return forcegp.read_log(path, self.robot, parse_mapping(text.encode(), "mapping"))


def robot_of(file: str) -> forcegp.RobotModel:
    """The robot of a file of example-robot-data, without friction."""
    cmeel = optional_module("cmeel", "This benchmark")
    folder = Path(next(iter(cmeel.__path__))).parent / "cmeel.prefix/share/example-robot-data/robots"
    robot = forcegp.load_robot(folder / file)
    return robot.replace(damping=torch.zeros_like(robot.damping), friction=torch.zeros_like(robot.friction))


def identified(name: str, seed: int) -> dict:
    """Drives of one arm by a default fit, and their deviations."""
    file, drives, dry = ARMS[name]
    arm = Geared(robot_of(file), drives, dry, np.random.default_rng(seed))
    with tempfile.TemporaryDirectory() as folder:
        data = arm.log(Path(folder) / "log.csv")
    began = time.perf_counter()
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(arm.robot), "analytical").fit(data)
    seconds = time.perf_counter() - began
    names = {f".drive of {joint}": joint for joint in arm.robot.joint_names}
    std = {names[end]: p.std for p in fit.parameters() for end in names if p.name.endswith(end)}
    found = fit.system.robot.armature.tolist()
    return {
        "seconds": seconds,
        "true": arm.drives.tolist(),
        "found": found,
        "sigmas": [
            (x - t) / std[j] for x, t, j in zip(found, arm.drives, arm.robot.joint_names, strict=True)
        ],
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=list(ARMS))
    parser.add_argument("--seed", type=int, nargs="*", default=[0, 1, 2, 3])
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    result = {}
    for name, seed in itertools.product(options.arm, options.seed):
        found = result[f"{name}, seed {seed}"] = identified(name, seed)
        ratio = np.round(np.array(found["found"]) / found["true"], 3).tolist()
        print(
            name, seed, ratio, np.round(found["sigmas"], 1).tolist(), f"{found['seconds']:.1f} s", flush=True
        )
    sigmas = np.abs(np.concatenate([x["sigmas"] for x in result.values()]))
    ratios = np.concatenate([np.array(x["found"]) / x["true"] for x in result.values()])
    summary = {
        "drives": len(sigmas),
        "within_2": float((sigmas <= 2.0).mean()),
        "median_error": float(np.median(np.abs(ratios - 1.0))),
        "largest_sigma": float(sigmas.max()),
    }
    print(json.dumps(summary))
    if options.json is not None:
        options.json.write_text(json.dumps(result | {"summary": summary}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
