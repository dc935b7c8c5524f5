"""`load_robot`: a robot model from a bundled name, a URDF file or an MJCF file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import scipy
import torch

from forcegp.errors import RobotFileError, ShapeError, UnknownNameError
from forcegp.robot.check import checked
from forcegp.robot.fold import Pose, build_robot
from forcegp.robot.model import RobotModel
from forcegp.robot.safety import parse_xml, read_bytes
from forcegp.robot.tree import Tree, lock_joints

BUNDLED = ("double_pendulum", "franka_panda", "kuka_iiwa", "kuka_iiwa14", "ur5")


def load_robot(
    source: str | Path,
    *,
    base_position: Sequence[float | int] = (0.0, 0.0, 0.0),
    base_rpy: Sequence[float | int] = (0.0, 0.0, 0.0),
    gravity: Sequence[float | int] = (0.0, 0.0, -9.81),
    locked_joints: Mapping[str, float] | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> RobotModel:
    """A robot model from a bundled name, a URDF file or an MJCF file.

    A file that is usable but doubtful gives a `RobotFileWarning`, whose text is also in `robot.remarks`.

    Args:
        source: `"kuka_iiwa"`, `"kuka_iiwa14"`, `"franka_panda"`, `"ur5"`, `"double_pendulum"`, or the path
            of a file.
        base_position: position of the root link in the world [m].
        base_rpy: its roll, pitch and yaw about the world's axes [rad].
        gravity: gravitational acceleration in the world [m/s²]; that of an MJCF file is ignored.
        locked_joints: positions [rad, m] of joints to treat as fixed, such as those of a gripper.
        dtype: floating-point type of all constants.
        device: device of all constants.

    Returns:
        The robot; frozen, so that it can be shared.

    Example:
        >>> robot = load_robot("kuka_iiwa", gravity=(0.0, 0.0, -9.8))
        >>> robot.nq, robot.joint_names[0]
        (7, 'lbr_iiwa_joint_1')

    Raises:
        UnknownNameError: no such bundled robot, or no such joint to lock.
        RobotFileError: the file cannot be read or is not a valid robot; the message names link or joint.
        UnsupportedRobotError: a joint is floating, planar, ball or mimic; the hint says how to lock it.
        MissingDependencyError: the file is MJCF and MuJoCo is not installed.
        InertiaError: the inertia of a link is not physical.
        ShapeError: base_position, base_rpy or gravity is not a vector of three finite numbers.
    """
    pose = Pose(
        base_rotation=scipy.spatial.transform.Rotation.from_euler(
            "xyz", _vector(base_rpy, "base_rpy")
        ).as_matrix(),
        base_position=_vector(base_position, "base_position"),
        gravity=_vector(gravity, "gravity"),
        dtype=dtype,
        device=device,
    )
    tree = checked(lock_joints(_read(source), locked_joints or {}))
    return build_robot(tree, pose)


def _read(source: str | Path) -> Tree:
    if str(source) in BUNDLED:
        with as_file(files("forcegp.robot") / "bundled" / f"{source}.urdf") as path:
            return _read_file(path)
    path = Path(source).expanduser()
    if not path.suffix and path.name == str(source):
        raise UnknownNameError("robot", source, (*BUNDLED, "path of a .urdf or .xml file"))
    return _read_file(path)


def _read_file(path: Path) -> Tree:
    root = parse_xml(read_bytes(path), str(path))
    if root.tag == "robot":
        from forcegp.robot.urdf import read_urdf  # the parser is slow to import, and saved models need none

        return read_urdf(root, str(path))
    if root.tag == "mujoco":
        from forcegp.robot.mjcf import read_mjcf  # loads MuJoCo, which is optional

        return read_mjcf(root, path)
    raise RobotFileError(
        f"{path}: neither URDF nor MJCF",
        expected="a <robot> or a <mujoco> document",
        got=f"<{root.tag[:60]}>",
    )


def _vector(value: Sequence[float | int], name: str) -> np.ndarray:
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ShapeError(f"{name} is not valid", expected="three finite numbers", got=value)
    return vector
