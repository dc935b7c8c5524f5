"""Drive constants, and payloads of several recordings in one fit, are those of the simulated robots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp import dynamics
from forcegp.errors import ModelError
from forcegp.forces.posterior import ForceSamples
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.constants import DrivePrior, PerRecording
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.forces.priors.joint import JointForcePrior, JointFrictionPrior
from forcegp.forces.quantities import states
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.inertia import from_pseudo_inertia, pseudo_inertia

SAMPLES, NOISE = 150, 0.02
"""Of each recording, and the noise of accelerations [rad/s²]."""
MASSES = (0.8, 2.0)
"""Payloads of two recordings [kg]."""
SIGMAS = 3.0
"""Largest error, in posterior standard deviations."""


def _loaded(robot: forcegp.RobotModel, mass: float) -> forcegp.RobotModel:
    """The robot with a point mass 0.1 m along the z axis of its last link."""
    point = torch.tensor([0.0, 0.0, 0.1, 1.0], dtype=torch.float64)
    J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
    J[-1] += mass * torch.outer(point, point)
    mass_, com, inertia = from_pseudo_inertia(J)
    return robot.replace(mass=mass_, com=com, inertia=inertia)


def _recording(robot: forcegp.RobotModel, gain: float, seed: int) -> forcegp.Dataset:
    """Random states; drives give `gain` times the logged torque, less friction."""
    torch.manual_seed(seed)
    q, qd, tau = torch.randn(3, SAMPLES, robot.nq, dtype=torch.float64)
    tau = 0.5 * tau + dynamics.inverse_dynamics(robot, q, 0.0 * q, 0.0 * q)
    friction = 0.3 * qd + 0.5 * torch.tanh(qd / 0.02)
    qdd = dynamics.forward_dynamics(robot, q, qd, tau - friction)
    qdd = qdd + NOISE * torch.randn_like(qdd)
    t = 0.01 * torch.arange(SAMPLES, dtype=torch.float64)
    return forcegp.Dataset(t=t, q=q, qd=qd, tau=tau / gain, qdd=qdd, joint_names=robot.joint_names)


def _fit(data: forcegp.Dataset, *priors: ForcePrior) -> StructuredFit:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    return forcegp.StructuredGP(system, "analytical", [JointFrictionPrior(), *priors], noise=NOISE).fit(data)


def _constants(fit: StructuredFit) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of the constants of the second prior."""
    posterior, m = fit.posterior, fit.problem.training.measurements[0]
    at = m[torch.zeros(1, dtype=torch.int64)].at(fit.system)
    one = posterior.process.features(1, fit.system, at)
    drawn = fit.force_samples(400, torch.Generator().manual_seed(0))
    assert isinstance(drawn, ForceSamples)
    return posterior.latent.latent_mean(1, one)[0], drawn.functions.latent(1, one)[:, 0].std(0)


def test_two_recordings_have_their_own_payloads_in_one_fit(tmp_path: Path) -> None:
    robot = forcegp.load_robot("double_pendulum")
    parts = [_recording(_loaded(robot, mass), 1.0, k) for k, mass in enumerate(MASSES)]
    data = forcegp.Dataset.concatenate(parts)
    fit = _fit(data, PerRecording(PayloadPrior(measured=True), (0, 1)))
    mean, std = _constants(fit)
    found, error = mean.view(2, 4)[:, 0], std.view(2, 4)[:, 0]
    assert bool(((found - torch.tensor(MASSES)).abs() <= SIGMAS * error).all())
    assert float(error.max()) < 0.2
    fit.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model")
    state = parts[1].q[:5], parts[1].qd[:5], parts[1].tau[:5]
    torch.testing.assert_close(again.predict(*state).mean, fit.predict(*state).mean)


def test_drive_constants_are_learned_with_their_errors() -> None:
    robot = forcegp.load_robot("double_pendulum")
    gain = 1.15
    fit = _fit(_recording(robot, gain, 2), DrivePrior())
    mean, std = _constants(fit)
    scale = DrivePrior().std
    assert bool(((scale * mean + 1.0 - gain).abs() <= SIGMAS * scale * std).all())
    assert float(scale * std.max()) < 0.02


def test_rows_of_a_recording_have_its_columns_only() -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    q = torch.randn(3, 2, dtype=torch.float64)
    time = torch.tensor([[0.0, 0.0], [0.0, 2.0], [0.0, 5.0]], dtype=torch.float64)
    at = states(system, q, q, q, torch.zeros(3, 0, dtype=torch.bool), time=time)
    E = PerRecording(PayloadPrior(), (0, 2, 3)).operator(system, at).unflatten(-1, (3, 4))
    own = PayloadPrior().operator(system, at)
    for row in range(3):
        torch.testing.assert_close(E[row, :, row], own[row])
    assert float(E.abs().sum()) == pytest.approx(float(own.abs().sum()))
    new = PerRecording(PayloadPrior(), (0, 2)).operator(system, replace(at, time=None)).unflatten(-1, (2, 4))
    torch.testing.assert_close(new[:, :, 1], own)
    assert not bool(new[:, :, 0].any())


def test_what_is_not_constant_or_ordered_is_refused() -> None:
    with pytest.raises(ModelError, match="not a prior on constants"):
        PerRecording(JointForcePrior(), (0, 1))
    with pytest.raises(ModelError, match="ascending"):
        PerRecording(PayloadPrior(), (1, 0))
    with pytest.raises(ModelError, match="standard deviation"):
        DrivePrior(std=0.0)


def test_errors_of_scales_include_the_contact_force() -> None:
    """In contact, M q̈ − Q_K is not the torque of the drives; without contact, it has no torque noise."""
    system = forcegp.load_scene("kuka_plane").system()
    robot = system.robot
    q, qd, tau, qdd = torch.randn(4, 6, robot.nq, dtype=torch.float64)
    closed = torch.arange(6)[:, None] % 2 == 0
    at = states(system, q, qd, tau, closed, qdd=qdd)
    E = DrivePrior(std=0.1, is_error=True).operator(system, at)
    rigid = dynamics.inverse_dynamics(robot, q, qd, qdd) - dynamics.damping_force(robot, qd)
    expected = 0.1 * torch.where(closed, tau, rigid)
    torch.testing.assert_close(E, torch.diag_embed(expected))
