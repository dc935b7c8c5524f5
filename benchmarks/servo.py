"""Servo logs without torque: arms that MuJoCo moves, identified from commands and positions.

    python benchmarks/servo.py --json servo.json          # iiwa 14 and SO-101, 50 and 500 Hz, three seeds

Stiffness and damping in the mapping are wrong by 30 %, up or down. The true arm has drives, damping, friction
loss and commands that are late by 10 ms. Ratios are errors of joint angles
over two seconds of other commands in open loop, over those of the robot file with the nominal gains in
MuJoCo. Scales count as determined if the fit says so.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from real_cases import example_robot
from scipy.interpolate import CubicHermiteSpline
from sysid_peer import identified_servos, specification

import forcegp
from forcegp.errors import optional_module
from forcegp.files import write_text
from forcegp.logs.mapping import Mapping, parse_mapping

mujoco = optional_module("mujoco", "This benchmark")
ROBOTS = ("iiwa14", "so101")
WINDOWS = {500: 41, 50: 7}
"""Rows of the filter at each rate [Hz]."""
WRONG, DELAY, SECONDS, LENGTH, PLAYED = 1.3, 0.01, 30.0, 2.0, 3
"""Factor on gains, delay [s], lengths of the log and an open loop [s], number of open loops."""
FINE = 5000
"""Steps a second of the true arm. At 1000, the explicit servo of MuJoCo acts like 2 to 7 % more inertia."""
STATES = 200
"""States over which inertia and load are averaged."""


@dataclass(frozen=True)
class Arm:
    """An arm with its servos; gains in N m/rad and N m s/rad."""

    robot: forcegp.RobotModel
    armature: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    viscous: np.ndarray
    wrong: np.ndarray

    @classmethod
    def of(cls, name: str, random: np.random.Generator) -> Arm:
        """Random drives, gains for 4 to 8 Hz, and friction of 5 to 15 % of the load."""
        robot = example_robot("so_arm_description/urdf/so101.urdf") if name == "so101" else None
        robot = robot or forcegp.load_robot("kuka_iiwa14")
        n, q = robot.nq, torch.from_numpy(random.standard_normal((STATES, robot.nq)))
        M = forcegp.dynamics.mass_matrix(robot, q).diagonal(dim1=-2, dim2=-1).mean(0).numpy()
        load = forcegp.dynamics.gravity_force(robot, q).square().mean(0).sqrt().numpy()
        armature = (0.3 * M.max() if name == "iiwa14" else 0.02) * random.uniform(0.3, 1.0, n)
        w = 2.0 * np.pi * random.uniform(4.0, 8.0, n)
        stiffness, damping = (M + armature) * w**2, 1.6 * (M + armature) * w
        friction = np.maximum(0.1 * load, 1e-3 * stiffness) * random.uniform(0.5, 1.5, n)
        viscous = 0.1 * damping * random.uniform(0.5, 1.5, n)
        return cls(
            robot, armature, stiffness, damping, friction, viscous, WRONG ** random.choice([-1.0, 1.0], n)
        )

    def engine(self, true: bool) -> Any:
        """MuJoCo's model: the true arm, or the file with nominal damping, which is integrated implicitly."""
        model = specification(self.robot).compile()
        dof = [model.joint(joint).dofadr[0] for joint in self.robot.joint_names]
        if true:
            model.dof_armature[dof], model.dof_frictionloss[dof] = self.armature, self.friction
        model.dof_damping[dof] = self.viscous + self.damping if true else self.wrong * self.damping
        return model

    def commands(self, random: np.random.Generator) -> Any:
        """Sums of sines about the middle of each range, as a function of time."""
        limits = (self.robot.lower, self.robot.upper)
        low, high = (np.nan_to_num(x.numpy(), posinf=2.0, neginf=-2.0) for x in limits)
        ranges = (0.1, 1.0), (0.0, 1.0), (0.3, 1.0)
        hertz, turns, size = (random.uniform(*between, (5, self.robot.nq)) for between in ranges)
        w, phase = 2.0 * np.pi * hertz, 2.0 * np.pi * turns
        size = 1.5 * size / size.sum(0) * np.minimum(0.5, (high - low) / 4.0)
        return lambda t: 0.5 * (low + high) + (size * (np.sin(w * t + phase) - np.sin(phase))).sum(0)

    def mapping(self, rate: int) -> Mapping:
        """The mapping with nominal gains."""
        names = self.robot.joint_names
        stiffness, damping = (
            ", ".join(f"{j} = {x}" for j, x in zip(names, self.wrong * true, strict=True))
            for true in (self.stiffness, self.damping)
        )
        joints = "\n".join(f'{joint} = "{i}"' for i, joint in enumerate(names))
        toml = f"""time = {{ column = "t" }}
        position = {{ column = "q[{{joint}}]", unit = "rad" }}
        derivatives = {{ window = {WINDOWS[rate]} }}
        [servo]
        column = "c[{{joint}}]"
        unit = "rad"
        stiffness = {{ {stiffness} }}
        damping = {{ {damping} }}
        [joints]
        {joints}
        """
        return parse_mapping(toml.encode(), "servo")

    def log(
        self, random: np.random.Generator, seconds: float, rate: int, noise: float
    ) -> tuple[forcegp.Dataset, Any]:
        """The import of the log of the true arm, and its commands."""
        model, command, rows = self.engine(true=True), self.commands(random), []
        model.opt.timestep = 1.0 / FINE
        data, every = mujoco.MjData(model), round(FINE / rate)
        data.qpos[:] = command(0.0)
        for k in range(round(FINE * seconds)):
            t = k / FINE
            if k % every == 0:
                q = data.qpos + noise * random.standard_normal(self.robot.nq)
                rows.append([np.full_like(q, t), q, command(t)])
            data.ctrl[:] = self.stiffness * (command(max(0.0, t - DELAY)) - data.qpos)
            mujoco.mj_step(model, data)
        t, q, c = np.array(rows).transpose(1, 0, 2)
        with tempfile.TemporaryDirectory() as made:
            path = Path(made) / "log.npz"
            np.savez(path, t=t[:, 0], q=q, c=c)
            return forcegp.read_log(path, self.robot, self.mapping(rate)), command

    def file_error(self, log: forcegp.Dataset, command: Any, rate: int, peer: Any = None) -> float:
        """Mean square error of angles in MuJoCo with the robot file and nominal gains, without delay; or of
        the model that `mujoco.sysid` identified, with the true delay."""
        model, errors = peer or self.engine(true=False), []
        data, every = mujoco.MjData(model), round(1000 / rate)
        data.qpos[:], data.qvel[:] = log.q[0].numpy(), log.qd[0].numpy()
        for k in range(round(1000 * LENGTH)):
            if k % every == 0:
                errors.append(data.qpos - log.q[k // every].numpy())
            now = float(log.t[0]) + 1e-3 * k
            if peer is not None:
                data.ctrl[:] = command(now - DELAY)
            else:
                data.ctrl[:] = self.wrong * self.stiffness * (command(now) - data.qpos)
            mujoco.mj_step(model, data)
        return float(np.square(errors).mean())


def compared(name: str, rate: int, seed: int, noise: float, with_peer: bool) -> dict[str, Any]:
    """Open loops, gains and drives of one arm."""
    random = np.random.default_rng(seed)
    arm = Arm.of(name, random)
    train, trained = arm.log(random, SECONDS, rate, noise)
    test, command = arm.log(random, LENGTH * PLAYED + 1.0, rate, noise)
    begin = time.perf_counter()
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(arm.robot)).fit(train)
    seconds, rows = time.perf_counter() - begin, round(LENGTH * rate)
    begin, peer = time.perf_counter(), None
    if with_peer:
        nominal = arm.wrong * arm.stiffness, arm.wrong * arm.damping
        peer = identified_servos(arm.robot, train, *nominal, lambda t: trained(max(0.0, t - DELAY)))
    peer_seconds = time.perf_counter() - begin
    ours, file, peers = [], [], []
    for k in range(PLAYED):
        part = test[k * rows : (k + 1) * rows + 1]
        path = fit.rollout(part.q[0], part.qd[0], part, duration=LENGTH)
        steps, joints = len(path.t), arm.robot.nq
        q, qd = (x.reshape(steps, joints).numpy() for x in (path.q, path.qd))
        # Steps are not those of the log.
        played = CubicHermiteSpline(path.t.numpy(), q, qd)((part.t - part.t[0]).numpy().clip(max=LENGTH))
        ours.append(float(np.square(played - part.q.numpy()).mean()))
        file.append(arm.file_error(part, command, rate))
        peers.append(arm.file_error(part, command, rate, peer) if with_peer else np.nan)
    own = {p.name: p for p in fit.parameters()}
    scales = [own[f"drives.scale of {joint}"] for joint in arm.robot.joint_names]
    (step,) = (step for step in train.header.provenance if "commands" in step)
    return {
        "case": f"{name}, {rate} Hz, seed {seed}",
        "delay_ms": step.split("commands ")[1].split(" ms")[0],
        "open_loop_rad": float(np.sqrt(np.mean(ours))),
        "file_rad": float(np.sqrt(np.mean(file))),
        "peer_rad": float(np.sqrt(np.mean(peers))),
        "peer_seconds": peer_seconds,
        "determined": [p.determined for p in scales],
        "errors": [float(p.value - (1.0 / x - 1.0)) for p, x in zip(scales, arm.wrong, strict=True)],
        "std": [p.std for p in scales],
        "armature_errors": (fit.system.robot.armature.numpy() - arm.armature).tolist(),
        "armature_std": [own[f"inertial.drive of {joint}"].std for joint in arm.robot.joint_names],
        "armature": arm.armature.tolist(),
        "seconds": seconds,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", choices=ROBOTS, action="append")
    parser.add_argument("--rate", type=int, choices=tuple(WINDOWS), action="append")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--noise", type=float, default=1e-5, help="standard deviation of positions [rad]")
    parser.add_argument("--peer", action="store_true", help="identify by mujoco.sysid too (minutes)")
    parser.add_argument("--json", type=Path, help="write the results there")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    results = []
    for name in arguments.robot or ROBOTS:
        for rate in arguments.rate or WINDOWS:
            for seed in range(arguments.seeds):
                one = compared(name, rate, seed, arguments.noise, arguments.peer)
                results.append(one)
                ratio = one["open_loop_rad"] / one["file_rad"]
                shown = f"{sum(one['determined'])} of {len(one['determined'])} scales determined"
                open_loop = f"{one['open_loop_rad']:.4f} rad, {ratio:.3f} × the file"
                if arguments.peer:
                    beside = one["open_loop_rad"] / one["peer_rad"]
                    open_loop += f", {beside:.3f} × mujoco.sysid ({one['peer_seconds']:.0f} s)"
                print(
                    f"{one['case']}: {open_loop}; delay {one['delay_ms']} ms; {shown}; {one['seconds']:.1f} s"
                )
    known = [
        (abs(e), s)
        for one in results
        for e, s, d in zip(one["errors"], one["std"], one["determined"], strict=True)
        if d
    ]
    within = np.mean([e <= 2.0 * s for e, s in known])
    print(f"{len(known)} scales: ±2σ holds {within:.2f}, median error {np.median([e for e, _ in known]):.3f}")
    errors, std, true = (
        np.concatenate([one[key] for one in results])
        for key in ("armature_errors", "armature_std", "armature")
    )
    held, size = np.mean(np.abs(errors) <= 2.0 * std), np.median(np.abs(errors) / true)
    print(f"{len(errors)} armatures: ±2σ holds {held:.2f}, median error {100 * size:.0f} %")
    if arguments.json:
        write_text(arguments.json, json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
