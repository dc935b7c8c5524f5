"""Logs in order that faults are planted in, made once."""

from __future__ import annotations

import pytest

import forcegp
from forcegp.checks import log_of
from forcegp.constraints import ConstrainedSystem
from forcegp.simulate import SimulationConfig, simulate
from planted_faults import Case, free_log


@pytest.fixture(scope="session")
def free() -> Case:
    """Free motion of an arm with four joints: as many faults as with seven, in a tenth of the time."""
    locked = {f"lbr_iiwa_joint_{k}": 0.3 for k in (5, 6, 7)}
    robot = forcegp.load_robot("kuka_iiwa", locked_joints=locked)
    return ConstrainedSystem(robot, []), free_log(robot, seconds=15.0)


@pytest.fixture(scope="session")
def touching() -> Case:
    """The paper's task with the tip lifted now and then."""
    system = forcegp.load_scene("kuka_plane").system()
    config = SimulationConfig(duration=11.0, seed=11, lift_probability=0.15, engine="mujoco")
    return system, log_of(simulate(system, config).data)
