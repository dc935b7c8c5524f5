"""Logs that users have and benchmarks seldom: default fits beside least squares.

    python benchmarks/unusual_logs.py --json result.json              # four minutes
    python benchmarks/unusual_logs.py --case "three joints move" --seed 1

Arms of `solver_arms.py` in MuJoCo, whose sensors have no gain error, move from point to point with pauses,
for ten seconds, at 50 Hz, with strong friction or noise, coarse torques, drifting offsets, outliers, joints
that stand still, a robot file that is right, or noise in place of accelerations. Continuous motions test.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from geared_arms import robot_of
from numpy.typing import NDArray
from real_cases import Case, moving
from real_logs import scores
from real_models import rigid, structured
from solver_arms import MAPPING, STEP, Arm, Imperfections, mass_matrices

import forcegp
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.logs import parse_mapping
from forcegp.robot.model import RobotModel

PLAIN = Imperfections(gain=0.0)
DAHL = dataclasses.replace(PLAIN, memory=0.03)
RIGHT = Imperfections(mass=0.0, drive=0.0, dry=0.0, viscous=0.0, gain=0.0, offset=0.0)
SIZE = 0.6
"""Share of each joint's range in which the points lie."""
TOLERANCE = 0.02
"""Relative error of the gains of torque sensors, which the bars of a fit include."""
Array = NDArray[np.float64]
Motion = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Unusual:
    """One log.

    Attributes:
        arm: a bundled robot, or a file of example-robot-data.
        wrong: what is wrong with it.
        seconds: duration of the training log [s].
        moves: pause and duration of moves from point to point [s]; `None` for a continuous motion.
        joints: joints that move from point to point; by default, all.
        torques: change of the logged torques.
        window: whether the mapping states the window of the filter.
    """

    arm: str
    wrong: Imperfections
    seconds: float = 40.0
    moves: tuple[float, float] | None = None
    joints: tuple[int, ...] | None = None
    torques: Callable[[Array, Array, np.random.Generator], Array] | None = None
    window: bool = True


def coarse(t: Array, tau: Array, random: np.random.Generator) -> Array:
    step = 0.02 * np.abs(tau).max(0)
    return np.round(tau / step) * step


def drifting(t: Array, tau: Array, random: np.random.Generator) -> Array:
    return tau + 0.02 * np.abs(tau).max(0) * np.sin(2.0 * np.pi * t / 25.0)


