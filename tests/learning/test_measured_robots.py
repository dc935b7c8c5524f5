"""Friction of joints, inertial parameters and torque noise, learned from logs of a robot that is not its
file."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp import dynamics
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.identification import regressor
from forcegp.learning.correlation import autocorrelation_time, correlation_times

NOISE = torch.tensor([0.2, 0.05], dtype=torch.float64)
"""Standard deviation of the measured torque [N m]."""
COULOMB, VISCOUS = 0.4, 0.3
IDENTITY = 1e-10
"""Of two formulas for the same torque, in double precision."""


def motion(n: int, seed: int, segments: int = 4) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Smooth motion of two joints: sums of sines, a new one for each segment."""
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(n, dtype=torch.float64) * 0.01
    segment = torch.arange(n) * segments // n
    w = 1.0 + 5.0 * torch.rand(segments, 3, 2, generator=generator, dtype=torch.float64)
    phase = 6.3 * torch.rand(segments, 3, 2, generator=generator, dtype=torch.float64)
    angle = w[segment] * t[:, None, None] + phase[segment]
    q, qd, qdd = torch.sin(angle), w[segment] * torch.cos(angle), -(w[segment] ** 2) * torch.sin(angle)
    return 0.4 * q.sum(1), 0.4 * qd.sum(1), 0.4 * qdd.sum(1), segment


def log(robot: forcegp.RobotModel, n: int, seed: int) -> forcegp.Dataset:
    """Torques that move a robot with joint friction along a motion, measured with noise."""
    q, qd, qdd, segment = motion(n, seed)
    friction = VISCOUS * qd + COULOMB * torch.tanh(qd / 0.02)
    noise = NOISE * torch.randn(n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd) + friction + noise
    t = torch.arange(n, dtype=torch.float64) * 0.01
    return forcegp.Dataset(t=t, q=q, qd=qd, qdd=qdd, tau=tau, joint_names=robot.joint_names, segment=segment)


@pytest.fixture(scope="module")
def file() -> forcegp.RobotModel:
    robot = forcegp.load_robot("double_pendulum")
    return robot.replace(damping=torch.zeros_like(robot.damping), friction=torch.zeros_like(robot.friction))


@pytest.fixture(scope="module")
def truth(file: forcegp.RobotModel) -> forcegp.RobotModel:
    """The robot that the file describes wrongly: heavier links with another centre of mass."""
    return file.replace(mass=1.3 * file.mass, com=0.9 * file.com)


def torque_error(fit, test: forcegp.Dataset) -> Tensor:
    predicted = fit.predict(test.q, test.qd, test.tau, covariance=False).mean
    M = dynamics.mass_matrix(fit.system.robot, test.q)
    return (M @ (predicted - test.qdd)[..., None])[..., 0]


def test_a_joint_that_moved_one_way_has_friction_the_other_way_too(file: forcegp.RobotModel) -> None:
    """Its friction is not taken for an offset of the torque sensor."""
    data = log(file, 800, 0)
    train, test = data[data.qd[:, 0] > 0.05], data[data.qd[:, 0] < -0.05]
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical").fit(train)
    error = torque_error(fit, test)[:, 0]
    assert float(error.mean().abs()) < 0.25 * COULOMB, "an offset would leave twice the Coulomb friction"
    force = fit.predict(test.q, test.qd, test.tau, "total_force")
    file_alone = forcegp.AnalyticalModel(forcegp.ConstrainedSystem(file)).nominal()
    found = force.mean[:, 0] - file_alone.predict(test.q, test.qd, test.tau, "total_force").mean[:, 0]
    true = -(VISCOUS * test.qd[:, 0] + COULOMB * torch.tanh(test.qd[:, 0] / 0.02))
    assert float(((found - true).abs() <= 2.0 * force.std[:, 0]).double().mean()) > 0.9


def test_defaults_of_a_measured_log_learn_friction_and_noise(file: forcegp.RobotModel) -> None:
    train, test = log(file, 800, 0), log(file, 400, 7)
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical").fit(train)
    assert [prior.name for prior in fit.force_priors] == ["joint_friction", "bristles", "inertial"]
    assert fit.torque_std is not None
    torch.testing.assert_close(fit.torque_std, NOISE, rtol=0.2, atol=0.0)
    error = torque_error(fit, test).square().mean(0).sqrt()
    assert bool((error < 1.15 * NOISE).all()), "nothing is left but the noise of the sensor"
    read = fit.predict(test.q, test.qd, test.tau, noise=True)
    inside = ((read.mean - test.qdd).abs() <= 2.0 * read.std).double().mean(0)
    assert bool((inside > 0.9).all()) and bool((inside < 0.99).all())


