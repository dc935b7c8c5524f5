"""The real logs that models are compared on: which part trains, which tests, and what is in motion."""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

import forcegp
from forcegp.errors import DataError
from forcegp.logs import parse_mapping

IN_MOTION = 0.01
"""A sample is in motion where a joint moves faster [rad/s]."""
TRAINING_SEGMENTS = 7
"""Of the ten segments of `motion_a`; the last three test."""
EARLY = 0.6
"""Share of a single recording that trains; the rest tests."""
OFF = 1.2
"""Factor on masses and lengths of the double pendulum whose robot file is wrong."""


@dataclass(frozen=True)
class Case:
    """A robot with a log to train on and logs to test on."""

    name: str
    system: forcegp.ConstrainedSystem
    train: forcegp.Dataset
    tests: dict[str, forcegp.Dataset]
    rollouts: bool = False
    """Whether the first test is predicted in open loop too."""


def existing(path: Path) -> Path:
    """The path, if it is there.

    Raises:
        DataError: it is not.
    """
    if not path.exists():
        raise DataError(
            f"{path}: this log is not here",
            expected="the published files of the log",
            hint="say where the logs are with --logs; examples/data has a part of one of them",
        )
    return path


def iiwa14(logs: Path) -> list[Case]:
    """Free motion at 200 Hz: the last three segments and another motion test."""
    robot = forcegp.load_robot("kuka_iiwa14")
    folder = existing(logs / "kuka_iiwa14")
    first, second = (
        forcegp.read_log(existing(folder / name), robot, "iiwa14_txt") for name in ("motion_a", "motion_b")
    )
    early = first.segment < TRAINING_SEGMENTS
    tests = {"motion_a, last three segments": first[~early], "motion_b": second}
    return [Case("iiwa14", forcegp.ConstrainedSystem(robot), first[early], tests)]


def double_pendulum(logs: Path) -> list[Case]:
    """Three recordings train, the fourth tests; with the published robot file and with a wrong one."""
    folder = existing(logs / "double_pendulum" / "design_C.1")
    robot = forcegp.load_robot(existing(folder / "model_1.1.urdf"))
    wrong = robot.replace(
        mass=OFF * robot.mass,
        com=OFF * robot.com,
        inertia=OFF**3 * robot.inertia,
        placement_position=OFF * robot.placement_position,
    )
    cases = []
    for name, known in (("double pendulum", robot), ("double pendulum, robot file off by 20 %", wrong)):
        recordings = [
            forcegp.read_log(path, known, "double_pendulum_csv") for path in sorted(folder.glob("*.csv"))
        ]
        train = forcegp.Dataset.concatenate(recordings[:3])
        tests = {"fourth file": recordings[3]}
        cases.append(Case(name, forcegp.ConstrainedSystem(known), train, tests, rollouts=True))
    return cases


def example_robot(name: str) -> forcegp.RobotModel:
    """A robot of example-robot-data (see `example_file`)."""
    return forcegp.load_robot(example_file(name))


def example_file(name: str) -> Path:
    """A robot file of example-robot-data, a test dependency.

    Raises:
        DataError: it is not installed.
    """
    spec = find_spec("cmeel")
    if spec is None or spec.origin is None:
        raise DataError(f"{name}: example-robot-data is not installed", hint="pip install example-robot-data")
    return existing(Path(spec.origin).parents[1] / "cmeel.prefix/share/example-robot-data/robots" / name)


def halved(name: str, robot: forcegp.RobotModel, data: forcegp.Dataset) -> list[Case]:
    """The early part of one recording trains, the late part tests."""
    early = int(EARLY * len(data))
    return [Case(name, forcegp.ConstrainedSystem(robot), data[:early], {"last part": data[early:]})]


def ur3(logs: Path) -> list[Case]:
    """Currents as torques at 125 Hz: one motion trains, another one tests, both ways."""
    robot, folder = example_robot("ur_description/urdf/ur3_robot.urdf"), existing(logs / "ur3")
    first, second = (forcegp.read_log(folder / f"{name}.mat", robot, "ur3_mat") for name in ("id1", "id2"))
    system = forcegp.ConstrainedSystem(robot)
    return [
        Case("ur3, id1 trains", system, first, {"id2": second}),
        Case("ur3, id2 trains", system, second, {"id1": first}),
    ]


def ur10(logs: Path) -> list[Case]:
    """An exciting trajectory of 28 s at 125 Hz."""
    robot = example_robot("ur_description/urdf/ur10_robot.urdf")
    path = existing(logs / "ros2" / "ur10_exciting_trajectory.db3")
    return halved("ur10", robot, forcegp.read_log(path, robot))


KINOVA = """
time = { column = "Time", unit = "ms" }
position = { column = "Position{joint}", unit = "rad" }
velocity = { column = "Velocity{joint}", unit = "rad/s" }
torque = { column = "TorqueCur{joint}", unit = "Nm" }
[joints]
""" + "\n".join(f'joint_{i} = "{i}"' for i in range(1, 8))
"""Torques are those of the currents; the column `Torque` of the log is computed by a model of the vendor."""


