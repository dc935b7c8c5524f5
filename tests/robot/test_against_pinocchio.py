"""Every supported arm gives Pinocchio's figures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from forcegp import dynamics, kinematics
from pinocchio_oracle import Oracle
from robots import ARMS, Arm, random_states

RELATIVE = 1e-10  # of the largest entry: double precision over some hundred operations, with a wide margin
SAMPLES = 3


def relative(ours: object, theirs: np.ndarray) -> float:
    return float(np.abs(np.asarray(ours) - theirs).max() / max(np.abs(theirs).max(), 1e-12))


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_dynamics(arm: Arm) -> None:
    robot = arm.load()
    oracle = Oracle(arm, robot)
    q, qd, qdd, force = random_states(robot, SAMPLES)
    M = dynamics.mass_matrix(robot, q)
    inverse = dynamics.inverse_dynamics(robot, q, qd, qdd)
    forward = dynamics.forward_dynamics(robot, q, qd, force)
    for k in range(SAMPLES):
        state = q[k].numpy(), qd[k].numpy()
        expected = oracle.mass_matrix(state[0])
        assert relative(M[k], expected) < RELATIVE
        assert relative(inverse[k], oracle.inverse_dynamics(*state, qdd[k].numpy())) < RELATIVE
        # Rounding in M returns multiplied by its condition number, in Pinocchio's figures as in ours.
        rounding = 4.0 * np.finfo(float).eps * np.linalg.cond(expected)
        theirs = oracle.forward_dynamics(*state, force[k].numpy())
        assert relative(forward[k], theirs) < max(RELATIVE, rounding)


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_frames(arm: Arm) -> None:
    robot = arm.load()
    oracle = Oracle(arm, robot)
    q = random_states(robot, 1, seed=1)[0][0]
    bodies = {frame.name for frame in oracle.model.frames}
    frames = [name for name in robot.frame_names if name in bodies]
    assert len(frames) >= len(robot.frame_names) - 1
    for name in frames[:: max(1, len(frames) // 12)]:
        rotation, position = kinematics.frame_pose(robot, q, name)
        R, p, J = oracle.frame(q.numpy(), name)
        assert np.abs(rotation.numpy() - R).max() < RELATIVE
        assert np.abs(position.numpy() - p).max() < RELATIVE
        assert np.abs(kinematics.frame_jacobian(robot, q, name).numpy() - J).max() < RELATIVE


def test_base_pose_moves_the_frames_and_turns_gravity() -> None:
    """The same arm on a tilted base equals the arm on a level one under the gravity that its base sees."""
    arm = next(arm for arm in ARMS if arm.name == "kuka_iiwa")
    tilted = arm.load(base_rpy=(0.3, -0.5, 0.9), base_position=(1.0, 2.0, 3.0))
    level = arm.load(gravity=tuple((tilted.base_rotation.T @ tilted.gravity).tolist()))
    q, qd, qdd, _ = random_states(tilted, 4)
    ours = dynamics.inverse_dynamics(tilted, q, qd, qdd)
    torch.testing.assert_close(ours, dynamics.inverse_dynamics(level, q, qd, qdd), rtol=1e-11, atol=1e-11)
    R0, p0 = kinematics.frame_pose(level, q, "lbr_iiwa_link_7")
    R, p = kinematics.frame_pose(tilted, q, "lbr_iiwa_link_7")
    torch.testing.assert_close(R, tilted.base_rotation @ R0, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(p, p0 @ tilted.base_rotation.T + tilted.base_position, rtol=1e-12, atol=1e-12)
