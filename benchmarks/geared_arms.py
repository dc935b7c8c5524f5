"""Arms with geared drives in MuJoCo: drive inertia and normal force by default fits, beside the truth.

    python benchmarks/geared_arms.py --json result.json          # six minutes
    python benchmarks/geared_arms.py --arm z1 --seed 3 --contact

xArm 7, UR10 and Z1 have links 15 % heavier than their files, drives that the files lack, and friction with
memory (LuGre's model, in contact Dahl's). Angles are rounded, torques noisy, and velocities pass a filter of
second order at 30 Hz, so that they lag by 7 ms. Accelerations come from the import, in contact from these
velocities. Drive and link of the first joint are known by their sum only.

With `--contact`, the tip wipes a table in MuJoCo, and half of the log is learned from. The normal force while
the tip slides is compared with that of equations of motion with the file, and of full least squares: links,
drives and friction of free motion.
"""

from __future__ import annotations

import argparse
import dataclasses
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
from sticking import Dahl, residual
from torch import Tensor

import forcegp
from forcegp.errors import optional_module
from forcegp.identification import regressor
from forcegp.logs import parse_mapping
from forcegp.simulate import Sensors, simulate

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


TABLES = {
    "xarm7": ((0.0, 0.0, 0.1), (0.4, 0.1, 0.1), 25.0),
    "ur10": ((0.0, 0.0, 0.1), (0.6, 0.15, 0.05), 25.0),
    "z1": ((0.05, 0.0, -0.05), (0.4, 0.05, 0.15), 10.0),
}
"""Tip in its frame, centre of the wiped square [m], and pressing force [N]."""
SQUARE = (0.15, 0.15)
SLIDES, STEEP = 0.04, 0.05
"""Speed of a tip that slides [m/s], and of joints at which dry friction changes its sign [rad/s]."""
SENSORS = Sensors(encoder_resolution=2e-5, velocity_noise=5e-4, torque_noise=0.1)
WIPING = 30.0
LEARNED = 4000
"""Largest number of samples learned from in contact."""


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
        table[:, own] = lfilter(*butter(2, CUTOFF, fs=1.0 / WRONG.period), table[:, own], axis=0)
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


def wiped(name: str, seed: int) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """The system with the file, and the log of an arm that wipes a table, with filtered velocities."""
    (file, drives, dry), (point, centre, force) = ARMS[name], TABLES[name]
    robot, random = robot_of(file), np.random.default_rng(seed)
    last = robot.nq - (2 if name == "z1" else 1)  # the gripper of the Z1 is a joint
    pairs = zip(robot.frame_names, robot.frame_parents, strict=True)
    plane = forcegp.Plane(normal=(0.0, 0.0, 1.0), offset=centre[2])
    frame = [each for each, parent in pairs if parent == last][-1]
    tip = forcegp.SurfaceContact(name="table", frame=frame, point=point, surface=plane)
    system = forcegp.ConstrainedSystem(robot, [tip], baumgarte=forcegp.constraints.Baumgarte(10.0, 1.0))
    drives, dry = (np.array(x) * random.uniform(0.5, 1.5, robot.nq) for x in (drives, dry))
    true = robot.replace(
        mass=HEAVIER * robot.mass,
        inertia=HEAVIER * robot.inertia,
        armature=robot.armature + torch.from_numpy(drives),
    )
    config = forcegp.load_scene("ur5_wiping").simulation
    solver = dataclasses.replace(config.solver, joint_friction=tuple(dry), joint_damping=tuple(0.6 * dry))
    config = dataclasses.replace(
        config,
        duration=WIPING,
        seed=seed,
        solver=solver,
        sensors=SENSORS,
        pressing_force=(force, force),
        center=centre,
        size=SQUARE,
    )
    data = simulate(system.with_robot(true), config, forces=Dahl(robot)).data
    step = float(data.t.diff().median())
    qd = lfilter(*butter(2, CUTOFF, fs=1.0 / step), data.qd.numpy(), axis=0)
    qdd = torch.from_numpy(np.gradient(qd, step, axis=0))
    header = data.header.model_copy(update={"robot_fingerprint": None})
    return system, data.replace(qd=torch.from_numpy(qd.copy()), qdd=qdd, header=header)[50:]


def losses(robot: forcegp.RobotModel, data: forcegp.Dataset) -> Tensor:
    """Columns `(n, nq, p)` of links, drives and friction of each joint."""
    eye = torch.eye(robot.nq, dtype=data.q.dtype)
    each = (data.qdd, data.qd, torch.tanh(data.qd / STEEP), torch.ones_like(data.qd))
    return torch.cat(
        [regressor(robot, data.q, data.qd, data.qdd), *(x[..., None] * eye for x in each)], dim=-1
    )


def pressed(name: str, seed: int) -> dict[str, float]:
    """Errors of the normal force while the tip of one arm slides [N]."""
    system, data = wiped(name, seed)
    train, test = data[: len(data) // 2], data[len(data) // 2 :]
    fit = forcegp.StructuredGP(system, "analytical").fit(train[:: max(1, len(train) // LEARNED)])
    force = fit.contact_force(test)
    assert force.std is not None
    free = train[~train.contact["table"]]
    X, left = losses(system.robot, free).flatten(0, 1), residual(system, free)[0].flatten()
    scale = X.square().mean(0).sqrt().clamp(min=1e-12)
    w = torch.linalg.lstsq(X / scale, left, driver="gelsd", rcond=1e-6).solution / scale
    plain, J, speed = residual(system, test)
    rows = test.contact["table"] & (speed > SLIDES)
    true = test.multiplier["table"]

    def rmse(found: Tensor) -> float:
        return float((found - true)[rows].square().mean().sqrt())

    def read(rest: Tensor) -> Tensor:
        return torch.linalg.lstsq(J.mT, rest[..., None]).solution[..., 2, 0]

    inside = ((force.mean[:, 2] - true).abs() <= 2.0 * force.std[:, 2])[rows]
    return {
        "rows": int(rows.sum()),
        "defaults": rmse(force.mean[:, 2]),
        "least squares": rmse(read(plain - losses(system.robot, test) @ w)),
        "equations of motion": rmse(read(plain)),
        "coverage": float(inside.double().mean()),
        "median_std_N": float(force.std[rows, 2].median()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=list(ARMS))
    parser.add_argument("--seed", type=int, nargs="*", default=[0, 1, 2, 3])
    parser.add_argument("--contact", action="store_true", help="normal force in contact instead of drives")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    result = {}
    if options.contact:
        for name, seed in itertools.product(options.arm, options.seed):
            result[f"{name}, seed {seed}"] = pressed(name, seed)
            print(name, seed, json.dumps(result[f"{name}, seed {seed}"]), flush=True)
        ratios = [x["defaults"] / x["least squares"] for x in result.values()]
        print("over least squares, largest:", max(ratios))
        if options.json is not None:
            options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        return
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