@pytest.mark.slow
def test_inertial_parameters_of_the_file_are_put_right(
    file: forcegp.RobotModel, truth: forcegp.RobotModel, tmp_path: Path
) -> None:
    train, test = log(truth, 800, 0), log(truth, 400, 7)
    system = forcegp.ConstrainedSystem(file)
    friction = forcegp.StructuredGP(system, "analytical", [JointFrictionPrior()]).fit(train)
    both = forcegp.StructuredGP(system, "analytical", [JointFrictionPrior(), InertialPrior()]).fit(train)
    before, after = (torque_error(f, test).square().mean(0).sqrt() for f in (friction, both))
    assert bool((after < 1.2 * NOISE).all()) and float(before.max()) > 3.0 * float(after.max())
    assert bool((torch.linalg.eigvalsh(dynamics.mass_matrix(both.system.robot, test.q))[:, 0] > 0.0).all())
    both.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model")
    a, b = (m.predict(test.q[:5], test.qd[:5], test.tau[:5]) for m in (both, again))
    # Means given the inertia that the robot contains are computed after loading, to rounding.
    torch.testing.assert_close(a.mean, b.mean, rtol=1e-11, atol=0.0)


def test_inertial_errors_act_through_the_regressor(
    file: forcegp.RobotModel, truth: forcegp.RobotModel
) -> None:
    """M₀ q̈ + h₀ + Y δ is the torque of the robot with π₀ + δ."""
    from forcegp.identification import parameter_vector

    q, qd, qdd, _ = motion(20, 3)
    delta = parameter_vector(truth) - parameter_vector(file)
    torque = dynamics.inverse_dynamics(file, q, qd, qdd) + regressor(file, q, qd, qdd) @ delta
    expected = dynamics.inverse_dynamics(truth, q, qd, qdd)
    torch.testing.assert_close(torque, expected, rtol=IDENTITY, atol=IDENTITY)


def test_the_model_cannot_cancel_the_torque(file: forcegp.RobotModel) -> None:
    """A torque that the controller did not choose moves the prediction by what mechanics says."""
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical").fit(log(file, 400, 0))
    q, qd, _, _ = motion(30, 5)
    tau = torch.zeros_like(q)
    push = torch.randn(30, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    moved = fit.predict(q, qd, tau + push).mean - fit.predict(q, qd, tau).mean
    expected = torch.linalg.solve(dynamics.mass_matrix(fit.system.robot, q), push[..., None])[..., 0]
    torch.testing.assert_close(moved, expected, rtol=1e-8, atol=1e-8)


def test_autocorrelation_time_of_a_known_process() -> None:
    """An AR(1) process with coefficient a has (1 + a)/(1 − a)."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(40000, 2, generator=generator, dtype=torch.float64)
    x = torch.zeros_like(noise)
    for i, a in enumerate((0.0, 0.8)):
        for k in range(1, len(x)):
            x[k, i] = a * x[k - 1, i] + noise[k, i]
    found = autocorrelation_time(x, torch.zeros(len(x), dtype=torch.int64))
    torch.testing.assert_close(found, torch.tensor([1.0, 9.0], dtype=torch.float64), rtol=0.15, atol=0.1)


def first_order(n: int, a: float, generator: torch.Generator) -> Tensor:
    """AR(1) processes of unit variance with coefficient a `(n, 2)`."""
    x = torch.randn(n, 2, generator=generator, dtype=torch.float64)
    for k in range(1, n):
        x[k] = a * x[k - 1] + (1.0 - a * a) ** 0.5 * x[k]
    return x


def test_white_noise_does_not_hide_a_correlation() -> None:
    generator = torch.Generator().manual_seed(1)
    x = first_order(40000, 0.9, generator)
    noise = torch.randn(x.shape, generator=generator, dtype=torch.float64)
    segment = torch.zeros(len(x), dtype=torch.int64)
    white = torch.tensor([0.0, 4.0], dtype=torch.float64)
    both = torch.tensor([19.0, 19.0], dtype=torch.float64)
    found = autocorrelation_time(x + white.sqrt() * noise, segment, white)
    torch.testing.assert_close(found, both, rtol=0.2, atol=0.0)
    found = correlation_times(x + white.sqrt() * noise, segment, 400, white)
    torch.testing.assert_close(found, both + white, rtol=0.2, atol=0.0)
    # All of it is white: what is left of the variance says nothing.
    assert torch.equal(autocorrelation_time(noise, segment, 1.0), torch.ones(2, dtype=torch.float64))


def test_white_noise_of_accelerations_does_not_hide_correlated_torques(file: forcegp.RobotModel) -> None:
    """Torque noise with 19 samples of autocorrelation time, and as much torque in white accelerations."""
    data, generator = log(file, 1000, 3), torch.Generator().manual_seed(3)
    clean = dynamics.inverse_dynamics(file, data.q, data.qd, data.qdd)
    friction = VISCOUS * data.qd + COULOMB * torch.tanh(data.qd / 0.02)
    tau = clean + friction + 0.1 * first_order(1000, 0.9, generator)
    qdd = data.qdd + 0.1 * torch.randn(1000, 2, generator=generator, dtype=torch.float64)
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical", noise=0.1)
    fit = model.fit(data.replace(tau=tau, qdd=qdd))
    assert fit.problem.power == pytest.approx(1.0 / 19.0, rel=0.5)


def test_samples_at_rest_are_left_out(file: forcegp.RobotModel) -> None:
    data = log(file, 200, 0)
    still = data.replace(qd=torch.where(torch.arange(200)[:, None] < 100, 0.0, data.qd))
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical").fit(still)
    assert fit.training.samples == 100
