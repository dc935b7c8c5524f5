"""The calibration of the torque's noise: known noise is found, also where a contact hides a part of it."""

from __future__ import annotations

import math

import torch

import forcegp
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.learning.held_out import unit_scales

SAMPLES = 4000
TRUE = torch.tensor([0.5, 0.2, 0.05], dtype=torch.float64)


def test_noise_is_found_through_projected_errors() -> None:
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(SAMPLES, 3, generator=generator, dtype=torch.float64)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    P = torch.eye(3, dtype=torch.float64) - normal[:, :, None] * normal[:, None, :]
    P[: SAMPLES // 2] = torch.eye(3, dtype=torch.float64)
    V = 0.01 * torch.rand(SAMPLES, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(SAMPLES, 3, generator=generator, dtype=torch.float64) * TRUE
    r = (P @ noise[..., None])[..., 0]
    r = r + V.sqrt() * torch.randn(SAMPLES, 3, generator=generator, dtype=torch.float64)
    found = unit_scales(r**2, V, P**2, torch.full_like(TRUE, 1e-3))
    # Standard errors are 1 to 5 %: the last joint's noise hides behind V.
    torch.testing.assert_close(found, TRUE, rtol=0.1, atol=0.0)


def test_noise_is_not_lowered_below_what_was_learned() -> None:
    least = 2.0 * TRUE
    P = torch.eye(3, dtype=torch.float64).expand(SAMPLES, 3, 3)
    r = TRUE * torch.randn(SAMPLES, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.equal(unit_scales(r**2, torch.zeros_like(r), P, least), least)


def test_noise_is_at_least_that_of_the_rounding_of_the_torque() -> None:
    """Where a log happens to agree with the rounded torques, others will not."""
    system, step = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum")), 0.5
    random, n = torch.Generator().manual_seed(0), 100
    q, qd, tau = torch.randn(3, n, 2, generator=random, dtype=torch.float64)
    tau = step * (4.0 * tau / step).round()
    qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau - 0.1 * torch.tanh(qd))
    t = torch.arange(n, dtype=torch.float64)
    data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
    fit = forcegp.StructuredGP(system, force_priors=[forcegp.priors.JointFrictionPrior()]).fit(data)
    assert bool((fit.hyperparameters[TORQUE_NOISE].exp() >= 0.999 * step / math.sqrt(12.0)).all())
