"""Robot files calibrated from a log, simulated by MuJoCo, beside the original file and least squares.

    python benchmarks/write_back.py --json result.json       # about a minute for each arm and seed
    python benchmarks/write_back.py --arm ur5 --seed 0 1 2 3 4 --right-file
    python benchmarks/write_back.py --case dahl lugre

Arms of `solver_arms.py` whose links are off by up to 30 % and whose joints have friction and drives that the
file lacks. The calibrated files, a URDF and an MJCF of the same arm, are read back, and MuJoCo computes from
them the torques of another motion, and the motion of the next second under the logged torques. `least
squares` is physically consistent too, and has drives only as inertia of links; its torque error is that of
its own equations, with offsets. `within` counts the base parameters of links and drives, and the damping and
dry friction of joints, that lie within two standard deviations of 200 sampled robots from the truth.

With `--case dahl lugre`, dry friction has memory. MuJoCo simulates the written MJCF itself, with its
bristles, and the same file with d q̇ + f sign q̇, under the logged torques of another motion, in which all
joints reverse. Both start at logged states, the bristles bent as the logged velocities bend them, a second
each. The error is the median over starts of the RMS error of the joint angles [rad].
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from real_cases import moving
from results_page import table
from solver_arms import ARMS, CASES, STEP, Arm, Imperfections, case_of
from sysid_peer import identified

import forcegp
from forcegp.dynamics import inverse_dynamics, mass_matrix
from forcegp.errors import optional_module
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.identification import regressor
from forcegp.kinematics import frame_pose
from forcegp.models.calibrated import calibrated, sampled_robots, write_calibrated
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.inertia import inertial_parameters
from forcegp.robot.model import RobotModel
from forcegp.robot.write_back import write_robot
from forcegp.simulate.urdf import write_urdf

mujoco = optional_module("mujoco", "This benchmark")
WRONG = Imperfections(mass=0.3, gain=0.0, offset=0.0)
"""Links off by up to 30 %, undeclared friction and drives; torque sensors are right."""
RIGHT = replace(WRONG, mass=0.0, drive=0.0, dry=0.0, viscous=0.0)
FORMATS, SYSID = ("urdf", "xml"), "mujoco.sysid"
SAMPLES, SMALLEST = 200, 1e-6
"""Sampled robots, and the least eigenvalue of the information on a base parameter, over the largest."""
STARTS, AHEAD = 30, 1.0
"""Open-loop motions, and how long each lasts [s]."""

Array = NDArray[np.float64]


def prepared(model: Any, robot: RobotModel) -> Any:
    """A model with the options of the arm's."""
    model.opt.gravity[:] = robot.gravity.numpy()
    model.opt.timestep = STEP
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    return model


def simulated(robot: RobotModel) -> Any:
    """A robot file in MuJoCo, with its joint friction."""
    model = prepared(mujoco.MjModel.from_xml_string(write_urdf(robot)), robot)
    model.dof_damping[:], model.dof_armature[:] = robot.damping.numpy(), robot.armature.numpy()
    model.dof_frictionloss[:] = robot.friction.numpy()
    return model


def torques(model: Any, log: forcegp.Dataset) -> Array:
    """Inverse dynamics of a MuJoCo model along a log, dry friction against the motion."""
    dry = model.dof_frictionloss.copy()
    model.dof_frictionloss[:] = 0.0
    data, found = mujoco.MjData(model), []
    for q, qd, qdd in zip(log.q.numpy(), log.qd.numpy(), log.qdd.numpy(), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse + dry * np.sign(qd))
    return np.array(found)


def ahead(robot: RobotModel, log: forcegp.Dataset) -> Array:
    """Positions of the joints a second after each start, under the logged torques."""
    model, period = simulated(robot), float(log.t[1] - log.t[0])
    steps, each = round(AHEAD / period), round(period / STEP)
    data, found = mujoco.MjData(model), []
    for start in np.linspace(0, len(log) - steps - 1, STARTS).astype(int):
        data.qpos[:], data.qvel[:] = log.q[start].numpy(), log.qd[start].numpy()
        for k in range(start, start + steps):
            data.qfrc_applied[:] = log.tau[k].numpy()
            for _ in range(each):
                mujoco.mj_step(model, data)
        found.append([start + steps, *data.qpos])
    return np.array(found)


