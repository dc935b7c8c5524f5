"""The real logs that models are compared on: which part trains, which tests, and what is in motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

import forcegp
from forcegp.errors import DataError

IN_MOTION = 0.01
"""A sample is in motion where a joint moves faster [rad/s]."""
TRAINING_SEGMENTS = 7
"""Of the ten segments of `motion_a`; the last three test."""
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


CASES = {"iiwa14": iiwa14, "double_pendulum": double_pendulum}


def moving(data: forcegp.Dataset) -> forcegp.Dataset:
    """Samples in motion."""
    return data[data.qd.abs().amax(-1) > IN_MOTION]


def evenly(data: forcegp.Dataset, count: int) -> forcegp.Dataset:
    """At most `count` samples, evenly spaced."""
    return data[torch.linspace(0, len(data) - 1, min(count, len(data))).round().long().unique()]
