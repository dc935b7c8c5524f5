"""Arms that MuJoCo moves, with what a robot file does not say: the defaults beside least squares.

    python benchmarks/solver_arms.py --json result.json          # some minutes
    python benchmarks/solver_arms.py --arm ur5 --seed 3 --case dahl delay --right-file

Each arm differs from its file in masses of links, inertia of drives, dry and viscous friction, offsets and
gains of the torque sensors, all drawn at random. Encoders are rounded, torques noisy, and accelerations come
from the encoders alone. Cases add friction with memory, torque ripple, a delay of the torque, or filters at
1 kHz. None of this library's equations of motion plays a part. Errors are counted as on real logs
(`real_logs.py`), on another motion than that of the training; mass matrices are compared with the engine's.
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
from numpy.typing import NDArray
from real_cases import IN_MOTION, Case, moving
from real_logs import scores
from real_models import Predicted, rigid, structured
from torch import Tensor

import forcegp
from forcegp.errors import optional_module
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.identification import regressor
from forcegp.learning.inertia import latent_precision, one_row
from forcegp.logs import parse_mapping
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.model import RobotModel
from forcegp.simulate.urdf import write_urdf

ARMS = ("franka_panda", "kuka_iiwa14", "ur5")
STEP = 0.0005
"""Time step of the engine [s]."""
SECONDS = {"train": 40.0, "test": 20.0}
STATES = 50
"""States that the mass matrix is averaged over."""
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
        memory: largest distance that a joint moves before its dry friction is fully developed [rad]: Dahl's
            model; 0 for dry friction without memory.
        stribeck: excess of the dry friction at rest over that in motion, with memory: LuGre's model.
        ripple: amplitude of a torque that is periodic in the angle, over the largest torque.
        delay: of the logged torque behind the encoders [s].
        jitter: standard deviation of the encoders' noise [rad].
        period: sampling period [s].
        window: of the filter that computes accelerations, in samples.
    """

    mass: float = 0.15
    drive: float = 0.3
    dry: float = 0.05
    viscous: float = 0.05
    gain: float = 0.02
    offset: float = 0.01
    noise: float = 0.005
    encoder: float = 2e-5
    memory: float = 0.0
    stribeck: float = 0.0
    ripple: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    period: float = 0.004
    window: int = 11


CASES = {
    "plain": Imperfections(),
    "dahl": Imperfections(memory=0.05),
    "lugre": Imperfections(memory=0.05, stribeck=0.5),
    "ripple": Imperfections(ripple=0.02),
    "delay": Imperfections(delay=0.01),
    "window 61": Imperfections(period=0.001, window=61, jitter=3e-4),
    "window 151": Imperfections(period=0.001, window=151, jitter=3e-3),
}
RIGHT_FILE = {"mass": 0.0, "drive": 0.0, "gain": 0.0}
"""Imperfections of an arm whose file is right about its inertia, with true torques."""
FOLLOWED = 0.02
"""Speed from which on a controller that follows a given motion overcomes dry friction [rad/s]."""
STRIBECK_SPEED = 0.05
"""At which friction falls to that in motion [rad/s]."""