def deviations(fit: StructuredFit, arm: Arm, log: forcegp.Dataset) -> dict[str, list[float]]:
    """Errors of base parameters and friction, in standard deviations of sampled robots."""
    robot, nq, true = arm.robot, arm.robot.nq, arm.true
    S = InertialPrior().with_drives(mass_matrix(robot, log.q).diagonal(dim1=-2, dim2=-1).mean(0)).scale(robot)

    def parameters(each: RobotModel) -> torch.Tensor:
        links = inertial_parameters(each.mass, each.com, each.inertia)
        return torch.cat([links.flatten(), each.armature]) / S

    columns = torch.cat([regressor(robot, log.q, log.qd, log.qdd), torch.diag_embed(log.qdd)], dim=-1) * S
    A = (columns / log.tau.std(0)[:, None]).flatten(0, 1)
    values, vectors = torch.linalg.eigh(A.mT @ A)
    B = vectors[:, values > SMALLEST * values[-1]].mT
    factor = torch.from_numpy(true.body_mass[1:]) / robot.mass
    truth = robot.replace(
        mass=factor * robot.mass,
        inertia=factor[:, None, None] * robot.inertia,
        armature=torch.from_numpy(true.dof_armature),
    )
    friction = torch.from_numpy(np.concatenate([true.dof_damping, true.dof_frictionloss + arm.dry]))
    samples = sampled_robots(fit, SAMPLES)
    base = torch.stack([B @ parameters(each) for each in samples]), B @ parameters(truth)
    dry = torch.stack([torch.cat([each.damping, each.friction]) for each in samples]), friction
    assert len(friction) == 2 * nq
    scores = {name: (x.mean(0) - y) / x.std(0) for name, (x, y) in (("base", base), ("friction", dry))}
    return {name: x.tolist() for name, x in scores.items()}


def tip_error(robot: RobotModel, file: RobotModel, log: forcegp.Dataset) -> float:
    """Median distance of the last frame of `robot`, moved as `file`, from where it was a second later [m]."""
    found = ahead(file, log)
    rows, frame = found[:, 0].astype(int), robot.frame_names[-1]
    there, was = (
        frame_pose(robot, q, frame)[1] for q in (torch.from_numpy(found[:, 1:].copy()), log.q[rows])
    )
    return float((there - was).norm(dim=-1).median())


def bent(model: Any, log: forcegp.Dataset) -> Array:
    """Bristles `(n, na)` of the LuGre friction of a model at the velocities of a log."""
    joints = model.actuator_trnid[model.actuator_actadr >= 0, 0]
    dof, law = model.jnt_dofadr[joints], model.actuator_biasprm[model.actuator_actadr >= 0, 3:6].T
    stiffness, z, found = model.actuator_dynprm[model.actuator_actadr >= 0, 5], np.zeros(model.na), []
    for v, dt in zip(log.qd.numpy()[:, dof], log.t.diff(append=log.t[-1:]).numpy(), strict=True):
        found.append(z)
        # dz/dt = v − σ₀ |v| z / g
        g = law[0] + (law[1] - law[0]) * np.exp(-((v / law[2]) ** 2))
        end = g * np.sign(v) / stiffness
        z = end + (z - end) * np.exp(-stiffness * np.abs(v) / g * dt)
    return np.array(found).reshape(len(log), model.na)


def angle_error(path: Path, robot: RobotModel, log: forcegp.Dataset) -> float:
    """Median over starts of the RMS error of the angles within a second under the logged torques [rad]."""
    model, period = prepared(mujoco.MjModel.from_xml_path(str(path)), robot), float(log.t[1] - log.t[0])
    steps, each, bristles = round(AHEAD / period), round(period / STEP), bent(model, log)
    data, q, tau, errors = mujoco.MjData(model), log.q.numpy(), log.tau.numpy(), []
    for start in np.linspace(0, len(log) - steps - 1, STARTS).astype(int):
        data.qpos[:], data.qvel[:], data.act[:] = q[start], log.qd[start].numpy(), bristles[start]
        moved = []
        for k in range(start, start + steps):
            data.qfrc_applied[:] = tau[k]
            for _ in range(each):
                mujoco.mj_step(model, data)
            moved.append(data.qpos - q[k + 1])
        errors.append(np.sqrt(np.mean(np.square(moved))))
    return float(np.median(errors))


def with_memory(name: str, seed: int, kind: str, folder: Path) -> dict[str, float]:
    """Errors of the original file, and of the written ones without and with memory."""
    robot = forcegp.load_robot(name)
    wrong = replace(WRONG, memory=CASES[kind].memory, stribeck=CASES[kind].stribeck)
    arm = Arm(robot, wrong, np.random.default_rng(seed))
    case = case_of(name, arm, folder)
    fit = forcegp.StructuredGP(case.system, "analytical").fit(case.train)
    spec = mujoco.MjSpec.from_string(write_urdf(robot))
    spec.option.timestep = STEP
    spec.compile()
    (folder / "file.xml").write_text(spec.to_xml(), encoding="utf-8")
    write_robot(calibrated(fit).robot, folder / "file.xml", folder / "plain.xml")
    write_calibrated(fit, folder / "file.xml", folder / "memory.xml")
    files = ("file", "plain", "memory")
    errors = {key: angle_error(folder / f"{key}.xml", robot, case.tests["test"]) for key in files}
    read = forcegp.load_robot(folder / "memory.xml")
    bristles = 0.0 if read.bristle is None else float((read.bristle > 0.0).double().mean())
    return errors | {"memory_over_plain": errors["memory"] / errors["plain"], "joints_with_memory": bristles}


