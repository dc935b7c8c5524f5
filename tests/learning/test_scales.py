"""Variances of rows, against their values in simulated rows."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.forces.posterior import STICK_NOISE
from forcegp.forces.unknowns import AXES
from forcegp.learning.scales import (
    AT_REST,
    FEWEST_FOR_VARIANCE,
    Residuals,
    Stated,
    _at_likeliest_speed,
    _independent,
    _scored,
)

JOINTS, ROWS = 3, 6000
STD, STICK = torch.tensor([0.5, 0.1, 0.0]).double(), torch.tensor([0.0, 0.4, 0.0]).double()
SAMPLED = 0.06
"""Of a standard deviation that is estimated from some thousand samples."""


def rows(seed: int = 0) -> Residuals:
    """Residuals r = B ε + e of random operators, with torque noise and static friction of known size."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    B = 20.0 * (torch.eye(JOINTS, dtype=torch.float64) + 0.3 * normal(ROWS, JOINTS, JOINTS))
    slow = torch.rand(ROWS, JOINTS, generator=generator, dtype=torch.float64).square()
    force = STD * normal(ROWS, JOINTS) + STICK * slow.sqrt() * normal(ROWS, JOINTS)
    r = (B @ force[..., None])[..., 0] + normal(ROWS, JOINTS)
    return Residuals(r, B, slow, torch.zeros_like(r))


def test_scoring_finds_variances_and_zeros() -> None:
    theta, share = torch.ones(2 * JOINTS, dtype=torch.float64), torch.ones(2 * JOINTS, dtype=torch.float64)
    for _ in range(15):
        theta = _scored(rows(), theta, share, theta >= 0.0)
    torque, stick = theta.sqrt().chunk(2)
    torch.testing.assert_close(torque, STD, rtol=SAMPLED, atol=0.01)
    torch.testing.assert_close(stick, STICK, rtol=SAMPLED, atol=0.03)


def with_contact(data: Residuals, closed: int) -> Residuals:
    """The rows with a contact that is closed in the first ones, always at rest."""
    B = torch.zeros(ROWS, JOINTS, AXES, dtype=torch.float64)
    B[:closed] = 1.0
    rests = (B != 0.0).any(-2).any(-1).double()
    return data._replace(B=torch.cat([data.B, B], -1), slow=torch.cat([data.slow, rests[:, None]], -1))


def test_independent_samples() -> None:
    """All samples of a joint count, and those of a contact κ times."""
    data, power = with_contact(rows(), 300), 0.01
    moves, rests = _independent(data, power)
    torch.testing.assert_close(moves, torch.tensor([*JOINTS * [float(ROWS)], 300 * power]).double())
    torch.testing.assert_close(rests[:JOINTS], data.slow[:, :JOINTS].sum(0))
    assert math.isclose(float(rests[JOINTS]), 300 * power)


def test_variances_of_few_independent_samples_are_the_stated_ones() -> None:
    """Whatever was learned before the correlation of the samples was known."""
    data, contact = with_contact(rows(), 300), slice(JOINTS, None)
    stated, learned = torch.full((8,), 4.0).double(), torch.full((8,), 0.01).double()
    now = torch.full((1,), math.log(0.1), dtype=torch.float64)

    def found(power: float) -> tuple[float, Tensor]:
        known = Stated(stated, power, torch.ones_like(stated), torch.zeros(8, dtype=torch.bool))
        return _at_likeliest_speed(data, contact, now, AT_REST, learned, known)[1:]

    few = found(0.5 * FEWEST_FOR_VARIANCE / ROWS)
    is_stated = few[1] == stated
    assert is_stated.tolist() == 2 * [*JOINTS * [False], True]
    torch.testing.assert_close(found(1.0)[1][:JOINTS].sqrt(), STD, rtol=SAMPLED, atol=0.03)


def test_scoring_is_stationary_where_the_likelihood_is() -> None:
    """The gradient of Σ log N(r; 0, C) with respect to the variances vanishes, or a variance is zero."""
    data, theta, share = rows(1), torch.ones(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
    for _ in range(15):
        theta = _scored(data, theta, share, theta >= 0.0)

    def log_density(x: Tensor) -> Tensor:
        torque, stick = x.chunk(2)
        S = torque + stick * data.slow
        C = (data.B * S[:, None]) @ data.B.mT + torch.eye(JOINTS, dtype=torch.float64)
        normal = torch.distributions.MultivariateNormal(torch.zeros_like(data.r), C)
        return normal.log_prob(data.r).sum()

    x = theta.clone().requires_grad_()
    slope = torch.autograd.grad(log_density(x), x)[0] * theta.maximum(torch.full_like(theta, 1e-4))
    assert bool(((slope.abs() < 0.5) | ((theta == 0.0) & (slope <= 0.0))).all()), (theta, slope)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_torque_noise_is_found_beside_known_noise_of_accelerations(noise: float) -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    generator = torch.Generator().manual_seed(3)
    t = 0.01 * torch.arange(3000, dtype=torch.float64)
    rate = torch.tensor([1.3, 2.1], dtype=torch.float64)
    q, qd, qdd = (
        torch.stack([f * torch.sin(rate[j] * t + p) for j in range(2)], -1)
        for f, p in ((1.0, 0.0), (1.0, math.pi / 2), (-1.0, 0.0))
    )
    qd, qdd = rate * qd, rate**2 * qdd
    friction = -0.5 * torch.tanh(qd / 0.02)
    tau = forcegp.dynamics.inverse_dynamics(system.robot, q, qd, qdd) - friction
    tau = tau - forcegp.dynamics.damping_force(system.robot, qd)
    tau = tau + noise * torch.randn(tau.shape, generator=generator, dtype=torch.float64)
    qdd = qdd + 0.1 * torch.randn(qdd.shape, generator=generator, dtype=torch.float64)
    data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
    fit = forcegp.StructuredGP(system, "analytical", noise=0.1, inertia="file").fit(data)
    found = fit.hyperparameters[TORQUE_NOISE].exp()
    assert fit.result.converged and fit.result.evaluations < 20
    # The force of the noise of accelerations is 0.1 kg m² · rad/s², on held-out blocks a little more.
    assert bool(((found - noise).abs() < 0.1 * noise + 0.05).all()), found
    assert STICK_NOISE in fit.hyperparameters
    still = dataclasses.replace(data, tau=data.tau)
    again = forcegp.StructuredGP(system, "analytical", noise=0.1, inertia="file").fit(still)
    assert torch.equal(again.hyperparameters[TORQUE_NOISE], fit.hyperparameters[TORQUE_NOISE])
