"""Which inertia a measured log asks for, on logs whose robot is known."""

from __future__ import annotations

import dataclasses
import time
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import savgol_coeffs
from torch import Tensor

import forcegp
from forcegp import dynamics
from forcegp.data import DataHeader
from forcegp.errors import ConvergenceWarning, UnknownNameError
from forcegp.forces.measurements import Observation, training_of
from forcegp.forces.priors import inertial
from forcegp.forces.priors.inertial import DIVERGENCE, InertialPrior
from forcegp.forces.priors.joint import AnalyticalMean, JointFrictionPrior
from forcegp.forces.quantities import states
from forcegp.identification import regressor
from forcegp.learning import inverse_dynamics
from forcegp.learning.correlation import correlation_times
from forcegp.learning.inertia import Inertia, _Regression, inertia_of, latent_precision, one_row
from forcegp.learning.inverse_dynamics import (
    APART,
    Rows,
    averaged,
    instrumental,
    is_harmless,
    is_less,
    log_ratio,
    partners,
    products,
    rest_weight,
    sums,
)
from forcegp.models.calibrated import calibrated
from forcegp.robot.inertia import inertial_parameters, pseudo_inertia, pseudo_inertia_of
from forcegp.robot.model import RobotModel

NOISE = torch.tensor([0.2, 0.05], dtype=torch.float64)
"""Standard deviation of the measured torque [N m]."""
ROUNDING = 1e-8
"""Of two formulas for the same solution, in double precision with a ridge of 1e-8."""


def log(
    robot: RobotModel,
    n: int = 1600,
    speed: float = 1.0,
    seed: int = 0,
    segments: int = 8,
    acceleration_noise: float = 0.0,
    memory: float = 0.0,
    window: int = 1,
    late: float = 0.0,
    step: float = 0.01,
    creeps: float = 0.0,
) -> forcegp.Dataset:
    """Torques that move a robot with joint friction along sums of sines, measured with noise.

    With memory, dry friction is four times as large and develops over that distance [rad] (Dahl's model).
    Torques are logged late [s]. Noise of accelerations is that of a Savitzky-Golay filter of a window. In the
    slower half of its samples, the last joint creeps: it resists acceleration [kg m²].
    """
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(n, dtype=torch.float64) * step
    segment = torch.arange(n) * segments // n
    w = speed * (1.0 + 5.0 * torch.rand(segments, 3, 2, generator=generator, dtype=torch.float64))
    phase = 6.3 * torch.rand(segments, 3, 2, generator=generator, dtype=torch.float64)

    def motion(t: Tensor) -> Tensor:
        angle = w[segment] * t[:, None, None] + phase[segment]
        parts = torch.sin(angle), w[segment] * torch.cos(angle), -(w[segment] ** 2) * torch.sin(angle)
        return torch.stack([0.4 * part.sum(1) for part in parts])

    q, qd, qdd = motion(t - late)
    noise = NOISE * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    dry = 1.6 * dahl(q, segment, memory) if memory else 0.4 * torch.tanh(qd / 0.02)
    friction = 0.3 * qd + dry
    slow = qd[:, 1].abs() < qd[:, 1].abs().median()
    friction[:, 1] += creeps * slow * qdd[:, 1]
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd) + friction + noise
    q, qd, qdd = motion(t)
    white = torch.randn(n + window - 1, 2, generator=generator, dtype=torch.float64)
    weights = torch.ones(1) if window == 1 else torch.from_numpy(savgol_coeffs(window, 3, deriv=2))
    weights = weights.double() / weights.norm()
    qdd = qdd + acceleration_noise * (white.unfold(0, window, 1) @ weights)
    header = DataHeader(filter_span=None if window == 1 else window * step)
    return forcegp.Dataset(
        t=t, q=q, qd=qd, qdd=qdd, tau=tau, joint_names=robot.joint_names, segment=segment, header=header
    )


def dahl(q: Tensor, segment: Tensor, distance: float) -> Tensor:
    """z of dz/dq = (sgn q̇ − z)/δ from z = 0 at the start of each segment."""
    z = torch.zeros_like(q)
    for k in range(1, len(q)):
        if segment[k] == segment[k - 1]:
            step = q[k] - q[k - 1]
            z[k] = step.sign() + (z[k - 1] - step.sign()) * torch.exp(-step.abs() / distance)
    return z


