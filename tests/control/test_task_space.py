"""The controller: its task errors decay as told, whatever the null space does."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial.transform import Rotation as SciPyRotation

import forcegp
from forcegp import ConstrainedSystem, Plane, SurfaceContact, dynamics, kinematics
from forcegp.constraints import Baumgarte
from forcegp.control.task_space import (
    Gains,
    Target,
    control_torque,
    joint_acceleration,
    orientation_error,
    task_acceleration,
)
from forcegp.errors import NumericalError
from forcegp.kinematics import PointMotion, point_motion

FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
SOLVED = 1e-9
"""Linear solves with condition numbers up to some thousands, of accelerations up to hundreds."""
ROBOT = forcegp.load_robot("kuka_iiwa", base_position=(0, 0, 0.05), gravity=(0, 0, -9.8))
FREE = ConstrainedSystem(ROBOT)


def _draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def _tool(q: torch.Tensor, qd: torch.Tensor, system: ConstrainedSystem = FREE) -> PointMotion:
    eom = system.equations(q, qd)
    return point_motion(ROBOT, eom.poses, eom.motion, qd, FRAME, POINT)


def _rotation(vector: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(SciPyRotation.from_rotvec(vector.numpy()).as_matrix())


def test_the_orientation_error_is_the_sine_of_the_angle_along_the_axis() -> None:
    R, turn = _rotation(_draw(20, 3)), _draw(20, 3, seed=1)
    angle = turn.norm(dim=-1, keepdim=True)
    expected = torch.sin(angle) * turn / angle
    torch.testing.assert_close(orientation_error(R, _rotation(turn) @ R), expected, atol=1e-12, rtol=0.0)


def test_the_tool_moves_as_finite_differences_of_its_pose_say() -> None:
    q, qd = _draw(5, 7), _draw(5, 7, seed=1)
    h = 1e-6
    before, now, after = (_tool(q + s * h * qd, qd) for s in (-1.0, 0.0, 1.0))
    velocity = (after.position - before.position) / (2 * h)
    turning = orientation_error(before.rotation, after.rotation) / (2 * h)
    torch.testing.assert_close(now.twist, torch.cat([turning, velocity], -1), atol=1e-7, rtol=1e-7)
    torch.testing.assert_close(now.bias, (after.twist - before.twist) / (2 * h), atol=1e-6, rtol=1e-6)


def test_the_posture_leaves_the_task_untouched_and_is_met_as_far_as_possible() -> None:
    q, qd = _draw(10, 7), _draw(10, 7, seed=1)
    tool, task, posture = _tool(q, qd), _draw(10, 6, seed=2), 10.0 * _draw(10, 7, seed=3)
    y = joint_acceleration(tool, task, posture)
    reached = (tool.jacobian @ y[..., None])[..., 0] + tool.bias
    torch.testing.assert_close(reached, task, atol=SOLVED, rtol=SOLVED)
    null = torch.linalg.svd(tool.jacobian)[2][:, 6:]  # what is left free follows the posture
    torch.testing.assert_close(null @ y[..., None], null @ posture[..., None], atol=SOLVED, rtol=SOLVED)
    assert float((y - joint_acceleration(tool, task, 0.0 * posture)).abs().max()) > 1.0


def test_free_motion_under_the_torque_has_the_wanted_task_acceleration() -> None:
    q, qd = _draw(10, 7), _draw(10, 7, seed=1)
    eom, tool = FREE.equations(q, qd), _tool(q, qd)
    target = Target(
        tool.position + 0.1 * _draw(10, 3, seed=2),
        _draw(10, 3, seed=3),
        _draw(10, 3, seed=4),
        _rotation(0.3 * _draw(10, 3, seed=5)) @ tool.rotation,
        _draw(10, 7, seed=6),
        torch.zeros(10, dtype=torch.float64),
    )
    gains = Gains()
    Q_u = control_torque(tool, eom, q, qd, target, torch.zeros_like(q), gains)
    qdd = dynamics.forward_dynamics(ROBOT, q, qd, Q_u + dynamics.damping_force(ROBOT, qd))
    reached = (tool.jacobian @ qdd[..., None])[..., 0] + tool.bias
    torch.testing.assert_close(reached, task_acceleration(tool, target, gains), atol=1e-7, rtol=1e-9)


def test_the_push_becomes_the_multiplier_when_the_task_follows_the_surface() -> None:
    q = _draw(7) * 0.5 + torch.tensor([0.0, 0.9, 0.0, -1.4, 0.0, 0.8, 0.0], dtype=torch.float64)
    qd = torch.zeros_like(q)
    height = float(_tool(q, qd).position[2])
    contact = SurfaceContact("table", FRAME, POINT, Plane((0, 0, 1), height))
    eom = ConstrainedSystem(ROBOT, [contact], Baumgarte()).equations(q, qd)
    tool = _tool(q, qd)
    along = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    target = Target(tool.position, tool.twist[3:], along, tool.rotation, q, torch.tensor(40.0).double())
    Q_u = control_torque(tool, eom, q, qd, target, eom.A[0], Gains())
    assert float(eom.multiplier(eom.Q_K + Q_u)) == pytest.approx(40.0, abs=SOLVED)
    qdd = eom.acceleration(eom.Q_K + Q_u)
    reached = (tool.jacobian @ qdd[:, None])[:, 0] + tool.bias
    torch.testing.assert_close(reached[3:], along, atol=SOLVED, rtol=0.0)


def test_an_arm_with_few_joints_follows_the_position_in_its_plane() -> None:
    pendulum = forcegp.load_robot("double_pendulum")
    q, qd = _draw(10, 2), _draw(10, 2, seed=1)
    q[:, 1] = q[:, 1].abs() + 0.3
    poses = kinematics.link_poses(pendulum, q)
    motion = kinematics.link_motion(pendulum, poses, qd)
    tool = point_motion(pendulum, poses, motion, qd, "tip", (0.0, 0.0, 0.0))
    task = _draw(10, 6, seed=2)
    y = joint_acceleration(tool, task, _draw(10, 2, seed=3))
    reached = (tool.jacobian @ y[..., None])[..., 0] + tool.bias
    in_plane = [3, 5]  # x and z; the pendulum cannot leave the plane, nor choose its orientation
    torch.testing.assert_close(reached[:, in_plane], task[:, in_plane], atol=SOLVED, rtol=SOLVED)


def test_a_stretched_arm_is_refused() -> None:
    q = torch.zeros(7, dtype=torch.float64)
    with pytest.raises(NumericalError, match="singular"):
        joint_acceleration(_tool(q, q), _draw(6), q)