def outliers(t: Array, tau: Array, random: np.random.Generator) -> Array:
    rows = random.choice(len(tau), len(tau) // 200, replace=False)
    joints = random.integers(0, tau.shape[1], len(rows))
    tau = tau.copy()
    tau[rows, joints] += random.choice([-1.0, 1.0], len(rows)) * np.abs(tau).max(0)[joints]
    return tau


CASES = {
    "point to point": Unusual("ur_description/urdf/ur3_robot.urdf", DAHL, 60.0, (0.5, 1.5)),
    "point to point, fast": Unusual("ur5", DAHL, 60.0, (0.2, 0.8)),
    "ten seconds": Unusual("franka_panda", PLAIN, 10.0),
    "50 Hz": Unusual(
        "kinova_description/robots/kinova.urdf", dataclasses.replace(DAHL, period=0.02, window=5), 60.0
    ),
    "strong friction": Unusual(
        "z1_description/urdf/z1.urdf", dataclasses.replace(PLAIN, dry=0.3, memory=0.02, stribeck=0.5)
    ),
    "noisy torques": Unusual("xarm_description/urdf/xarm7.urdf", dataclasses.replace(PLAIN, noise=0.05)),
    "coarse torques": Unusual("kuka_iiwa14", DAHL, torques=coarse),
    "three joints move": Unusual("franka_panda", DAHL, 40.0, (0.5, 1.5), (1, 3, 5)),
    "right file": Unusual("ur_description/urdf/ur10_robot.urdf", RIGHT),
    "drifting offsets": Unusual("ur5", DAHL, 60.0, torques=drifting),
    "outliers": Unusual("kuka_iiwa14", PLAIN, torques=outliers),
    "noisy accelerations": Unusual(
        "franka_panda", dataclasses.replace(PLAIN, jitter=1e-4, period=0.002), 30.0, window=False
    ),
}


def point_to_point(robot: RobotModel, case: Unusual, random: np.random.Generator) -> Motion:
    """Positions, velocities and accelerations of moves along polynomials of fifth degree."""
    assert case.moves is not None
    pause, move = case.moves
    low, high = (np.nan_to_num(x.numpy(), posinf=2.0, neginf=-2.0) for x in (robot.lower, robot.upper))
    low, high = np.maximum(low, -2.0), np.minimum(high, 2.0)
    points = int(case.seconds / (pause + move)) + 2
    P = (low + high) / 2.0 + SIZE * (high - low) / 2.0 * random.uniform(-1.0, 1.0, (points, robot.nq))
    still = [j for j in range(robot.nq) if case.joints is not None and j not in case.joints]
    P[:, still] = P[0, still]
    t = np.arange(round(case.seconds / STEP)) * STEP
    k = (t / (pause + move)).astype(int)
    s, d = np.minimum(1.0, (t - k * (pause + move)) / move)[:, None], P[k + 1] - P[k]
    return (
        P[k] + d * (10 * s**3 - 15 * s**4 + 6 * s**5),
        d * (30 * s**2 - 60 * s**3 + 30 * s**4) / move,
        d * (60 * s - 180 * s**2 + 120 * s**3) / move**2,
    )


def logs_of(name: str, case: Unusual, seed: int) -> tuple[Arm, Case]:
    """The arm and its imported logs."""
    random = np.random.default_rng(1000 + seed)
    robot = (robot_of if case.arm.endswith(".urdf") else forcegp.load_robot)(case.arm)
    arm = Arm(robot, case.wrong, random)
    window = f"derivatives = {{ window = {case.wrong.window} }}" if case.window else ""
    mapping, read = parse_mapping(f"{MAPPING}{window}".encode(), "mapping"), {}
    with tempfile.TemporaryDirectory() as folder:
        for part, seconds in (("train", case.seconds), ("test", 20.0)):
            path = Path(folder) / f"{part}.csv"
            wanted = point_to_point(robot, case, random) if case.moves and part == "train" else None
            arm.record(seconds, path, wanted)
            if case.torques is not None and (part == "train" or case.torques is not outliers):
                header = path.read_text().partition("\n")[0]
                t, q, tau = np.split(np.loadtxt(path, delimiter=",", skiprows=1), [1, 1 + robot.nq], axis=1)
                rows = np.hstack([t, q, case.torques(t, tau, random)])
                np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=header, comments="")
            read[part] = forcegp.read_log(path, robot, mapping)
    system = forcegp.ConstrainedSystem(robot)
    return arm, Case(name, system, read["train"], {"test": read["test"]})


def compare(name: str, case: Unusual, seed: int) -> Mapping[str, object]:
    """Errors of a default fit over those of least squares, coverage of ±2σ, and errors of M in σ."""
    arm, logs = logs_of(name, case, seed)
    test = moving(logs.tests["test"])
    squares = rigid(lambda: identify_rigid(logs.system, logs.train)).predict(test)
    began = time.perf_counter()
    fitted = structured(logs)
    seconds = time.perf_counter() - began
    plain, ours = (scores(x, test, arm.robot) for x in (squares, fitted.predict(test)))
    key = "torque_rmse_one_mass_matrix"
    ratio = np.array(ours[key]) / plain[key]
    assert fitted.fit is not None
    arm.wrong = dataclasses.replace(arm.wrong, gain=TOLERANCE)
    M = mass_matrices(arm, fitted.fit, test.q[:: max(1, len(test) // 50)])
    return {
        "torque": float(np.exp(np.log(ratio).mean())),
        "worst_joint": float(ratio.max()),
        "coverage": ours["torque_coverage"],
        "inertia_error": [abs(x - 1.0) for x in M["fit"]],
        "inertia_sigmas": np.abs(M.get("sigmas", [0.0])).tolist(),
        "seconds": seconds,
    }


def span(values: Sequence[float]) -> str:
    return f"{min(values):.2f}–{max(values):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--seed", type=int, nargs="*", default=[0])
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    result = {}
    print("| case | torque ÷ least squares, worst joint | ±2σ | largest error of M, and in σ | s |")
    print("|---|---|---|---|---|")
    for name in options.case:
        for seed in options.seed:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found: dict = dict(compare(name, CASES[name], seed))
            result[f"{name}, seed {seed}"] = found
            inertia = f"{100 * max(found['inertia_error']):.0f} %, {max(found['inertia_sigmas']):.1f}"
            errors = f"{found['torque']:.2f}, {found['worst_joint']:.2f}"
            coverage, seconds = span(found["coverage"]), f"{found['seconds']:.0f}"
            print(f"| {name}, {seed} | {errors} | {coverage} | {inertia} | {seconds} |", flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