@pytest.fixture(scope="module")
def file() -> RobotModel:
    robot = forcegp.load_robot("double_pendulum")
    zero = torch.zeros_like(robot.damping)
    return robot.replace(damping=zero, friction=zero)


def found(file: RobotModel, data: forcegp.Dataset) -> Inertia:
    system, prior = forcegp.ConstrainedSystem(file), JointFrictionPrior()
    return inertia_of(system, (prior,), AnalyticalMean(), training_of(data, system, (prior,), None, {}))


@pytest.mark.parametrize("seed", range(2))
def test_friction_with_memory_is_not_taken_for_inertia(file: RobotModel, seed: int) -> None:
    """Within some hundredths of a radian of a reversal it is a spring, whose torque is that of negative
    inertia."""
    assert found(file, log(file, seed=seed, memory=0.05)).robot is file
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com)
    data = log(truth, seed=seed, memory=0.05)
    result = found(file, data)
    assert result.errors and result.errors.per_gain and inertia_error(result.robot, truth, data) < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_a_right_file_is_kept(file: RobotModel, seed: int) -> None:
    result = found(file, log(file, seed=seed))
    assert result.robot is file and result.errors and not result.errors.per_gain and not result.doubts


@pytest.mark.parametrize("seed", range(3))
def test_inertia_of_drives_that_the_file_lacks_is_found(file: RobotModel, seed: int) -> None:
    """Not taken for inertia of the links, which would load the other joint too. The drive of the first joint
    could also be the inertia of its link."""
    armature = torch.tensor([0.3, 0.1], dtype=torch.float64)
    result = found(file, log(file.replace(armature=armature), seed=seed))
    assert result.errors and not result.errors.per_gain
    torch.testing.assert_close(result.robot.armature, armature, rtol=0.1, atol=0.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_joint_that_creeps_has_no_drive(file: RobotModel, seed: int) -> None:
    """Identified links and drives may still predict held-out torques better than the file."""
    result = found(file, log(file, seed=seed, creeps=0.1))
    assert result.robot is file or (result.errors and result.errors.per_gain)


@pytest.mark.parametrize("joint", range(2))
def test_the_effect_of_a_gain_is_that_of_identifying_again_with_scaled_torques(
    file: RobotModel, joint: int
) -> None:
    """On M_jj, by central differences of 1 %."""
    armature = torch.tensor([0.3, 0.1], dtype=torch.float64)
    data = log(file.replace(mass=1.3 * file.mass, com=0.9 * file.com, armature=armature), 3200)
    only = torch.eye(2, dtype=torch.float64)[joint]

    def diagonal(gain: float) -> Tensor:
        robot = found(file, data.replace(tau=data.tau * (1.0 + gain * only))).robot
        return dynamics.mass_matrix(robot, data.q).diagonal(dim1=-2, dim2=-1).mean(0)

    errors = found(file, data).errors
    assert errors is not None
    per_gain = torch.tensor(errors.per_gain, dtype=torch.float64)
    effect = torch.cat([unit_inertia(file, data.q), torch.eye(2).double()], dim=-1) @ per_gain[:, joint]
    expected, size = (diagonal(0.01) - diagonal(-0.01)) / 0.02, diagonal(0.0)
    torch.testing.assert_close(effect / size, expected / size, rtol=0.01, atol=0.003)


def unit_inertia(robot: RobotModel, q: Tensor) -> Tensor:
    """M_jj per inertial parameter of the links `(nq, 10 nq)`, averaged over states: torque at unit
    acceleration without weight."""
    zero, eye = torch.zeros_like(q), torch.eye(robot.nq, dtype=q.dtype)
    still = regressor(robot, q, zero, zero)
    return torch.stack(
        [(regressor(robot, q, zero, e.expand_as(q)) - still)[:, j].mean(0) for j, e in enumerate(eye)]
    )


def inertia_error(robot: RobotModel, truth: RobotModel, data: forcegp.Dataset) -> float:
    """Relative error of the mass matrix over a log."""
    M, exact = (dynamics.mass_matrix(each, data.q) for each in (robot, truth))
    return float(((M - exact).square().sum() / exact.square().sum()).sqrt())


def test_links_that_the_file_describes_wrongly_are_identified(file: RobotModel) -> None:
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com)
    data = log(truth)
    result = found(file, data)
    assert result.errors and result.errors.per_gain and "identified inertia replaces" in result.doubts[0]
    assert inertia_error(result.robot, truth, data) < 0.25 * inertia_error(file, truth, data)
    system = forcegp.ConstrainedSystem(file)
    model = forcegp.StructuredGP(system, "analytical")
    fitted = model.fit(log(truth, 800))
    assert inertia_error(fitted.system.robot, truth, data) < 0.25 * inertia_error(file, truth, data)
    prior = next(prior for prior in fitted.force_priors if isinstance(prior, InertialPrior))
    assert fitted.problem.errors == (prior,), "its mean is in the robot, its uncertainty remains"
    assert not fitted.hyperparameters["inertial.log_scale"].any(), "the robot has what would show it"
    again = model.fit(log(truth, 800), learn=["joint_friction"], after=fitted)
    torch.testing.assert_close(again.system.robot.mass, fitted.system.robot.mass, rtol=0.0, atol=0.0)
    assert [each.name for each in again.problem.errors] == [prior.name]


