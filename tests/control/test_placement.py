"""Inverse kinematics reaches the pose that it is asked for, or says that it cannot."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp import kinematics
from forcegp.control.plan import POSE_TOLERANCE, inverse_kinematics, tool_rotation
from forcegp.errors import NumericalError

FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
ROBOT = forcegp.load_robot("kuka_iiwa")
Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def _draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("seed", range(5))
def test_a_pose_of_the_arm_is_found_again(seed: int) -> None:
    q = _draw(7, seed=seed)
    rotation, _ = kinematics.frame_pose(ROBOT, q, FRAME)
    position = kinematics.point_position(ROBOT, q, FRAME, POINT)
    found = inverse_kinematics(ROBOT, FRAME, POINT, position, rotation, _draw(40, 7, seed=99), 0.0 * q)
    reached, _ = kinematics.frame_pose(ROBOT, found, FRAME)
    torch.testing.assert_close(reached, rotation, atol=10 * POSE_TOLERANCE, rtol=0.0)
    at = kinematics.point_position(ROBOT, found, FRAME, POINT)
    torch.testing.assert_close(at, position, atol=POSE_TOLERANCE, rtol=0.0)


def test_joint_limits_are_kept() -> None:
    q = _draw(7)
    near = torch.full_like(q, 0.3)
    robot = ROBOT.replace(lower=q - near, upper=q + near)
    rotation, _ = kinematics.frame_pose(robot, q, FRAME)
    position = kinematics.point_position(robot, q, FRAME, POINT)
    found = inverse_kinematics(robot, FRAME, POINT, position, rotation, _draw(40, 7, seed=1), 0.0 * q)
    assert bool(((found >= robot.lower) & (found <= robot.upper)).all())


def test_a_place_out_of_reach_is_named() -> None:
    far = torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64)
    with pytest.raises(NumericalError, match=r"tool point at \[3\.0, 0\.0, 0\.0\]"):
        inverse_kinematics(ROBOT, FRAME, POINT, far, torch.eye(3).double(), _draw(5, 7), 0.0 * _draw(7))


@pytest.mark.parametrize("axis", [Z, -Z, torch.nn.functional.normalize(_draw(3), dim=0)])
def test_the_tool_axis_points_into_the_surface(axis: torch.Tensor) -> None:
    normal = torch.nn.functional.normalize(_draw(3, seed=3), dim=0)
    ahead = torch.nn.functional.normalize(torch.linalg.cross(normal, Z), dim=0)
    R = tool_rotation(normal, ahead, axis)
    torch.testing.assert_close(R @ axis, -normal, atol=1e-12, rtol=0.0)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double(), atol=1e-12, rtol=0.0)
    assert float(torch.linalg.det(R)) == pytest.approx(1.0)