def sines(
    robot: RobotModel, seconds: float, random: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Positions, velocities and accelerations of a sum of five sines at each step of the engine."""
    t = np.arange(round(seconds / STEP)) * STEP
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
        self.mujoco = mujoco = optional_module("mujoco", "This benchmark")
        self.robot, self.wrong, self.random = robot, wrong, random
        self.file = mujoco.MjModel.from_xml_string(write_urdf(robot))
        self.file.opt.gravity[:] = robot.gravity.numpy()
        self.known = mujoco.MjData(self.file)
        self.true = true = mujoco.MjModel.from_xml_string(write_urdf(robot))
        true.opt.gravity[:] = robot.gravity.numpy()
        true.opt.timestep = STEP
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
        dry = wrong.dry * random.uniform(0.2, 1.0, n) * self.scale
        true.dof_damping[:] += wrong.viscous * random.uniform(0.2, 1.0, n) * self.scale
        self.gain = 1.0 + wrong.gain * random.uniform(-1.0, 1.0, n)
        self.offset = wrong.offset * random.uniform(-1.0, 1.0, n) * self.scale
        self.dry = dry if wrong.memory else 0.0 * dry
        true.dof_frictionloss[:] = dry - self.dry
        self.further = further = random.spawn(1)[
            0
        ]  # the other draws stay those of a case without memory and ripple
        self.distance = wrong.memory * further.uniform(0.2, 1.0, n)
        self.teeth = further.integers(20, 100, n)

    def mass_matrix(self, q: NDArray) -> NDArray[np.float64]:
        """Diagonals of the engine's mass matrix at states `(n, nq)`."""
        data, M = self.mujoco.MjData(self.true), np.zeros((self.robot.nq, self.robot.nq))
        found = np.empty_like(q)
        for k, each in enumerate(q):
            data.qpos[:] = each
            self.mujoco.mj_forward(self.true, data)
            self.mujoco.mj_fullM(self.true, data, M)
            found[k] = M.diagonal()
        return found

    def torque(self, q: NDArray, qd: NDArray, qdd: NDArray) -> NDArray[np.float64]:
        """Inverse dynamics of the robot file, as the controller knows it."""
        data = self.known
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        self.mujoco.mj_inverse(self.file, data)
        return data.qfrc_inverse.copy()

    def losses(self, data: Any, bristle: NDArray) -> NDArray[np.float64]:
        """Dry friction with memory and ripple [N m]; moves the bristles z on by one step.

        dz/dt = q̇/δ − |q̇| z/(δ g) with δ the distance and g = 1, or the excess of friction at low speed more.
        """
        speed = data.qvel
        if self.wrong.memory:
            g = 1.0 + self.wrong.stribeck * np.exp(-((speed / STRIBECK_SPEED) ** 2))
            end = g * np.sign(speed)
            bristle[:] = end + (bristle - end) * np.exp(-np.abs(speed) * STEP / (self.distance * g))
        return self.dry * bristle + self.wrong.ripple * self.scale * np.sin(self.teeth * data.qpos)

    def record(
        self, seconds: float, path: Path, motion: tuple[NDArray, NDArray, NDArray] | None = None
    ) -> None:
        """A log in CSV of the arm under a computed-torque controller, along `sines` or a motion like it."""
        mujoco, random, wrong = self.mujoco, self.random, self.wrong
        wanted = sines(self.robot, seconds, random) if motion is None else motion
        data = mujoco.MjData(self.true)
        data.qpos[:], data.qvel[:] = wanted[0][0], wanted[1][0]
        bristle, late = np.zeros(self.robot.nq), round(wrong.delay / wrong.period)
        rows, torques = [], []
        for k in range(len(wanted[0])):
            if k % round(wrong.period / STEP) == 0:
                q, qd, qdd = (x[k] for x in wanted)
                stiff = 1.0 if motion is None else 5.0
                feedback = 100.0 * stiff**2 * (q - data.qpos) + 20.0 * stiff * (qd - data.qvel)
                torques.append(self.torque(q, qd, qdd + feedback))
                if motion is not None:  # a controller that follows overcomes friction that the file lacks
                    dry = self.true.dof_frictionloss * np.tanh(qd / FOLLOWED)
                    torques[-1] = torques[-1] + self.true.dof_damping * qd + dry
                logged = self.gain * torques[max(0, len(torques) - 1 - late)] + self.offset
                logged += wrong.noise * self.scale * random.normal(size=len(q))
                angle = data.qpos + wrong.jitter * self.further.normal(size=len(q))
                rows.append([k * STEP, *(wrong.encoder * np.round(angle / wrong.encoder)), *logged])
            data.qfrc_applied[:] = torques[-1] - self.losses(data, bristle)
            mujoco.mj_step(self.true, data)
        names = self.robot.joint_names
        header = ",".join(["t", *(f"q.{name}" for name in names), *(f"tau.{name}" for name in names)])
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=header, comments="")


MAPPING = """
time = { column = "t" }
position = { column = "q.{joint}", unit = "rad" }
torque = { column = "tau.{joint}", unit = "Nm" }
"""


def case_of(name: str, arm: Arm, folder: Path, seconds: Mapping[str, float] = SECONDS) -> Case:
    """The logs of one arm, imported."""
    mapping = parse_mapping(f"{MAPPING}derivatives = {{ window = {arm.wrong.window} }}".encode(), "mapping")
    read = {}
    for part, duration in seconds.items():
        path = folder / f"{part}.csv"
        arm.record(duration, path)
        read[part] = forcegp.read_log(path, arm.robot, mapping)
    return Case(name, forcegp.ConstrainedSystem(arm.robot), read["train"], {"test": read["test"]})


KINDS = ("", "_of_shares", "_of_posterior")
SIGMAS = ("sigmas", "relative_sigma")


def mass_matrices(arm: Arm, fit: StructuredFit, q: Tensor) -> dict:
    """Diagonals of the mass matrix over the engine's, and the fit's error in units of its standard deviation.

    The posterior of the inertial parameters has one; without it, the inertia is taken as known. No log tells
    the gain of a torque sensor from inertia, as g τ = g M q̈ + …, so the tolerance of the gains, which a data
    sheet states, counts beside the posterior, carried through the identification: Σ_j s² (∂M/∂g_j)².
    `sigmas_of_posterior` leaves it out, and `sigmas_of_shares` counts it as a share of M_jj alone.
    """
    robot, posterior, exact = fit.system.robot, fit.posterior, arm.mass_matrix(q.numpy()).mean(0)
    file, found = (
        forcegp.dynamics.mass_matrix(each, q).diagonal(dim1=-2, dim2=-1).mean(0).numpy()
        for each in (arm.robot, robot)
    )
    result: dict = {"file": (file / exact).tolist(), "fit": (found / exact).tolist()}
    for p, prior in enumerate(posterior.priors):
        if isinstance(prior, InertialPrior):
            zero, eye = torch.zeros_like(q), torch.eye(robot.nq, dtype=q.dtype)
            still = regressor(robot, q, zero, zero)
            columns = [(regressor(robot, q, zero, e.expand_as(q)) - still)[:, j] for j, e in enumerate(eye)]
            links = torch.stack([column.mean(0) for column in columns])
            C = torch.cat([links, eye[:, : len(prior.drives)]], dim=-1) * prior.scale(robot)
            inverse = latent_precision(posterior, one_row(posterior, fit.problem), p, robot)
            std = (C @ torch.linalg.solve(inverse, C.mT)).diagonal().sqrt().numpy()
            tolerance, unit = arm.wrong.gain / 3.0**0.5, C / prior.scale(robot)
            # Without identified links, no gain changed them.
            per_gain = (
                (unit @ unit.new_tensor(prior.per_gain)).norm(dim=-1).numpy() if prior.per_gain else 0.0
            )
            for key, gains in zip(KINDS, (per_gain, exact, 0.0), strict=True):
                sigma = np.hypot(std, tolerance * gains)
                result[f"sigmas{key}"] = ((found - exact) / sigma).tolist()
                result[f"relative_sigma{key}"] = (sigma / exact).tolist()
    return result