@pytest.mark.parametrize("late", [0.0, 0.008])
def test_a_late_torque_is_not_taken_for_inertia(file: RobotModel, late: float) -> None:
    assert found(file, log(file, late=late)).robot is file
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com)
    data = log(truth, late=late)
    result = found(file, data)
    M, exact = (dynamics.mass_matrix(each, data.q).diagonal(dim1=-2, dim2=-1).mean(0)
                for each in (result.robot, truth))  # fmt: skip
    torch.testing.assert_close(M, exact, rtol=0.01, atol=0.0)
    assert result.errors and result.errors.delay == pytest.approx(-late, abs=1e-3)


@pytest.mark.slow
def test_a_late_torque_is_not_taken_for_viscous_friction(file: RobotModel) -> None:
    """0.3 N m s/rad; a delay s of M q̈ adds s M ω² to it along a sine of frequency ω."""
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com)
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical").fit(log(truth, 800, late=0.008))
    for each in (p for p in calibrated(fit).parameters if p.name == "damping"):
        assert abs(each.estimate - 0.3) < 3.0 * each.std < 0.15


@pytest.mark.slow
def test_later_samples_are_shifted_by_the_identified_delay(file: RobotModel) -> None:
    truth, system = file.replace(mass=1.3 * file.mass, com=0.9 * file.com), forcegp.ConstrainedSystem(file)
    late, timely = (log(truth, 800, late=x) for x in (0.008, 0.0))
    fit = forcegp.StructuredGP(system, "analytical").fit(late)
    shifted = fit.training.measurements[0].tau
    errors = [(x - timely.tau).square().mean().sqrt() for x in (shifted, late.tau)]
    assert float(errors[0]) < 0.2 * float(errors[1])
    again = forcegp.StructuredGP(system, "analytical").fit(late, learn=["joint_friction"], after=fit)
    for each in (again, fit.condition(late)):
        assert torch.equal(each.training.measurements[0].tau, shifted)
    # An update with late torques is one of a fit without a delay with timely torques.
    priors = tuple(dataclasses.replace(p, delay=0.0) if p.delay else p for p in fit.force_priors)
    spec = dataclasses.replace(fit.specification, priors=priors)
    plain = dataclasses.replace(fit, specification=spec)
    late, timely = (log(truth, 400, late=x, seed=3) for x in (0.008, 0.0))
    states = torch.randn(3, 50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    exact, found, unshifted = (
        each.predict(*states).mean for each in (plain.update(timely), fit.update(late), plain.update(late))
    )
    assert float((found - exact).norm()) < 0.1 * float((unshifted - exact).norm())


def test_a_search_for_links_that_does_not_converge_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, prior = forcegp.load_robot("double_pendulum"), InertialPrior()
    mean, precision = torch.ones(20, dtype=torch.float64), 1e6 * torch.eye(20, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prior.updated(robot, mean, precision)
    monkeypatch.setattr(inertial, "MOST_STEPS", 2)
    with pytest.warns(ConvergenceWarning, match="ended after 2 steps"):
        prior.updated(robot, mean, precision)


def test_consistent_links_are_the_most_probable_ones() -> None:
    """Newton's decrement of the convex objective vanishes, though noise differs by a factor of 1000."""
    robot, prior = forcegp.load_robot("kuka_iiwa14"), InertialPrior()
    random = torch.Generator().manual_seed(0)
    q, qd, qdd = torch.randn(3, 40, 7, generator=random, dtype=torch.float64)
    noise = torch.logspace(-1.0, -4.0, 7, dtype=torch.float64)
    A = (regressor(robot, q, qd, qdd) * prior.scale(robot) / noise[:, None]).flatten(0, 1)
    precision = A.mT @ A + torch.eye(70, dtype=torch.float64)
    mean = 3.0 * torch.randn(70, generator=random, dtype=torch.float64)
    moved, delta = prior.updated(robot, mean, precision)
    pi0 = inertial_parameters(robot.mass, robot.com, robot.inertia)
    J0 = pseudo_inertia(robot.mass, robot.com, robot.inertia)
    scale = prior.scale(robot).view(7, 10)
    found = (inertial_parameters(moved.mass, moved.com, moved.inertia) - pi0) / scale
    torch.testing.assert_close(found.flatten(), delta, rtol=1e-6, atol=1e-6)

    def objective(x: Tensor) -> Tensor:
        pi = pi0 + scale * x.view(7, 10)
        m, c, I = pi[:, 0], pi[:, 1:4], pi[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].view(7, 3, 3)
        Sigma = 0.5 * I.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] * torch.eye(3).to(I) - I
        J = torch.cat([torch.cat([Sigma, c[:, :, None]], 2), torch.cat([c, m[:, None]], 1)[:, None]], 1)
        ratio = torch.linalg.solve(J0, J)
        divergence = ratio.diagonal(dim1=1, dim2=2).sum(-1) - torch.logdet(J)
        return 0.5 * (x - mean) @ precision @ (x - mean) + DIVERGENCE * divergence.sum()

    slope, curvature = torch.func.grad(objective)(delta), torch.func.hessian(objective)(delta)
    unphysical = torch.linalg.eigvalsh(pseudo_inertia_of(pi0 + scale * mean.view(7, 10)))[:, 0] < 0.0
    assert int(unphysical.sum()) > 3 and float(precision.diagonal().max()) > 1e6
    assert float(torch.linalg.eigvalsh(pseudo_inertia(moved.mass, moved.com, moved.inertia)).min()) > 0.0
    assert 0.0 <= float(slope @ torch.linalg.solve(curvature, slope)) < DIVERGENCE


def test_drives_are_named_with_the_bars_of_the_posterior(file: RobotModel) -> None:
    armature = torch.tensor([0.3, 0.1], dtype=torch.float64)
    truth = file.replace(armature=armature)
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical").fit(log(truth))
    drives = {p.of: p for p in fit.robot_parameters() if p.name == "drive inertia"}
    for name, true in zip(file.joint_names, armature.tolist(), strict=True):
        drive = drives[name]
        assert drive.determined and drive.std is not None
        assert 2.0 * drive.std < drive.value and abs(drive.value - true) <= 4.0 * drive.std


def test_links_and_drives_are_identified_together(file: RobotModel) -> None:
    armature = torch.tensor([0.3, 0.1], dtype=torch.float64)
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com, armature=armature)
    data = log(truth)
    result = found(file, data)
    assert result.errors and result.errors.per_gain
    assert inertia_error(result.robot, truth, data) < 0.15 * inertia_error(file, truth, data)


