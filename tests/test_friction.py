"""Joint friction: limits, dissipation, and that robots carry it."""

from __future__ import annotations

import torch

import forcegp
from forcegp import dynamics


def _force(speed: torch.Tensor, **parameters: float) -> torch.Tensor:
    """Friction of a joint at speeds `(n,)`."""
    robot = forcegp.load_robot("double_pendulum")
    values = {"stribeck_velocity": 0.5, "friction_velocity": 0.01} | parameters
    robot = robot.replace(**{name: torch.full_like(robot.mass, value) for name, value in values.items()})
    return dynamics.damping_force(robot, speed[:, None].expand(-1, robot.nq))[:, 0]


def test_limits_of_the_law() -> None:
    speed = torch.tensor([5.0, 0.1, -5.0, 0.0], dtype=torch.float64)
    force = _force(speed, damping=0.3, friction=2.0, stribeck=1.5)
    peak = 2.0 + 1.5 * torch.exp(torch.tensor(-0.04, dtype=torch.float64)).item()
    expected = torch.tensor([-3.5, -0.03 - peak, 3.5, 0.0], dtype=torch.float64)
    torch.testing.assert_close(force, expected, rtol=1e-8, atol=1e-12)


def test_it_only_ever_dissipates_and_has_finite_slope_at_rest() -> None:
    speed = torch.linspace(-3, 3, 1001, dtype=torch.float64).requires_grad_()
    force = _force(speed, damping=0.3, friction=2.0, stribeck=1.5)
    assert bool((force * speed <= 0).all())
    (slope,) = torch.autograd.grad(force.sum(), speed)
    assert bool(torch.isfinite(slope).all())


def test_polynomial_damping_is_odd_and_that_of_the_drives() -> None:
    """Of two drives, the second of which also moves with the first joint."""
    robot, qd = forcegp.load_robot("double_pendulum"), torch.tensor([0.5, -2.0], dtype=torch.float64)
    robot = robot.replace(drag=torch.tensor([[0.1, 0.2], [0.3, 0.4]], dtype=torch.float64))
    coupled = robot.replace(coupling=torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=torch.float64))
    at_rest = robot.damping * 0.0
    for each, speeds in ((robot, (0.5, -2.0)), (coupled, (0.5, -1.5))):
        force = dynamics.damping_force(each.replace(damping=at_rest, friction=at_rest), qd)
        first, second = (
            -(b * abs(v) * v + c * v**3) for (b, c), v in zip(robot.drag.tolist(), speeds, strict=True)
        )
        expected = [first, second] if each is robot else [first + second, second]
        torch.testing.assert_close(force, torch.tensor(expected, dtype=torch.float64))


def test_robot_carries_its_friction() -> None:
    kuka, panda = forcegp.load_robot("kuka_iiwa"), forcegp.load_robot("franka_panda")
    qd = torch.randn(5, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(dynamics.damping_force(kuka, qd), -0.5 * qd)
    fast = torch.full((7,), 2.0, dtype=torch.float64)
    torch.testing.assert_close(dynamics.damping_force(panda, fast), -panda.friction, rtol=1e-8, atol=0)
