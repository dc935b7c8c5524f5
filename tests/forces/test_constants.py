"""Drive constants, and payloads of several recordings in one fit, are those of the simulated robots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp import dynamics
from forcegp.data.fields import UNKNOWN
from forcegp.errors import ModelError
from forcegp.forces.posterior import ForceSamples
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.constants import DrivePrior, OffsetPrior, PerRecording
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
    parts = [_recording(_loaded(robot, mass), 1.0, k).named(str(k)) for k, mass in enumerate(MASSES)]
    data = forcegp.Dataset.concatenate(parts)
    fit = _fit(data, PerRecording(PayloadPrior(measured=True), ("0", "1")))
    mean, std = _constants(fit)
    scale = fit.hyperparameters["payload.log_scale"].exp()
    found, error = mean.view(4, 3)[0], std.view(4, 3)[0]
    assert bool(((found[:2] - torch.tensor(MASSES)).abs() <= SIGMAS * error[:2]).all())
    assert float(error[:2].max()) < 0.2
    # The payload of another recording is unknown.
    assert float(found[2]) == 0.0 and float(error[2] / scale) == pytest.approx(1.0, abs=0.15)
    fit.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model")
    assert isinstance(again, StructuredFit)
    torch.testing.assert_close(again.predict_log(parts[1]).mean, fit.predict_log(parts[1]).mean)


def test_predictions_along_a_log_contain_the_payload_of_its_recording() -> None:
    """Loads change the acceleration exactly, not only to first order, and other recordings have bars."""
    robot = forcegp.load_robot("double_pendulum")
    heavy = [_recording(_loaded(robot, mass), 1.0, k).named(str(k)) for k, mass in enumerate(MASSES)]
    fit = _fit(forcegp.Dataset.concatenate(heavy), PerRecording(PayloadPrior(measured=True), ("0", "1")))
    test = _recording(_loaded(robot, MASSES[1]), 1.0, 7)
    known, other = fit.predict_log(test.named("1"), noise=True), fit.predict_log(test, noise=True)
    errors = [float((found.mean - test.qdd).square().mean().sqrt()) for found in (known, other)]
    assert errors[0] < 0.1 * errors[1]
    assert known.std is not None and other.std is not None
    assert float(((other.mean - test.qdd).abs() <= 2.0 * other.std).double().mean()) > 0.9
    assert float(known.std.mean()) < 0.1 * float(other.std.mean())
    torch.testing.assert_close(other.mean, fit.predict(test.q, test.qd, test.tau).mean)


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
    q, numbers = torch.randn(3, 2, dtype=torch.float64), torch.tensor([[5], [2], [UNKNOWN]])
    at = states(system, q, q, q, torch.zeros(3, 0, dtype=torch.bool), recording=numbers)
    prior, own = PerRecording(PayloadPrior(), ("2", "5")), PayloadPrior().operator(system, at)
    E = prior.operator(system, at).unflatten(-1, (4, 3))
    for row, place in enumerate((1, 0, 2)):
        torch.testing.assert_close(E[row, ..., place], own[row])
    assert float(E.abs().sum()) == pytest.approx(float(own.abs().sum()))
    new = prior.operator(system, replace(at, recording=None)).unflatten(-1, (4, 3))
    torch.testing.assert_close(new[..., 2], own)
    assert not bool(new[..., :2].any())


OFFSETS = ((0.8, 0.0), (-0.5, 0.0), (0.4, 0.0))
"""Offsets of the torque sensors in three recordings [N m]; joint 2 has none."""


def _offset(
    seed: int, offset: tuple[float, float], name: str, carrying: forcegp.RobotModel | None = None
) -> forcegp.Dataset:
    """A recording of an arm with friction along a smooth motion, with an offset of the logged torques."""
    robot = carrying or forcegp.load_robot("double_pendulum")
    generator = torch.Generator().manual_seed(seed)
    t = 0.01 * torch.arange(800, dtype=torch.float64)
    size, w, phase = torch.rand(3, 4, 2, generator=generator, dtype=torch.float64)
    w, angle = 1.0 + 4.0 * w, t[:, None, None] * (1.0 + 4.0 * w) + 6.0 * phase
    q, qd, qdd = (
        (x * (0.3 + 0.3 * size)).sum(1) for x in (angle.sin(), w * angle.cos(), -w * w * angle.sin())
    )
    friction = 0.3 * qd + 0.5 * torch.tanh(qd / 0.02)
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd) - dynamics.damping_force(robot, qd) + friction
    tau = tau + torch.tensor(offset) + 0.05 * torch.randn(tau.shape, generator=generator, dtype=tau.dtype)
    return forcegp.Dataset(t, q, qd, tau, qdd, robot.joint_names).named(name)


@pytest.fixture(scope="module")
def of_recordings() -> StructuredFit:
    """A default fit of three recordings."""
    parts = [_offset(k, each, f"run {k}") for k, each in enumerate(OFFSETS)]
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    return forcegp.StructuredGP(system).fit(forcegp.Dataset.concatenate(parts))


def test_a_default_fit_learns_the_offset_of_each_recording(of_recordings: StructuredFit) -> None:
    worth = of_recordings.result.worth
    assert worth["recordings of shoulder"] > 100.0 and worth["recordings of elbow"] == 0.0
    learned = {each.name: each for each in of_recordings.parameters()}
    each = [learned[f"recordings.offset_run {k} of shoulder"] for k in range(3)]
    # A common offset is part of friction. τ = M q̈ − Q + offset, so offsets of the force have the other sign.
    for other, offset in ((1, OFFSETS[1]), (2, OFFSETS[2])):
        difference = each[other].value - each[0].value
        assert difference == pytest.approx(-(offset[0] - OFFSETS[0][0]), abs=0.03)
    unknown = learned["recordings.offset of shoulder"]
    assert unknown.value == 0.0 and 0.3 < unknown.std < 1.5 and not unknown.determined
    assert learned["recordings.offset of elbow"].std < 1e-4


def test_a_log_uses_the_offset_of_its_recording_only_if_it_names_it(
    of_recordings: StructuredFit, tmp_path: Path
) -> None:
    fit, test = of_recordings, _offset(9, OFFSETS[1], "run 1")
    named = fit.predict_log(test, "joint_force", noise=True)
    for other in (
        test.named("another run"),
        test.replace(recording=torch.full_like(test.recording, UNKNOWN)),
    ):
        unknown = fit.predict_log(other, "joint_force", noise=True)
        assert named.std is not None and unknown.std is not None
        assert float(unknown.std[:, 0].median()) > 5.0 * float(named.std[:, 0].median())
        missed = (fit.predict_log(other).mean - test.qdd).square().mean(0)
        known = (fit.predict_log(test).mean - test.qdd).square().mean(0)
        assert float(known[0]) < 0.1 * float(missed[0])
    plain = fit.predict(test.q, test.qd, test.tau)
    error = (plain.mean - test.qdd).abs()
    assert plain.std is not None and float((error <= 2.0 * plain.std).double().mean(0).min()) > 0.9
    compiled = fit.compiled().predict(test.q[:20], test.qd[:20], test.tau[:20])
    torch.testing.assert_close(compiled.mean, plain.mean[:20], rtol=1e-7, atol=1e-9)
    assert compiled.std is not None
    torch.testing.assert_close(compiled.std, plain.std[:20], rtol=1e-6, atol=1e-9)
    fit.save(tmp_path / "fit")
    again = forcegp.load_model(tmp_path / "fit")
    assert isinstance(again, StructuredFit)
    torch.testing.assert_close(again.predict_log(test).mean, fit.predict_log(test).mean)


def test_recordings_that_do_not_differ_or_are_unknown_have_no_offsets() -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    parts = [_offset(k, (0.3, -0.2), f"run {k}") for k in range(3)]
    same = forcegp.StructuredGP(system).fit(forcegp.Dataset.concatenate(parts))
    assert same.result.worth["recordings of shoulder"] == same.result.worth["recordings of elbow"] == 0.0
    one = forcegp.Dataset.concatenate([part.named("run") for part in parts])
    mixed = one.replace(recording=torch.where(one.t < 1.0, UNKNOWN, one.recording))
    still = [part.replace(q=0.01 * part.q) for part in parts]
    closed = torch.ones(len(parts[0]), dtype=torch.bool)
    touching = [part.replace(contact={"floor": closed}) for part in parts]
    for data in (one, mixed, *map(forcegp.Dataset.concatenate, (still, touching))):
        spec = forcegp.StructuredGP(system).specification.for_data(data)
        assert not any(isinstance(prior, OffsetPrior) for prior in spec.priors)


LOAD = 0.6
"""Mass that the arm carries in the second of two recordings [kg]."""


@pytest.fixture(scope="module")
def carried() -> StructuredFit:
    """A default fit of a recording without a payload and one with it."""
    robot = forcegp.load_robot("double_pendulum")
    parts = [_offset(0, (0.0, 0.0), "empty"), _offset(1, (0.0, 0.0), "loaded", _loaded(robot, LOAD))]
    return forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(forcegp.Dataset.concatenate(parts))


def test_a_default_fit_learns_the_payload_of_a_recording(carried: StructuredFit, tmp_path: Path) -> None:
    assert carried.result.worth["payload"] > 100.0
    found = {each.name: each for each in carried.robot_parameters() if each.of == "loaded"}
    mass = found["payload mass"]
    assert mass.unit == "kg" and mass.determined and mass.std is not None
    assert 0.02 * LOAD <= mass.std < 0.1 and abs(mass.value - LOAD) <= SIGMAS * mass.std
    # The links are those of the first recording, and the robot file has the right ones.
    file, robot = carried.specified.robot, carried.system.robot
    assert float((robot.mass - file.mass).abs().max()) < 0.05 * LOAD
    test = _offset(5, (0.0, 0.0), "loaded", _loaded(file, LOAD))
    errors = [
        float((carried.predict_log(log).mean - test.qdd).square().mean().sqrt())
        for log in (test, test.named("another"))
    ]
    assert errors[0] < 0.2 * errors[1]
    carried.save(tmp_path / "fit")
    again = forcegp.load_model(tmp_path / "fit")
    assert isinstance(again, StructuredFit)
    torch.testing.assert_close(again.predict_log(test).mean, carried.predict_log(test).mean)


def test_code_of_a_fit_has_the_payload_of_an_unknown_recording(carried: StructuredFit) -> None:
    test = _offset(6, (0.0, 0.0), "empty")[::20]
    plain = carried.predict(test.q, test.qd, test.tau)
    compiled = carried.compiled(jacobians=False).predict(test.q, test.qd, test.tau)
    torch.testing.assert_close(compiled.mean, plain.mean, rtol=1e-7, atol=1e-9)
    assert compiled.std is not None
    torch.testing.assert_close(compiled.std, plain.std, rtol=1e-6, atol=1e-9)


def test_recordings_with_the_same_payload_have_none(of_recordings: StructuredFit) -> None:
    """Not even with different offsets."""
    assert not any(isinstance(prior, PerRecording) for prior in of_recordings.force_priors)


def test_a_joint_without_reversal_has_no_offset() -> None:
    """One way, an offset and dry friction have the same torque."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    parts = [_offset(k, (0.3, -0.2), f"run {k}") for k in range(3)]
    turns = torch.tensor([True, False])
    parts[0] = parts[0].replace(qd=torch.where(turns, parts[0].qd, parts[0].qd.abs()))
    parts[1] = parts[1].replace(qd=torch.where(turns, parts[1].qd, parts[1].qd.abs()))
    spec = forcegp.StructuredGP(system).specification.for_data(forcegp.Dataset.concatenate(parts))
    prior = next(prior for prior in spec.priors if isinstance(prior, OffsetPrior))
    assert prior.moves == ((True, False), (True, False), (True, True))
    assert prior.separable == [True, False]


def test_what_is_not_constant_or_has_one_name_twice_is_refused() -> None:
    with pytest.raises(ModelError, match="not a prior on constants"):
        PerRecording(JointForcePrior(), ("a", "b"))
    with pytest.raises(ModelError, match="distinct names"):
        PerRecording(PayloadPrior(), ("a", "a"))
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