def inertia_alone(arm: Arm, case: Case) -> dict:
    """The mass matrix of a default fit, without any other score."""
    model = forcegp.StructuredGP(case.system, "analytical")
    q = moving(case.tests["test"]).q
    found = mass_matrices(arm, model.fit(case.train), q[:: max(1, len(q) // STATES)])
    return {"ratios": {}, "mass_matrix": found}


def along_the_log(fit: StructuredFit, data: forcegp.Dataset) -> Predicted:
    """Predictions with the memory of friction, at the samples in motion."""
    moves = data.qd.abs().amax(-1) > IN_MOTION
    predicted = fit.predict_log(data, noise=True)
    assert predicted.covariance is not None
    return Predicted(predicted.mean[moves], predicted.covariance[moves], fit.system)


def compare(arm: Arm, case: Case) -> dict:
    """Scores of the defaults and of least squares, their ratios, and the mass matrix."""
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
        if fitted.fit is not None:
            found["mass_matrix"] = mass_matrices(arm, fitted.fit, test.q[:: max(1, len(test) // STATES)])
        if fitted.fit is not None:
            remembering = along_the_log(fitted.fit, case.tests["test"])
            found["along the log"] = scores(remembering, test, case.system.robot)
    ratio = np.array(found["defaults"]["torque_rmse"]) / found["least squares"]["torque_rmse"]
    squared, along = (
        np.array(found[model]["acceleration_mse"]) / found["least squares"]["acceleration_mse"]
        for model in ("defaults", "along the log")
    )
    found["ratios"] = {
        "torque": float(np.exp(np.log(ratio).mean())),
        "worst_joint": float(ratio.max()),
        "acceleration": squared.tolist(),
        "worst_acceleration": float(squared.max()),
        "coverage": found["defaults"]["torque_coverage"],
        "acceleration_along": along.tolist(),
        "coverage_along": found["along the log"]["torque_coverage"],
    }
    return found


def pooled(result: Mapping[str, dict]) -> dict:
    """Errors of the mass matrix over all joints and logs."""
    each = [found["mass_matrix"] for found in result.values()]
    off = {key: np.abs(np.concatenate([m[key] for m in each]) - 1.0) for key in ("file", "fit")}
    pool: dict = {
        "logs": len(each),
        "identified": sum(m["fit"] != m["file"] for m in each),
        "untouched": sum(m["fit"] == m["file"] for m in each),
        **{f"median_{key}": float(np.median(x)) for key, x in off.items()},
    }
    known = [m for m in each if "sigmas" in m]
    for kind in KINDS if known else ():
        sigmas, widths = (np.abs(np.concatenate([m[f"{x}{kind}"] for m in known])) for x in SIGMAS)
        pool[f"sigmas{kind}"] = {
            "joints": len(sigmas),
            "within_1": float((sigmas <= 1.0).mean()),
            "within_2": float((sigmas <= 2.0).mean()),
            "largest": float(sigmas.max()),
            "median_width": float(np.median(widths)),
            "median_width_over_error": float(np.median(1.0 / sigmas)),
        }
    return pool


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=list(ARMS))
    parser.add_argument("--case", choices=CASES, nargs="*", default=["plain"])
    parser.add_argument("--seed", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--right-file", action="store_true", help="true masses, drives and torques")
    parser.add_argument("--gain", type=float, help="largest relative error of the torque sensors")
    parser.add_argument("--mass-matrix", action="store_true", help="of fits with friction priors, no scores")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    result = {}
    for case, name, seed in itertools.product(options.case, options.arm, options.seed):
        wrong = replace(CASES[case], **(RIGHT_FILE if options.right_file else {}))
        wrong = wrong if options.gain is None else replace(wrong, gain=options.gain)
        arm = Arm(forcegp.load_robot(name), wrong, np.random.default_rng(seed))
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            logs = case_of(f"{name}, {case}, seed {seed}", arm, Path(folder))
            result[logs.name] = found = (inertia_alone if options.mass_matrix else compare)(arm, logs)
        print(logs.name, json.dumps(found["ratios"] | found["mass_matrix"]), flush=True)
    print(json.dumps(pooled(result)))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
