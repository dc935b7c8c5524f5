"""The arms that tests run on: bundled ones, and those of example-robot-data with supported joints."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

import forcegp
from forcegp import dynamics, kinematics
from forcegp.errors import RobotFileWarning
from forcegp.robot.load import BUNDLED
from forcegp.robot.model import RobotModel


def example_data() -> Path:
    """Folder of the robots of example-robot-data."""
    spec = find_spec("cmeel")
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parents[1] / "cmeel.prefix/share/example-robot-data/robots"


@dataclass(frozen=True)
class Arm:
    """A robot file, and the joints that it must have locked to be supported."""

    name: str
    source: str
    locked: dict[str, float] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        """The file."""
        if self.source in BUNDLED:
            return Path(forcegp.__file__).parent / "robot/bundled" / f"{self.source}.urdf"
        return example_data() / self.source

    def load(self, **options: object) -> RobotModel:
        """The robot, without the warnings on its inertias."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RobotFileWarning)
            return forcegp.load_robot(self.path, locked_joints=self.locked, **options)  # type: ignore[arg-type]


def _example(name: str, source: str, **locked: float) -> Arm:
    return Arm(name, source, locked)


ARMS = (
    *(Arm(name, name) for name in BUNDLED),
    _example(
        "panda", "panda_description/urdf/panda.urdf", panda_finger_joint1=0.01, panda_finger_joint2=0.01
    ),
    _example("ur3", "ur_description/urdf/ur3_robot.urdf"),
    _example("ur3_gripper", "ur_description/urdf/ur3_gripper.urdf"),
    _example("ur5", "ur_description/urdf/ur5_robot.urdf"),
    _example("ur5_limited", "ur_description/urdf/ur5_joint_limited_robot.urdf"),
    _example("ur5_gripper", "ur_description/urdf/ur5_gripper.urdf"),
    _example("ur10", "ur_description/urdf/ur10_robot.urdf"),
    _example("xarm7", "xarm_description/urdf/xarm7.urdf"),
    _example("z1", "z1_description/urdf/z1.urdf"),
    _example("kinova", "kinova_description/robots/kinova.urdf"),
    _example("double_pendulum_data", "double_pendulum_description/urdf/double_pendulum.urdf"),
    _example("double_pendulum_simple", "double_pendulum_description/urdf/double_pendulum_simple.urdf"),
    _example("pendulum_continuous", "double_pendulum_description/urdf/double_pendulum_continuous.urdf"),
    _example("two_dof", "asr_twodof_description/urdf/TwoDofs.urdf"),
    _example("so100", "so_arm_description/urdf/so100.urdf"),
    _example("so101", "so_arm_description/urdf/so101.urdf"),
    _example("finger", "finger_edu_description/robots/finger_edu.urdf"),
    _example("borinot_arm", "borinot_description/urdf/borinot_flying_arm_2.urdf"),
    _example("hextilt_arm", "hextilt_description/urdf/hextilt_flying_arm_5.urdf"),
    _example("talos_left_arm", "talos_data/robots/talos_left_arm.urdf"),
    _example("allegro_right", "allegro_hand_description/urdf/allegro_right_hand.urdf"),
    _example("allegro_left", "allegro_hand_description/urdf/allegro_left_hand.urdf"),
    _example("tiago", "tiago_description/robots/tiago_no_hand.urdf"),
    _example("tiago_hand", "tiago_description/robots/tiago.urdf"),
    _example("tiago_dual", "tiago_description/robots/tiago_dual.urdf"),
    _example(
        "baxter",
        "baxter_description/urdf/baxter.urdf",
        l_gripper_r_finger_joint=0.0,
        r_gripper_r_finger_joint=0.0,
    ),
    # Legged robots and humanoids, held by the base: trees with many branches.
    _example("solo12", "solo_description/robots/solo12.urdf"),
    _example("bolt", "bolt_description/robots/bolt.urdf"),
    _example("go2", "go2_description/urdf/go2.urdf"),
    _example("anymal_kinova", "anymal_b_simple_description/robots/anymal-kinova.urdf"),
    _example("g1", "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf"),
    _example("talos", "talos_data/robots/talos_reduced.urdf"),
    _example("icub", "icub_description/robots/icub.urdf"),
    _example("human", "human_description/robots/human.urdf"),
    _example("centauro", "centauro_description/urdf/centauro.urdf"),
)
"""Every supported arm, by its file."""


def random_states(robot: RobotModel, count: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Joint positions in ±π, velocities and accelerations, and forces, from a seed."""
    random = np.random.default_rng(seed)
    ranges = (np.pi, 2.0, 3.0, 20.0)
    return tuple(torch.as_tensor(random.uniform(-r, r, (count, robot.nq))) for r in ranges)


def kinetic_energy(robot: RobotModel, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
    """½ q̇ᵀ M q̇, `(*batch,)` [J]."""
    M = dynamics.mass_matrix(robot, q)
    return 0.5 * torch.einsum("...i,...ij,...j->...", qd, M, qd)


def potential_energy(robot: RobotModel, q: torch.Tensor) -> torch.Tensor:
    """−Σ m g·c, relative to the base origin, `(*batch,)` [J]; its gradient is −Q_G."""
    poses = kinematics.link_poses(robot, q)
    moment = dynamics.link_inertia(robot, poses).moment.sum(1)
    return -torch.einsum("kb,k->b", moment, robot.gravity).reshape(poses.batch)