@pytest.mark.slow
def test_a_drive_and_the_link_that_it_turns_share_their_uncertainty(file: RobotModel) -> None:
    """Joint 1 turns link 1 about a fixed axis, so no motion tells the two apart: their sum is known alone."""
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com)
    data = log(truth, 800)
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical").fit(data)
    (p,) = (p for p, prior in enumerate(fit.force_priors) if isinstance(prior, InertialPrior))
    prior, robot = fit.force_priors[p], fit.system.robot
    assert isinstance(prior, InertialPrior)
    inputs = one_row(fit.posterior, fit.problem)
    delta = fit.posterior.latent.latent_mean(p, inputs[p])[0]
    covariance = torch.linalg.inv(latent_precision(fit.posterior, inputs, p, robot))
    q = data.q[::10]
    C = torch.cat([unit_inertia(robot, q), torch.eye(2).double()], dim=-1) * prior.scale(robot)
    std = (C @ covariance @ C.mT).diagonal().sqrt()
    M, exact = (dynamics.mass_matrix(x, q).diagonal(dim1=-2, dim2=-1).mean(0) for x in (robot, truth))
    assert bool(((M + C @ delta - exact).abs() <= 3.0 * std).all()) and bool((std < 0.05 * exact).all())
    drive = covariance.diagonal()[-2:].sqrt() * prior.scale(robot)[-2:]
    assert float(drive[0]) > 3.0 * float(std[0]), "the drive alone is not known as well as M"


