"""Poses, Jacobians and bias accelerations on random trees: Pinocchio's figures, and their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import jacrev, jvp

from forcegp import kinematics
from forcegp.errors import ShapeError, UnknownNameError
from forcegp.robot.model import RobotModel
from random_robots import Mirror, random_robot
from robots import random_states

SEEDS = range(6)
EXACT = 1e-12  # rotations and sums over a few links in double precision
POINT = (0.1, -0.3, 0.2)


@pytest.mark.parametrize("seed", SEEDS)
def test_link_poses_against_pinocchio(seed: int) -> None:
    robot = random_robot(seed, nq=8)
    mirror, q = Mirror(robot), random_states(robot, 2, seed)[0]
    for link in range(robot.nq):
        R, p = kinematics.frame_pose(robot, q, f"link{link}")
        for k in range(2):
            rotation, position = mirror.link_pose(q[k], link)
            assert np.abs(R[k].numpy() - rotation).max() < EXACT
            assert np.abs(p[k].numpy() - position).max() < EXACT


@pytest.mark.parametrize("seed", SEEDS)
def test_jacobian_is_the_derivative_of_the_pose(seed: int) -> None:
    robot = random_robot(seed)
    q, qd = (x[0] for x in random_states(robot, 1, seed)[:2])
    J = kinematics.frame_jacobian(robot, q, "tool", POINT)
    slope = jacrev(lambda q: kinematics.point_position(robot, q, "tool", POINT))(q)
    torch.testing.assert_close(J[3:], slope, rtol=EXACT, atol=EXACT)
    torch.testing.assert_close(kinematics.point_jacobian(robot, q, "tool", POINT), J[3:])
    R, Rdot = jvp(lambda q: kinematics.frame_pose(robot, q, "tool")[0], (q,), (qd,))
    torch.testing.assert_close(Rdot, kinematics.skew(J[:3] @ qd) @ R, rtol=EXACT, atol=EXACT)
    velocity = kinematics.point_velocity(robot, q, qd, "tool", POINT)
    torch.testing.assert_close(velocity, slope @ qd, rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("seed", SEEDS)
def test_bias_acceleration_is_the_change_of_the_jacobian(seed: int) -> None:
    robot = random_robot(seed)
    q, qd = (x[0] for x in random_states(robot, 1, seed)[:2])
    Jdot = jvp(lambda q: kinematics.frame_jacobian(robot, q, "tool", POINT), (q,), (qd,))[1]
    bias = bias_acceleration(robot, q, qd, "tool", POINT)
    torch.testing.assert_close(bias, Jdot @ qd, rtol=1e-11, atol=1e-11)


def bias_acceleration(
    robot: RobotModel, q: torch.Tensor, qd: torch.Tensor, frame: str, point: object = (0.0, 0.0, 0.0)
) -> torch.Tensor:
    """[ω̇; p̈] at q̈ = 0 of a frame and a point fixed in it, `(*batch, 6)`."""
    poses = kinematics.link_poses(robot, q)
    motion = kinematics.link_motion(robot, poses, qd)
    return kinematics.point_motion(robot, poses, motion, qd, frame, point).bias


def test_the_base_frame_stands_still() -> None:
    robot = random_robot(0)
    q, qd = random_states(robot, 5)[:2]
    R, p = kinematics.frame_pose(robot, q, "base")
    assert torch.equal(R, robot.base_rotation.expand(5, 3, 3))
    assert torch.equal(p, robot.base_position.expand(5, 3))
    assert not kinematics.frame_jacobian(robot, q, "base").any()
    assert not bias_acceleration(robot, q, qd, "base").any()


@pytest.mark.parametrize("batch", [(), (0,), (2, 3), (500,)])
def test_batches_of_any_shape(batch: tuple[int, ...]) -> None:
    robot = random_robot(1)
    q, qd = (x[: int(np.prod(batch))].reshape(*batch, robot.nq) for x in random_states(robot, 500)[:2])
    poses = kinematics.link_poses(robot, q)
    assert poses.rotation.shape == (*batch, robot.nq, 3, 3)
    assert poses.position.shape == (*batch, robot.nq, 3)
    assert kinematics.frame_jacobian(robot, q, "tool").shape == (*batch, 6, robot.nq)
    assert bias_acceleration(robot, q, qd, "tool").shape == (*batch, 6)
    R, p = kinematics.frame_pose(robot, q, f"link{robot.nq - 1}")
    assert torch.equal(R, poses.rotation[..., -1, :, :])
    torch.testing.assert_close(p, poses.position[..., -1, :] + robot.base_position)


def test_rotations_are_rotations() -> None:
    robot = random_robot(2, nq=12)
    R = kinematics.link_poses(robot, random_states(robot, 400)[0]).rotation
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R @ R.mT, eye, rtol=0.0, atol=1e-13)  # twelve products of rotations
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(400, 12, dtype=R.dtype))


def test_skew_is_the_vector_product() -> None:
    a, b = torch.randn(2, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = torch.as_tensor(np.cross(a.numpy(), b.numpy()))
    torch.testing.assert_close((kinematics.skew(a) @ b[..., None])[..., 0], expected)


def test_second_derivatives_at_zero() -> None:
    robot = random_robot(3, nq=3, aligned=True)
    q = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)

    def position(q: Tensor) -> Tensor:
        return kinematics.point_position(robot, q, "tool", POINT)

    assert torch.autograd.gradcheck(position, q)
    assert torch.autograd.gradgradcheck(position, q)


def test_errors() -> None:
    robot = random_robot(0)
    q = torch.zeros(robot.nq, dtype=torch.float64)
    with pytest.raises(UnknownNameError, match=r"unknown frame of robot 'random0' 'tol'(.|\n)*mean 'tool'"):
        kinematics.frame_pose(robot, q, "tol")
    with pytest.raises(ShapeError, match=r"q has the wrong shape(.|\n)*got: \(5,\)"):
        kinematics.link_poses(robot, q[:5])
