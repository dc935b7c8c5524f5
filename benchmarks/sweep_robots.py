"""Load every robot file of a folder or package and compare each joint with Pinocchio or MuJoCo.

    python benchmarks/sweep_robots.py --json sweep.json [FOLDER ...]

URDF files are compared with Pinocchio, MJCF files with MuJoCo, at random states: the mass matrix, the bias
force with gravity, and viscous damping, in every joint that moves. If a file is refused since joints must be
locked, it is loaded again with the positions that the message proposes. The default folders are those of
example-robot-data, pybullet_data and mujoco. The exit code is 1 if a file loads and differs, or ends in an
error that is not typed. It needs `pip install forcegp[mujoco] pin`.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import time
import warnings
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco as mujoco_
import numpy as np
import pinocchio
import torch

import forcegp
from forcegp import dynamics
from forcegp.errors import ForceGPError, UnsupportedRobotError

pin: Any = pinocchio
mujoco: Any = mujoco_
STATES = 3
RELATIVE = 1e-6
"""Largest relative difference per joint, scaled by the diagonal of M and the largest force."""
FLOOR = 1e-6
"""Force added to the scale, so that the rounding of vanishing forces is no difference [N m, N]."""
PACKAGES = ("cmeel", "pybullet_data", "mujoco")


def folders() -> list[Path]:
    """Return the folders of the installed packages with robot files."""
    found = []
    for name in PACKAGES:
        spec = find_spec(name)
        if spec is not None and spec.submodule_search_locations:
            folder = Path(next(iter(spec.submodule_search_locations)))
            found.append(
                folder.parent / "cmeel.prefix/share/example-robot-data" if name == "cmeel" else folder
            )
    return found


def robot_files(roots: list[Path]) -> list[Path]:
    """Return all URDF files, and all XML files with a `<mujoco>` document."""
    files = [path for root in roots for path in sorted(root.rglob("*.urdf"))]
    documents = [path for root in roots for path in sorted(root.rglob("*.xml"))]
    return files + [path for path in documents if re.search(rb"<mujoco\b", path.read_bytes()[: 1 << 16])]


def load(path: Path) -> tuple[forcegp.RobotModel, dict[str, float]]:
    """Load a robot, with the joints locked that the error proposes. Return the locked positions, too."""
    try:
        return forcegp.load_robot(path), {}
    except UnsupportedRobotError as error:
        proposed = re.search(r"locked_joints=(\{.+?\})", str(error))
        if proposed is None:
            raise
        locked = ast.literal_eval(proposed[1])
        return forcegp.load_robot(path, locked_joints=locked), locked


class PinocchioFile:
    """Pinocchio's equations of motion of a URDF file."""

    def __init__(self, path: Path, robot: forcegp.RobotModel, locked: dict[str, float]) -> None:
        model = pin.buildModelFromUrdf(str(path))
        self.held = dict(locked)
        for name in set(model.names[1:]) - set(robot.joint_names) - set(locked):
            raise LookupError(f"joint {name!r} is not in the robot")
        model.gravity.linear = robot.gravity.numpy()
        model.armature = np.zeros(model.nv)
        self.model, self.data = model, model.createData()
        self.joints = [model.joints[model.getJointId(name)] for name in robot.joint_names]
        self.dofs = [joint.idx_v for joint in self.joints]
        # Pinocchio reads damping into the model, and does not apply it.
        self.damping = model.damping[self.dofs]

    def __call__(self, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return M, Q_C + Q_G and Q_D."""
        model, position, velocity = self.model, pin.neutral(self.model), np.zeros(self.model.nv)
        held = [(model.joints[model.getJointId(name)], x) for name, x in self.held.items()]
        for joint, x in (*zip(self.joints, q, strict=True), *held):
            value = [x] if joint.nq == 1 else [np.cos(x), np.sin(x)]
            position[joint.idx_q : joint.idx_q + joint.nq] = value
        velocity[self.dofs] = qd
        M = pin.crba(model, self.data, position)
        M = np.triu(M) + np.triu(M, 1).T
        force = pin.rnea(model, self.data, position, velocity, np.zeros(model.nv))
        return M[np.ix_(self.dofs, self.dofs)], -force[self.dofs], -self.damping * qd


class MuJoCoFile:
    """MuJoCo's equations of motion of an MJCF file, without constraints, tendon springs and fluids."""

    def __init__(self, path: Path, robot: forcegp.RobotModel, locked: dict[str, float]) -> None:
        self.model = model = mujoco.MjModel.from_xml_path(str(path))
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        model.opt.gravity[:] = robot.gravity.numpy()
        model.opt.density = model.opt.viscosity = 0.0
        model.tendon_stiffness[:] = 0.0
        names = [model.joint(i).name or f"joint_{i}" for i in range(model.njnt)]
        self.data, index = mujoco.MjData(model), {name: i for i, name in enumerate(names)}
        for name in set(names) - set(robot.joint_names) - set(locked):
            raise LookupError(f"joint {name!r} is not in the robot")
        for name, x in locked.items():
            self.data.qpos[model.jnt_qposadr[index[name]]] = x
        joints = [index[name] for name in robot.joint_names]
        self.dofs, self.places = model.jnt_dofadr[joints], model.jnt_qposadr[joints]

    def __call__(self, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return M, Q_C + Q_G and Q_D."""
        model, data = self.model, self.data
        data.qpos[self.places], data.qvel[self.dofs] = q, qd
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        for column, unit in zip(M, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        dofs = self.dofs
        return M[np.ix_(dofs, dofs)], -data.qfrc_bias[dofs], data.qfrc_passive[dofs].copy()


def compare(path: Path) -> dict[str, Any]:
    """Return the outcome for one file: equal, different, refused, or a failure."""
    try:
        robot, locked = load(path)
    except ForceGPError as error:
        return {"outcome": "refused", "error": type(error).__name__, "message": str(error).split("\n")[0]}
    except Exception as error:
        return {"outcome": "failure", "message": f"{type(error).__name__}: {error}"}
    oracle = MuJoCoFile if path.suffix == ".xml" else PinocchioFile
    try:
        theirs = oracle(path, robot, locked)
    except (ValueError, RuntimeError, LookupError) as error:
        return {"outcome": "no reference", "joints": robot.nq, "message": str(error).strip().split("\n")[0]}
    worst = np.zeros(robot.nq)
    random = np.random.default_rng(0)
    for _ in range(STATES):
        q, qd = random.uniform(-1.0, 1.0, robot.nq), random.normal(size=robot.nq)
        x, xd = torch.from_numpy(q), torch.from_numpy(qd)
        M, force = dynamics.mass_matrix(robot, x), dynamics.bias_force(robot, x, xd)
        ours = M.numpy(), (force + dynamics.gravity_force(robot, x)).numpy(), -robot.damping.numpy() * qd
        reference = theirs(q, qd)
        scale = np.sqrt(np.diag(reference[0]))
        worst = np.maximum(worst, (np.abs(ours[0] - reference[0]) / np.outer(scale, scale)).max(-1))
        for one, other in zip(ours[1:], reference[1:], strict=True):
            worst = np.maximum(worst, np.abs(one - other) / (np.abs(other).max() + FLOOR))
    differing = {robot.joint_names[i]: float(worst[i]) for i in np.flatnonzero(~(worst <= RELATIVE))}
    return {
        "outcome": "different" if differing else "equal",
        "joints": robot.nq,
        "locked": len(locked),
        "largest": float(worst.max()),
        "differing": differing,
        "remarks": [remark.removeprefix(str(path)) for remark in robot.remarks],
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, help="default: those of the installed packages")
    parser.add_argument("--json", type=Path, help="write the outcomes to this file")
    options = parser.parse_args()
    start, files = time.perf_counter(), {}
    roots = options.folders or folders()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for root in roots:
            for path in robot_files([root]):
                files[f"{root.name}/{path.relative_to(root)}"] = compare(path)
    outcomes = Counter(result["outcome"] for result in files.values())
    refused = Counter(result["error"] for result in files.values() if result["outcome"] == "refused")
    summary = {
        "files": len(files),
        "outcomes": dict(outcomes),
        "refused": dict(refused),
        "joints": sum(result["joints"] for result in files.values() if result["outcome"] == "equal"),
        "largest": max((r["largest"] for r in files.values() if r["outcome"] == "equal"), default=0.0),
        "seconds": round(time.perf_counter() - start, 1),
    }
    if options.json:
        options.json.write_text(json.dumps({"summary": summary, "files": files}, indent=1))
    print(json.dumps(summary, indent=1))
    raise SystemExit(bool(outcomes["different"] + outcomes["failure"]))


if __name__ == "__main__":
    main()