def test_the_force_of_a_drive_is_the_derivative_of_inverse_dynamics(file: RobotModel) -> None:
    q, qd, qdd, tau = torch.randn(4, 5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    prior = InertialPrior().around(file).with_drives(torch.tensor([0.5, 2.0], dtype=torch.float64))
    active = torch.zeros(5, 0, dtype=torch.bool)
    Q = prior.operator(
        forcegp.ConstrainedSystem(file), states(forcegp.ConstrainedSystem(file), q, qd, tau, active, qdd)
    )
    for j, scale in enumerate(prior.drives):
        step = scale * torch.eye(2, dtype=torch.float64)[j]
        with_drive = file.replace(armature=file.armature + step)
        change = dynamics.inverse_dynamics(with_drive, q, qd, qdd) - dynamics.inverse_dynamics(
            file, q, qd, qdd
        )
        torch.testing.assert_close(Q[..., 20 + j], -change)


@pytest.mark.parametrize("noise", [0.0, 10.0])
def test_noise_of_accelerations_does_not_make_inertia_smaller(file: RobotModel, noise: float) -> None:
    """As large as a third of the accelerations; least squares lose a tenth of the inertia by it."""
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com)
    data = log(truth, 6400, 2.0, acceleration_noise=noise)
    result = found(file, data)
    assert result.errors and result.errors.per_gain
    own, exact = (dynamics.mass_matrix(each, data.q).diagonal(dim1=-2, dim2=-1).mean(0)
                  for each in (result.robot, truth))  # fmt: skip
    torch.testing.assert_close(own, exact, rtol=0.04, atol=0.0)


@pytest.mark.parametrize(("window", "step"), [(11, 0.01), (61, 0.001), (151, 0.001)])
def test_correlated_noise_of_a_filter_leaves_the_inertia_right(
    file: RobotModel, window: int, step: float
) -> None:
    """Whether or not the log states the span of the filter, within which instruments have the noise too."""
    truth = file.replace(mass=1.3 * file.mass, com=0.9 * file.com)
    data = log(truth, round(64.0 / step), 0.6, acceleration_noise=0.7, window=window, step=step)
    exact = dynamics.mass_matrix(truth, data.q).diagonal(dim1=-2, dim2=-1).mean(0)
    for each in (data, data.replace(header=DataHeader())):
        M = dynamics.mass_matrix(found(file, each).robot, data.q).diagonal(dim1=-2, dim2=-1).mean(0)
        assert float((M / exact - 1.0).abs().max()) < 0.01


def test_a_filter_averages_accelerations_with_the_variance_that_is_stated() -> None:
    """Acceleration of a slow sine, from cubics fitted to positions, is too small by ω²/2 times that."""
    w, dt = 2.0, 0.001
    header = DataHeader(filter_span=151 * dt, derived=("qd", "qdd"))
    offset = (np.arange(151) - 75) * dt
    lost = 1.0 + savgol_coeffs(151, 3, deriv=2, delta=dt, use="dot") @ np.cos(w * offset) / w**2
    np.testing.assert_allclose(lost, 0.5 * w**2 * header.filter_variance, rtol=0.02)
    assert DataHeader(filter_span=0.1, derived=("qdd",)).filter_variance == 0.0