def kinova(logs: Path) -> list[Case]:
    """Currents at 1 kHz: motions of all joints and of single ones train (17 s), another one tests (2 s)."""
    folder = existing(logs / "kinova_gen3")
    robot = forcegp.load_robot(folder / "gen3.urdf")
    mapping = parse_mapping(KINOVA.encode(), "kinova")
    names = ("RecordTrajectory_quadratic", "joint_1_trapez", "joint_4_trapez", "RunTrajectory1")
    *train, test = (forcegp.read_log(folder / f"{name}.csv", robot, mapping) for name in names)
    system = forcegp.ConstrainedSystem(robot)
    return [Case("kinova", system, forcegp.Dataset.concatenate(train), {"RunTrajectory1": test})]


STAUBLI = """
time = { column = "t" }
joints = { joint_1 = "0", joint_2 = "1", joint_3 = "2", joint_4 = "3"{wrist} }
[position]
column = "q[{joint}]"
unit = "rad"
side = "motor"
gear_ratio = { joint_1 = 32.0, joint_2 = 32.0, joint_3 = 45.0, joint_4 = -48.0{ratios} }
offset = { joint_1 = 0.0, joint_2 = 50.26548245743669, joint_3 = -70.68583470577035, joint_4 = 0.0{zeros} }
[torque]
column = "tau[{joint}]"
unit = "Nm"
side = "motor"
gear_ratio = { joint_1 = 32.0, joint_2 = 32.0, joint_3 = 45.0, joint_4 = -48.0{ratios} }
[derivatives]
window = 151
"""
"""Motor side at 5 kHz; offsets are those of q₂ − π/2 and q₃ + π/2. The filter spans 30 ms."""
WRIST = {
    "wrist": ', joint_5 = "4", joint_6 = "5"',
    "ratios": ", joint_5 = 45.0, joint_6 = 32.0",
    "zeros": ", joint_5 = 0.0, joint_6 = 0.0",
}
STAUBLI_STEP = 2e-4
"""Sampling time [s]; the files hold no clock."""
WRIST_SECONDS = 6.0
"""The part of the log with all six joints that trains [s]; the rest tests."""


def staubli(logs: Path) -> list[Case]:
    """The first four joints of an arm with a coupled wrist, which is taken as locked."""
    folder = existing(logs / "staubli_tx40")
    robot = forcegp.load_robot(
        existing(folder / "tx40_mdh_modified.urdf"), locked_joints={"joint_5": 0.0, "joint_6": 0.0}
    )
    return halved("staubli", robot, _staubli_log(folder, robot, dict.fromkeys(WRIST, "")))


def staubli_wrist(logs: Path) -> list[Case]:
    """All six joints: the last drive moves by q₆ + q₅. Its link, which has no inertia, gets 1e-4 kg m²."""
    folder = existing(logs / "staubli_tx40")
    head, link = existing(folder / "tx40_mdh_modified.urdf").read_text().split('<link name="link_6">')
    for axis in ("ixx", "iyy", "izz"):
        link = re.sub(rf'{axis}="[0.]+"', f'{axis}="1e-4"', link, count=1)
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / "tx40.urdf"
        path.write_text(f'{head}<link name="link_6">{link}')
        robot = forcegp.load_robot(path, coupling={"joint_6": {"joint_5": 1.0}})
    data = _staubli_log(folder, robot, WRIST)
    early, system = data.t - data.t[0] < WRIST_SECONDS, forcegp.ConstrainedSystem(robot)
    return [Case("staubli, coupled wrist", system, data[early], {"last part": data[~early]})]


def _staubli_log(folder: Path, robot: forcegp.RobotModel, parts: dict[str, str]) -> forcegp.Dataset:
    """The log of the motors, with parts of the mapping."""
    toml = STAUBLI
    for name, part in parts.items():
        toml = toml.replace(f"{{{name}}}", part)
    names = "pos_read_data", "curr_data"
    q, tau = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in names)
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / "log.npz"
        np.savez(path, t=STAUBLI_STEP * np.arange(len(q)), q=q, tau=tau)
        return forcegp.read_log(path, robot, parse_mapping(toml.encode(), "staubli"))


CASES = {
    "iiwa14": iiwa14,
    "double_pendulum": double_pendulum,
    "ur3": ur3,
    "ur10": ur10,
    "kinova": kinova,
    "staubli": staubli,
    "staubli_wrist": staubli_wrist,
}


def moving(data: forcegp.Dataset) -> forcegp.Dataset:
    """Samples in motion."""
    return data[data.qd.abs().amax(-1) > IN_MOTION]


def evenly(data: forcegp.Dataset, count: int) -> forcegp.Dataset:
    """At most `count` samples, evenly spaced."""
    return data[torch.linspace(0, len(data) - 1, min(count, len(data))).round().long().unique()]
