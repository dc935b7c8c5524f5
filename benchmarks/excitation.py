"""Errors after a log of the excited motion, of a random Fourier series, and of the best condition number.

    python benchmarks/excitation.py --json result.json       # some minutes for each arm
    python benchmarks/excitation.py --arm ur5 --seed 0 1 --case plain --fit

Arms of `solver_arms.py` whose links are off by up to 30 % and whose joints have friction that the file
lacks record 30 s of each motion, all within the same limits and free of collisions. The motions are
planned from the file alone, for two seeds of the search, which the seeds of the arms share. `excited` has
criterion A, the default. `condition` is the condition number of the regressor of links, viscous and dry
friction, minimised by the same search. `random` is the largest of twenty random Fourier
series. Errors are those of the identified links and friction against the true ones, as torques along third
motions: `fast`, another random series within the same limits, and `slow`, that of `solver_arms.py`. They are
identified by physically consistent least squares, without and with the delay of the torque as an unknown, as
training identifies it, and, with `--fit`, by the default structured GP.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results_page import table
from solver_arms import ARMS, FOLLOWED, MAPPING, STEP, Arm, sines
from torch import Tensor
from write_back import WRONG

import forcegp
from forcegp.control.information import Unknowns
from forcegp.dynamics import damping_force, inverse_dynamics
from forcegp.evaluation.least_squares import LeastSquares, identify_rigid
from forcegp.identification import regressor
from forcegp.logs import parse_mapping
from forcegp.models.calibrated import calibrated
from forcegp.robot.shapes import shapes_of
from forcegp.simulate.collisions import Collisions
from forcegp.simulate.excite import FINE, Limits, Search, Spline, excite, random_states

SECONDS, TEST = 30.0, 20.0
SPEED, RATE = 2.0, 6.0
"""Limits where a file has none, or larger ones [rad/s, rad/s²]."""
SERIES = 20
FAST, SLOW = "fast", "slow"
"""Third motions: a random Fourier series within the same limits, and that of `solver_arms.py`."""
DESIGNS = 2
LOST = 0.5
"""An arm that is further from its motion than this has left it, as simulations that diverge do [rad]."""
PLAIN = replace(WRONG, drive=0.0)
SENSORS = {"plain": PLAIN, "noisy": replace(PLAIN, noise=0.02, ripple=0.02)}
"""Noise of `write_back.py`, and noise and ripple of 2 % of the largest torque."""
Motion = tuple[np.ndarray, np.ndarray, np.ndarray]


def condition(G: Tensor, unknowns: Unknowns) -> Tensor:
    """Log condition number of the regressor, columns in units of their prior standard deviations."""
    links = unknowns.base.rank
    each = (unknowns.parts["friction"].stop - links) // unknowns.robot.nq
    columns = [*range(links), *(links + each * j + k for j in range(unknowns.robot.nq) for k in (0, 1))]
    scale = unknowns.root[columns].norm(dim=-1)
    values = torch.linalg.eigvalsh(scale[:, None] * G[columns][:, columns] * scale)
    return 0.5 * (values[-1].log() - values[0].log())


def motions(name: str, seed: int) -> tuple[dict[str, Motion], dict[str, Any]]:
    """The motions of an arm at the steps of the engine, and how they were found."""
    robot = forcegp.load_robot(name)
    system = forcegp.ConstrainedSystem(robot)
    limits = Limits.of(robot, velocity=robot.velocity_limit.clamp(max=SPEED).tolist(), acceleration=[RATE])
    found, notes = {}, {}
    for label, criterion in {"excited": "A", "condition": condition}.items():
        began, cpu = time.perf_counter(), time.process_time()
        result = excite(system, SECONDS, limits=limits, criterion=criterion, rate=1.0 / STEP, seed=seed)
        notes[label] = {
            "seconds": time.perf_counter() - began,
            "cpu_seconds": time.process_time() - cpu,
            "used": dict(result.used),
            "torque_std": {
                k: u.torque_std()["all"].tolist()
                for k, u in (("before", result.before), ("after", result.after))
            },
        }
        found[label] = tuple(x.numpy() for x in (result.motion.q, result.motion.qd, result.motion.qdd))
    spline = Spline(found["excited"][0][0], SECONDS)
    region = random_states(robot, limits)
    unknowns = Unknowns.of(robot, limits.low, limits.high, limits.velocity, region)
    search = Search(spline, limits, unknowns, Collisions(system, shapes_of(robot)), condition)
    t = np.linspace(0.0, SECONDS, round(SECONDS / STEP) + 1)
    for label, first in {"random": 1000, FAST: 2000}.items():
        random = np.random.default_rng(first + seed)
        drawn = [spline.random(limits, random) for _ in range(SERIES)]
        small = [search.shrunk(x, 0.05)[0] for x in drawn]
        sizes = [float(np.abs(y).max() / np.abs(x).max()) for x, y in zip(drawn, small, strict=True)]
        x, used = search.shrunk(small[int(np.argmax(sizes))], FINE)
        notes[label] = {"share": max(sizes), "used": used}
        q, qd, qdd = (matrix @ x for matrix in spline.at(t))
        found[label] = q + spline.start, qd, qdd
    return found, notes


def log(arm: Arm, motion: Motion, seed: int, folder: Path) -> forcegp.Dataset:
    """What an arm records along a motion."""
    window = f"{MAPPING}derivatives = {{ window = {arm.wrong.window} }}".encode()
    arm.random, arm.further = (np.random.default_rng([seed, k]) for k in range(2))
    arm.record(SECONDS, folder / "log.csv", motion)
    return forcegp.read_log(folder / "log.csv", arm.robot, parse_mapping(window, "mapping"))


def truth(arm: Arm, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Torque of the true links, drives, viscous and dry friction, without noise and ripple `(n, nq)`.

    MuJoCo's dry friction develops over some 0.03 rad/s, like tanh(q̇ / `FOLLOWED`).
    """
    dry = arm.true.dof_frictionloss.copy()
    arm.true.dof_frictionloss[:] = 0.0
    data, found = arm.mujoco.MjData(arm.true), []
    for rows in zip(q.numpy(), qd.numpy(), qdd.numpy(), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = rows
        arm.mujoco.mj_inverse(arm.true, data)
        found.append(data.qfrc_inverse.copy())
    arm.true.dof_frictionloss[:] = dry
    return torch.from_numpy(np.array(found)) + torch.from_numpy(dry) * torch.tanh(qd / FOLLOWED)


def without_delay(squares: LeastSquares, log: forcegp.Dataset) -> forcegp.Dataset:
    """The log without the delay of its torques, which is an unknown of least squares beside those found."""
    robot, q, qd, qdd = squares.system.robot, log.q, log.qd, log.qdd
    torque = inverse_dynamics(robot, q, qd, qdd) - damping_force(robot, qd) + squares.losses(qd)
    rate = torch.gradient(torque, spacing=float(log.t[1]), dim=0)[0]
    dry = torch.tanh(qd / robot.friction_velocity)
    friction = [torch.diag_embed(x) for x in (qd, dry, torch.ones_like(qd))]
    A = torch.cat([rate[..., None], regressor(robot, q, qd, qdd), *friction], dim=-1)
    weight = (log.tau - torque).std(0)[:, None]
    A, y = (A / weight).flatten(0, 1), ((log.tau - torque) / weight[:, 0]).flatten()
    x = torch.linalg.lstsq(A / A.norm(dim=0).clamp(min=1e-12), y[:, None], driver="gelsd").solution
    return log.replace(tau=log.tau - float(x[0, 0] / A[:, 0].norm()) * rate)


def errors(
    arm: Arm, train: forcegp.Dataset, fit: bool, thirds: Mapping[str, Motion]
) -> dict[str, list[float]]:
    """Root mean square error of each joint's torque along third motions."""
    system = forcegp.ConstrainedSystem(arm.robot)
    sharp = arm.robot.replace(friction_velocity=torch.full_like(arm.robot.mass, FOLLOWED))
    squares = identify_rigid(system.with_robot(sharp), train)
    shifted = identify_rigid(system.with_robot(sharp), without_delay(squares, train))
    found = {"least squares": squares, "with delay": shifted}
    if fit:
        gp = calibrated(forcegp.StructuredGP(system, "analytical").fit(train)).robot
        nothing = torch.zeros(3 * gp.nq, dtype=gp.dtype)
        found["fit"] = LeastSquares(
            system.with_robot(gp.replace(friction_velocity=sharp.friction_velocity)), nothing
        )
    rmse = {}
    for third, motion in thirds.items():
        states = [torch.from_numpy(x[::20]) for x in motion]
        exact = truth(arm, *states)
        for model, each in found.items():
            robot = each.system.robot
            torque = inverse_dynamics(robot, *states) - damping_force(robot, states[1])
            error = torque + each.losses(states[1]) - exact
            rmse[f"{model}, {third}"] = error.square().mean(0).sqrt().tolist()
    return rmse


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=list(ARMS))
    parser.add_argument("--seed", type=int, nargs="*", default=list(range(10)))
    parser.add_argument("--case", choices=SENSORS, nargs="*", default=list(SENSORS))
    parser.add_argument("--fit", action="store_true", help="fit the default structured GP too")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    result: dict[str, Any] = {}
    rows, designs = [], {}
    for name in options.arm:
        searched = {k: motions(name, k) for k in sorted({seed % DESIGNS for seed in options.seed})}
        designs[name] = {k: motion for k, (motion, _) in searched.items()}
        result[name] = {"motions": {k: notes for k, (_, notes) in searched.items()}}
    for case, name, seed in itertools.product(options.case, options.arm, options.seed):
        arm = Arm(forcegp.load_robot(name), SENSORS[case], np.random.default_rng(seed))
        found = {}
        with tempfile.TemporaryDirectory() as folder:
            planned = designs[name][seed % DESIGNS]
            slow = sines(arm.robot, TEST, np.random.default_rng([seed, 2]))
            thirds = {FAST: planned[FAST], SLOW: slow}
            for label, motion in planned.items():
                if label == FAST:
                    continue
                train = log(arm, motion, seed, Path(folder))
                wanted = np.array([np.interp(train.t, STEP * np.arange(len(q)), q) for q in motion[0].T])
                followed = float(np.abs(train.q.numpy() - wanted.T).max()) < LOST
                found[label] = errors(arm, train, options.fit, thirds) if followed else {}
        result[name][f"{case}, seed {seed}"] = found
        if options.json:
            options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        if lost := [label for label, value in found.items() if not value]:
            print(f"seed {seed}", name, case, "left the motion:", *lost, flush=True)
            continue
        for model in found["excited"]:
            ratio = [np.divide(found["excited"][model], found[k][model]) for k in ("random", "condition")]
            rows.append((name, case, model, *(float(np.exp(np.log(x).mean())) for x in ratio)))
            print(f"seed {seed}", *rows[-1], flush=True)
    head = ["arm", "torques", "model", "÷ random", "÷ condition"]
    groups = dict.fromkeys(row[:3] for row in rows)
    means = [
        [*group, *(f"{np.mean([row[k] for row in rows if row[:3] == group]):.3f}" for k in (3, 4))]
        for group in groups
    ]
    print(table(head, means))


if __name__ == "__main__":
    main()