def test_averaged_equations_are_sums_of_neighbours_within_a_stretch() -> None:
    random = torch.Generator().manual_seed(0)
    n, nq, p = 120, 2, 3
    C, Phi, r = (torch.randn(2 * n, nq, k, generator=random, dtype=torch.float64) for k in (p, 4, 1))
    r, inertial = r[..., 0], torch.randn(2 * n, nq, generator=random, dtype=torch.float64)
    i, group = torch.arange(n), (torch.arange(n) // 60).repeat(2)
    weight = torch.ones_like(r)
    weight[30, 0] = 0.3
    rows = Rows(
        *(r, r, r, r, Phi, weight, group, group, group, torch.cat([i + n, i])),
        *(Phi[..., :0], r, 0.0 * r, 0.01, 0.03**2),
    )
    mean, columns = averaged(rows, C, inertial, 0.04)
    assert mean.step == 0.02 and len(columns) == 2 * len(range(15, n - 15, 2))
    k = torch.arange(-15, 16).double()
    narrow, wide = (torch.exp(-0.5 * (k / std) ** 2) for std in (4.0, 5.0))
    at = n + 15 + 2 * 30 + torch.arange(-15, 16)
    row = len(columns) // 2 + 30
    torch.testing.assert_close(columns[row], torch.einsum("k,kjp->jp", narrow / narrow.sum(), C[at]))
    force = torch.einsum("k,kj->j", wide / wide.sum(), (r + inertial)[at])
    expected = force - torch.einsum("k,kj->j", narrow / narrow.sum(), inertial[at])
    torch.testing.assert_close(mean.residual[row], expected)
    torch.testing.assert_close(mean.friction[row], torch.einsum("k,kjf->jf", wide / wide.sum(), Phi[at]))
    inside = torch.tensor([15 <= c % 60 < 45 for c in range(15, n - 15, 2)]).repeat(2)
    assert bool((mean.weight[:, 1] == inside).all()), "no average reaches across stretches"
    near = mean.weight[: len(inside) // 2, 0][:15]
    assert set(near.tolist()) == {0.3}, "a joint that sticks makes the whole average uncertain"


@pytest.mark.parametrize("factor", [1e-3, 1e-6])
def test_work_is_bounded_by_the_rows_whatever_the_unit_of_time(file: RobotModel, factor: float) -> None:
    """Fixed times over a step of 10 ns are millions of rows, of which the log has 1600."""
    data = log(file)
    start = time.process_time()
    found(file, data.replace(t=factor * data.t))
    assert time.process_time() - start < 60.0


def test_a_partner_is_later_in_the_same_trajectory(file: RobotModel) -> None:
    system, prior = forcegp.ConstrainedSystem(file), JointFrictionPrior()
    data = log(file, speed=0.5)
    m = training_of(data, system, (prior,), None, {}).measurements[0]
    later = partners(m)
    paired = (later >= 0).nonzero()[:, 0]
    assert len(paired) == len(data) - 8 * 5, "five samples of 0.01 s at the end of each of eight trajectories"
    assert bool((m.segment[later[paired]] == m.segment[paired]).all())
    torch.testing.assert_close(m.t[later[paired]] - m.t[paired], torch.full((len(paired),), APART).double())
    shuffled = torch.randperm(len(m.t), generator=torch.Generator().manual_seed(0))
    again = m[shuffled]
    found = partners(again)
    torch.testing.assert_close(
        again.t[found[found >= 0]] - again.t[found >= 0], m.t[later[paired]] - m.t[paired]
    )
    assert not bool((partners(m[torch.arange(0, len(m.t), 50)]) >= 0).any()), "half a second apart is too far"


@pytest.mark.parametrize(("free", "warns"), [(20, True), (400, False)])
def test_a_log_that_cannot_check_the_inertia_says_so(file: RobotModel, free: int, warns: bool) -> None:
    """In contact the multiplier takes what the masses of the file are wrong by."""
    wire = forcegp.SurfaceContact("wire", "tip", (0.0, 0.0, 0.0), forcegp.Plane(offset=-0.2))
    system, prior, data = forcegp.ConstrainedSystem(file, [wire]), JointFrictionPrior(), log(file)
    model = forcegp.StructuredGP(system, "analytical", [prior], inertia="auto")
    data = data.replace(contact={"wire": torch.arange(len(data)) >= free})
    training = training_of(data, system, (prior,), None, {})
    doubts = model.specification.inertia_of(training).doubts
    assert any(f"{free} samples in free motion are too few" in doubt for doubt in doubts) == warns
    force = Observation(
        data.replace(contact_extras={"multiplier": {"wire": data.t}}), "multiplier", noise_std=0.5
    )
    sensed = training_of([Observation(data), force], system, (prior,), None, {})
    doubts = model.specification.inertia_of(sensed).doubts
    assert not any("in free motion" in doubt for doubt in doubts), "a measured force tells"


def test_sums_give_the_dense_least_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unknowns and friction together, each joint weighted by its noise."""
    monkeypatch.setattr(inverse_dynamics, "RIDGE", 0.0)
    random = torch.Generator().manual_seed(0)
    n, nq, f, p = 60, 2, 3, 4
    C = torch.randn(n, nq, p, generator=random, dtype=torch.float64)
    Phi = torch.randn(n, nq, f, generator=random, dtype=torch.float64)
    r, tau = torch.randn(2, n, nq, generator=random, dtype=torch.float64)
    group = torch.arange(n) * 3 // n
    moves = torch.ones_like(r)
    along = group, group, group, torch.arange(n)
    by_stretch = sums(Rows(r, r, r, r, Phi, moves, *along, Phi[..., :0], tau, r), C)
    every, rest = by_stretch.total(), by_stretch.without(1)
    for given, own in ((every, group >= 0), (rest, group != 1)):
        H, h, per_gain = given.quadratic(NOISE)
        delta = torch.linalg.solve(H, h)
        w = given.friction(delta)
        rows = [torch.cat([C[own, j], *(Phi[own, j] if k == j else 0.0 * Phi[own, j] for k in range(nq))], -1)
                / NOISE[j] for j in range(nq)]  # fmt: skip
        dense = torch.linalg.lstsq(
            torch.cat(rows), torch.cat([r[own, j] / NOISE[j] for j in range(nq)])
        ).solution
        torch.testing.assert_close(torch.cat([delta, w.flatten()]), dense, rtol=ROUNDING, atol=ROUNDING)
        # A relative error of the gain of joint k adds τ_k to the torque of that joint alone.
        more = [torch.cat([tau[own, j] * (j == k) / NOISE[j] for j in range(nq)]) for k in range(nq)]
        change = torch.linalg.lstsq(torch.cat(rows), torch.stack(more, dim=-1)).solution[:p]
        torch.testing.assert_close(torch.linalg.solve(H, per_gain), change, rtol=ROUNDING, atol=ROUNDING)
        left = r[own] - (C[own] @ delta) - (Phi[own] * w).sum(-1)
        torch.testing.assert_close(given.error(delta, w), left.square().mean(0), rtol=1e-9, atol=0.0)


def test_instruments_give_the_textbook_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """(ZᵀX)⁻¹Zᵀr with the partners' columns for the unknowns; products of errors, one by one."""
    monkeypatch.setattr(inverse_dynamics, "RIDGE", 0.0)
    random = torch.Generator().manual_seed(1)
    n, nq, f, p = 60, 2, 3, 4
    C = torch.randn(n, nq, p, generator=random, dtype=torch.float64)
    Phi = torch.randn(n, nq, f, generator=random, dtype=torch.float64)
    r = torch.randn(n, nq, generator=random, dtype=torch.float64)
    partner = torch.cat([torch.arange(n // 2) + n // 2, torch.arange(n // 2)])
    group = torch.arange(n // 2).repeat(2) * 3 // (n // 2)
    weight = 0.2 + 0.8 * torch.rand(n, nq, generator=random, dtype=torch.float64)
    rows = Rows(r, r, r, r, Phi, weight, group, group, group, partner, Phi[..., :0], r, r)
    every = instrumental(rows, C).total()
    delta = torch.linalg.solve(*every.quadratic(NOISE)[:2])
    X, Z = (torch.zeros(n, nq, p + nq * f, dtype=torch.float64) for _ in range(2))
    X[..., :p], Z[..., :p] = C, C[partner]
    for j in range(nq):
        X[:, j, p + j * f : p + (j + 1) * f] = Z[:, j, p + j * f : p + (j + 1) * f] = Phi[:, j]
    # Friction belongs to one joint, so its equations do not depend on the weights.
    pair = weight * weight[partner]
    weighted = (Z * pair[..., None] / NOISE[:, None] ** 2).flatten(0, 1)
    dense = torch.linalg.solve(weighted.mT @ X.flatten(0, 1), weighted.mT @ r.flatten())
    torch.testing.assert_close(
        torch.cat([delta, every.friction(delta).flatten()]), dense, rtol=ROUNDING, atol=ROUNDING
    )
    left = r - X @ dense
    found = products(rows, C).total().error(delta, every.friction(delta))
    expected = (pair * left * left[partner]).sum(0) / pair.sum(0)
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-10)


def test_a_joint_at_rest_is_found_behind_the_noise_of_its_velocity() -> None:
    """At rest, friction has any value below that of motion; the noise is twice the sharpest speed."""
    random = torch.Generator().manual_seed(0)
    n = 2000
    true = torch.randn(n, 2, generator=random, dtype=torch.float64)
    true[: n // 3, 0] = 0.0
    qd = true + 0.04 * torch.randn(n, 2, generator=random, dtype=torch.float64)
    friction = torch.where(true == 0.0, 2.0 * torch.rand(n, 2, generator=random).double() - 1.0, true.sign())
    Phi = torch.stack([torch.tanh(qd / 0.02), qd, torch.ones_like(qd)], dim=-1)
    weight = rest_weight(qd.abs(), 0.02, Phi, friction + 0.1 * torch.randn(n, 2, generator=random).double())
    assert float(weight[: n // 3, 0].mean()) < 0.5
    assert bool((weight[n // 3 :].mean(0) > 0.9).all()), "but for rows as slow as the noise"


def test_harm_is_what_the_joints_suffer_on_average() -> None:
    before = torch.ones(8, 2, dtype=torch.float64)
    assert not log_ratio(before, before).any() and not log_ratio(0.0 * before, 0.0 * before).any()
    assert is_harmless(1.03 * before, before), "one and a half percent of the root mean square"
    assert is_harmless(before * torch.tensor([1.06, 0.8]), before), "less than the other joint gains"
    assert not is_harmless(before * torch.tensor([1.12, 0.99]), before), "more than the other joint gains"


def test_correlation_times_of_known_processes() -> None:
    """(1 + a)/(1 − a) of an AR(1) process, and (1 − b)²/(1 + b²) of noise that swings back by b."""
    noise = torch.randn(60_000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x = noise.clone()
    for k in range(1, len(x)):
        x[k, 0] = 0.8 * x[k - 1, 0] + noise[k, 0]
    x[1:, 1] = noise[1:, 1] - 0.5 * noise[:-1, 1]
    time = correlation_times(x, torch.zeros(len(x), dtype=torch.int64), 100)
    torch.testing.assert_close(time, torch.tensor([9.0, 0.2], dtype=torch.float64), rtol=0.15, atol=0.0)


def test_an_unknown_source_of_inertia_is_named(file: RobotModel) -> None:
    with pytest.raises(UnknownNameError, match="guess"):
        forcegp.StructuredGP(forcegp.ConstrainedSystem(file), "analytical", inertia="guess")


@pytest.mark.slow
def test_the_file_is_kept_where_the_user_says_so(file: RobotModel) -> None:
    """The defaults of a measured log add what a light robot lacks, and "file" forbids it."""
    light = file.replace(mass=0.3 * file.mass, inertia=0.3 * file.inertia)
    data = log(file)[::4]
    system = forcegp.ConstrainedSystem(light)
    told = {
        name: forcegp.StructuredGP(system, "analytical", inertia=name).fit(data) for name in ("auto", "file")
    }
    assert told["auto"].result.warnings != told["file"].result.warnings
    assert torch.equal(told["file"].system.robot.mass, light.mass)
    assert not bool(told["file"].system.robot.armature.any())
    assert "inertial" not in [prior.name for prior in told["file"].posterior.priors]


def test_few_blocks_show_a_difference_by_chance_no_more_often_than_two_standard_errors() -> None:
    generator = torch.Generator().manual_seed(0)
    for blocks in (3, 8):
        noise = torch.randn(20_000, blocks, generator=generator, dtype=torch.float64)
        share = sum(is_less(each) for each in noise) / len(noise)
        assert share == pytest.approx(0.02275, abs=0.004)  # Φ(−2)


def test_drives_need_evidence_with_links_unknown() -> None:
    """Of five drives clear with links at the file: dropped where data are against it, or it is negative."""
    V, W = torch.full((5,), 1e-4), torch.tensor([1e-2, 1e-2, 0.9, 1e-2, 1e-2])
    v = torch.tensor([0.01, 0.5, 0.05, -0.5, 0.5])
    clear = torch.tensor([0.2, 0.2, 0.2, 0.2, 0.02])
    # log N(0; v, W) − log N(0; 0, 1), the ratio of Savage and Dickey
    worth = torch.distributions.Normal(0.0, 1.0).log_prob(torch.zeros(5)) - torch.distributions.Normal(
        v, W.sqrt()
    ).log_prob(torch.zeros(5))
    assert (worth < -np.log(3.0)).tolist() == [True, False, False, False, False]
    answers = {5: (clear, V), 8: (v, W)}
    fake: Any = SimpleNamespace(
        by_stretch=SimpleNamespace(unknowns=9), read=lambda n, unknowns: answers[len(unknowns)]
    )
    kept = _Regression.carried_drives(fake, torch.zeros(5), torch.arange(0))
    assert kept.tolist() == [1, 2]