def measured(name: str, seed: int, wrong: Imperfections, folder: Path, *, sysid: bool = False) -> dict:
    """Errors of the original file, the calibrated one and the peers on another motion."""
    robot = forcegp.load_robot(name)
    arm = Arm(robot, wrong, np.random.default_rng(seed))
    if wrong is RIGHT:  # the friction of the file is right too
        arm.true.dof_damping[:], arm.true.dof_frictionloss[:] = robot.damping.numpy(), robot.friction.numpy()
    case = case_of(name, arm, folder)
    test = case.tests["test"]
    fit = forcegp.StructuredGP(case.system, "analytical").fit(case.train)
    mujoco.mj_saveLastXML(str(folder / "file.xml"), mujoco.MjModel.from_xml_string(write_urdf(robot)))
    files = {"file": robot}
    for kind, source in {"urdf": name, "xml": folder / "file.xml"}.items():
        write_calibrated(fit, source, folder / f"calibrated.{kind}")
        files[kind] = forcegp.load_robot(folder / f"calibrated.{kind}")
    rows = moving(test)
    errors = {key: torques(simulated(each), rows) - rows.tau.numpy() for key, each in files.items()}
    squares = identify_rigid(case.system, case.train)
    rigid = inverse_dynamics(squares.system.robot, rows.q, rows.qd, rows.qdd)
    errors["least squares"] = (rigid + squares.losses(rows.qd) - rows.tau).numpy()
    if sysid:
        errors[SYSID] = torques(identified(robot, case.train), rows) - rows.tau.numpy()
    rmse = {key: np.sqrt((error**2).mean(0)) for key, error in errors.items()}
    tip = {key: tip_error(robot, each, test) for key, each in files.items()}
    found: dict[str, Any] = {
        "deviations": deviations(fit, arm, rows[::10]),
        "torque_rmse": {key: value.tolist() for key, value in rmse.items()},
        "tip_m": tip,
    }
    for kind in FORMATS:
        by_file, by_squares = rmse[kind] / rmse["file"], rmse[kind] / rmse["least squares"]
        found[kind] = {
            "over_file": float(np.exp(np.log(by_file).mean())),
            "over_least_squares": float(np.exp(np.log(by_squares).mean())),
            "worst_joint_over_least_squares": float(by_squares.max()),
            "tip_over_file": tip[kind] / tip["file"],
        }
        if sysid:
            by_sysid = rmse[kind] / rmse[SYSID]
            found[kind]["over_sysid"] = float(np.exp(np.log(by_sysid).mean()))
            found[kind]["worst_joint_over_sysid"] = float(by_sysid.max())
    return found


def scores(options: argparse.Namespace, result: dict[str, Any]) -> None:
    """Print and write the errors of files with and without memory."""
    keys, rows = ("file", "plain", "memory", "memory_over_plain", "joints_with_memory"), []
    for kind, name, seed in itertools.product(options.case, options.arm, options.seed):
        with tempfile.TemporaryDirectory() as folder:
            found = result[f"{name}, {kind}, seed {seed}"] = with_memory(name, seed, kind, Path(folder))
        rows.append([f"{name}, {kind}, seed {seed}", *(f"{found[key]:.3g}" for key in keys)])
        print(*rows[-1], flush=True)
    heads = ("angles: file [rad]", "d q̇ + f sign q̇", "with memory", "with ÷ without", "joints with memory")
    print(table(["arm, friction, seed", *heads], rows))
    for kind in options.case:
        ratios = [x["memory_over_plain"] for key, x in result.items() if f", {kind}," in key]
        mean = float(np.exp(np.mean(np.log(ratios))))
        print(f"{kind}: with ÷ without memory, geometric mean {mean:.3f}, largest {max(ratios):.3f}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=list(ARMS))
    parser.add_argument(
        "--case", choices=("dahl", "lugre"), nargs="*", default=[], help="friction with memory"
    )
    parser.add_argument("--seed", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--right-file", action="store_true", help="arms whose file is right")
    parser.add_argument("--sysid", action="store_true", help=f"{SYSID} too (sysid_peer.py; minutes for each)")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    result = {}
    if options.case:
        scores(options, result)
        return
    keys = ["over_file", "over_least_squares", "worst_joint_over_least_squares", "tip_over_file"]
    keys += ["over_sysid", "worst_joint_over_sysid"] if options.sysid else []
    rows = []
    for name in options.arm:
        for seed in options.seed:
            with tempfile.TemporaryDirectory() as folder:
                wrong = RIGHT if options.right_file else WRONG
                found = result[f"{name}, seed {seed}"] = measured(
                    name, seed, wrong, Path(folder), sysid=options.sysid
                )
            for kind in FORMATS:
                rows.append([f"{name}, seed {seed}", kind, *(f"{found[kind][key]:.3f}" for key in keys)])
                print(*rows[-1], flush=True)
    head = ["arm, seed", "format", "torque ÷ file", "÷ least squares", "worst joint", "tip after 1 s ÷ file"]
    head += [f"÷ {SYSID}", "worst joint"] if options.sysid else []
    print(table(head, rows))
    for kind in ("base", "friction"):
        z = np.abs(np.concatenate([found["deviations"][kind] for found in result.values()]))
        print(f"{kind}: {(z <= 2.0).mean():.2f} of {len(z)} within 2σ, median {np.median(z):.2f}σ")
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
