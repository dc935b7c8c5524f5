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


def test_robot_carries_its_friction() -> None:
    kuka, panda = forcegp.load_robot("kuka_iiwa"), forcegp.load_robot("franka_panda")
    qd = torch.randn(5, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(dynamics.damping_force(kuka, qd), -0.5 * qd)
    fast = torch.full((7,), 2.0, dtype=torch.float64)
    torch.testing.assert_close(dynamics.damping_force(panda, fast), -panda.friction, rtol=1e-8, atol=0)
