"""What a fit found as figures of a robot file, beside the robot that made the log."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor
from typer.testing import CliRunner

import forcegp
from forcegp.cli.app import app
from forcegp.control.information import Unknowns
from forcegp.dynamics import damping_force, forward_dynamics, inverse_dynamics, mass_matrix
from forcegp.errors import ModelError, ParameterError, UnknownNameError, optional_module
from forcegp.forces.posterior import ForceSamples, draw_samples
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.priors.memory import BristlePrior
from forcegp.forces.problem import force_posterior
from forcegp.forces.quantities import states_at
from forcegp.identification import regressor
from forcegp.learning.inertia import latent_precision, one_row
from forcegp.models.calibrated import (
    _Reader,
    calibrated,
    sampled_robots,
    unknowns_after,
    without_armature,
    write_calibrated,
)
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.inertia import pseudo_inertia
from forcegp.robot.write_back import write_robot
from forcegp.rollout import RolloutOptions
from forcegp.simulate.excite import Limits, excite, random_states
from forcegp.simulate.passive import PassiveForces
from forcegp.simulate.urdf import write_urdf
from learning.test_inertia import log, unit_inertia

mujoco = optional_module("mujoco", "These tests")
DAMPING, DRY = (0.3, 0.1), (1.0, 0.4)
NOISE = 0.05
"""Standard deviation of the torque [N m]."""


def log_of(robot: forcegp.RobotModel, n: int, seed: int) -> forcegp.Dataset:
    """A log of sines, whose torques have friction that the file lacks, and noise."""
    generator = torch.Generator().manual_seed(seed)
    t = 0.02 * torch.arange(n, dtype=torch.float64)
    rate = 2.0 * torch.pi * (0.1 + torch.rand(4, robot.nq, generator=generator, dtype=torch.float64))
    angle = rate * t[:, None, None] + 6.0 * torch.rand(4, robot.nq, generator=generator, dtype=torch.float64)
    size = 0.6 / rate
    q, qd, qdd = (
        (size * torch.sin(angle)).sum(1),
        (size * rate * torch.cos(angle)).sum(1),
        -(size * rate**2 * torch.sin(angle)).sum(1),
    )
    tau = inverse_dynamics(robot, q, qd, qdd) + torch.tensor(DAMPING) * qd + torch.tensor(DRY) * qd.sign()
    tau = tau + NOISE * torch.randn(tau.shape, generator=generator, dtype=torch.float64)
    return forcegp.Dataset(t=t, q=q, qd=qd, qdd=qdd, tau=tau, joint_names=robot.joint_names)


@pytest.fixture(scope="module")
def fit() -> StructuredFit:
    """Links 20 % heavier than in the file, and friction; inertial parameters are uncertain."""
    robot = forcegp.load_robot("double_pendulum")
    system = forcegp.ConstrainedSystem(robot)
    true = robot.replace(mass=1.2 * robot.mass, inertia=1.2 * robot.inertia)
    model = forcegp.StructuredGP(
        system, "analytical", force_priors=[JointFrictionPrior(), InertialPrior()], noise=0.01
    )
    return model.fit(log_of(true, 1500, 0))


def test_friction_and_inertia_are_those_of_the_robot(fit: StructuredFit) -> None:
    found = calibrated(fit)
    by_name = {(p.element, p.name): p for p in found.parameters}
    for j, joint in enumerate(found.robot.joint_names):
        for name, true in (("damping", DAMPING[j]), ("friction", DRY[j])):
            parameter = by_name[joint, name]
            assert parameter.determined and parameter.file == 0.0
            assert abs(parameter.estimate - true) < 3.0 * parameter.std + 0.02
    q = torch.tensor([[0.0, 0.0], [0.3, 1.0]], dtype=torch.float64)
    file = fit.specified.robot
    ratio = mass_matrix(found.robot, q) / mass_matrix(file, q)
    torch.testing.assert_close(ratio, torch.full_like(ratio, 1.2), rtol=0.03, atol=0.0)
    assert float(found.left.max()) < 0.05 * max(DRY)
    # The offset is zero up to rounding, with either sign, and no constant force of -0 is reported.
    assert len(found.losses) == 2 and all("friction beyond" in each for each in found.losses)
    assert not any("constant force" in each for each in found.losses)
    pushed = dataclasses.replace(found, offset=torch.full_like(found.offset, -0.3))
    assert pushed.losses[0].endswith("and a constant force of -0.3 (N m or N)")
    exact = dataclasses.replace(found, offset=torch.full_like(found.offset, 3e-16))
    assert dataclasses.replace(exact, left=torch.full_like(found.left, 1e-16)).losses == ()


def test_samples_are_consistent_and_around_the_estimate(fit: StructuredFit) -> None:
    robots = sampled_robots(fit, 100, seed=1)
    for robot in robots:
        assert float(torch.linalg.eigvalsh(pseudo_inertia(robot.mass, robot.com, robot.inertia)).min()) > 0.0
        assert bool((robot.friction >= 0.0).all() and (robot.damping >= 0.0).all())
    found = calibrated(fit)
    std = {(p.element, p.name): p.std for p in found.parameters}

    def spread(values: Tensor, name: str) -> None:
        own = torch.tensor([std[joint, name] for joint in found.robot.joint_names], dtype=torch.float64)
        torch.testing.assert_close(values.std(0), own, rtol=0.35, atol=1e-6)

    spread(torch.stack([robot.damping for robot in robots]), "damping")
    M = mass_matrix(found.robot, torch.zeros(2, dtype=torch.float64))
    sampled = torch.stack([mass_matrix(each, torch.zeros(2, dtype=torch.float64)) for each in robots])
    error = (sampled / M - 1.0).diagonal(dim1=-2, dim2=-1)
    assert bool((error.median(0).values.abs() < 0.05).all()) and float(error.abs().median()) < 0.05
    # M is linear in the links, M = M₀ + C S δ, and bodies change it less than the posterior knows it.
    q, zero = torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
    p = next(k for k, prior in enumerate(fit.force_priors) if isinstance(prior, InertialPrior))
    precision = latent_precision(fit.posterior, one_row(fit.posterior, fit.problem), p, fit.system.robot)
    scale = InertialPrior().scale(forcegp.load_robot("double_pendulum"))
    for j, unit in enumerate(torch.eye(2, dtype=torch.float64)):
        Y = regressor(found.robot, q, zero, unit[None]) - regressor(found.robot, q, zero, zero)
        C = Y[0, j] * scale
        expected = (C @ torch.linalg.solve(precision, C)).sqrt() / M[j, j]
        assert 0.7 * float(expected) < float(error[:, j].std()) < 1.3 * float(expected)
    # The mean of the samples is the estimate.
    dry = torch.stack([robot.friction for robot in robots])
    assert bool(((dry.mean(0) - found.robot.friction).abs() < 4.0 * dry.std(0) / 10.0 + 1e-3).all())
    again = sampled_robots(fit, 2, seed=1)
    assert torch.equal(again[1].mass, sampled_robots(fit, 2, seed=1)[1].mass)
    with pytest.raises(ParameterError, match="invalid number of samples"):
        sampled_robots(fit, 0)


def test_the_written_file_explains_another_motion(fit: StructuredFit, tmp_path: Path) -> None:
    """Torques of another log: a tenth of the error of the original file."""
    found = write_calibrated(fit, "double_pendulum", tmp_path / "found.urdf", samples=2)
    assert len(found.parameters) == 2 * 13
    file = fit.specified.robot
    log = log_of(file.replace(mass=1.2 * file.mass, inertia=1.2 * file.inertia), 500, 3)

    def error(robot: forcegp.RobotModel) -> float:
        tau = inverse_dynamics(robot, log.q, log.qd, log.qdd)
        tau = tau + robot.damping * log.qd + robot.friction * log.qd.sign()
        return float((tau - log.tau).square().mean().sqrt())

    read = forcegp.load_robot(tmp_path / "found.urdf")
    assert error(read) < 0.1 * error(file)
    report = json.loads((tmp_path / "found.report.json").read_text())
    assert {each["name"] for each in report["parameters"]} >= {"damping", "mass"}
    assert list(report["friction"]) == list(file.joint_names)
    samples = [forcegp.load_robot(path) for path in sorted(tmp_path.glob("found.sample_*.urdf"))]
    assert len(samples) == 2 and not torch.equal(samples[0].mass, samples[1].mass)


def test_links_have_the_inertia_of_drives_where_a_format_has_no_armature() -> None:
    """Joints feel about the same torque, and links stay those of some body."""
    robot = forcegp.load_robot("franka_panda")
    driven = robot.replace(armature=torch.linspace(0.7, 0.01, 7, dtype=torch.float64))
    held = without_armature(driven, torch.full_like(robot.mass, 2.0))
    assert float(held.armature.abs().max()) == 0.0
    q, qd, qdd = torch.randn(3, 40, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    exact, found, none = (
        inverse_dynamics(each, q, qd, 8.0 * qdd)
        for each in (driven, held, driven.replace(armature=0.0 * driven.armature))
    )
    without, with_ = ((x - exact).square().mean(0) for x in (none, found))
    assert bool((with_ < without).all()) and float((with_ / without).log().mean().exp()) < 0.4
    J = pseudo_inertia(held.mass, held.com, held.inertia)
    sound = torch.linalg.eigvalsh(pseudo_inertia(robot.mass, robot.com, robot.inertia))[:, 0] > 0.0
    assert float(torch.linalg.eigvalsh(J)[sound].min()) > -1e-9


def test_a_payload_is_part_of_the_robot() -> None:
    robot = forcegp.load_robot("double_pendulum")
    prior = PayloadPrior()
    heavy = prior.around(torch.tensor([0.5, 0.0, 0.0, -1.0], dtype=torch.float64)).loaded(robot)
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot), "analytical", force_priors=[JointFrictionPrior(), prior], noise=0.2
    )
    fit = model.fit(log_of(heavy, 800, 5))
    one = {"one": torch.zeros(1, 1, dtype=torch.float64)}
    latent = fit.posterior.latent.latent_mean(1, fit.posterior.process.scales[1].apply(one))[0]
    found = calibrated(fit)
    assert float(latent[0]) > 0.2
    assert float(found.robot.mass[-1] - robot.mass[-1]) == pytest.approx(float(latent[0]), abs=0.01)
    mass = {p.element: p for p in found.parameters if p.name == "mass"}
    assert mass[robot.joint_names[-1]].std > 0.0 and mass[robot.joint_names[0]].std == 0.0


def test_forces_around_zero_are_no_calibration(fit: StructuredFit) -> None:
    robot = fit.specified.robot
    blind = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "zero").fit(log_of(robot, 60, 1))
    with pytest.raises(ModelError, match="not relative to the robot file"):
        calibrated(blind)


def test_the_command_writes_the_file_a_report_and_samples(fit: StructuredFit, tmp_path: Path) -> None:
    fit.save(tmp_path / "model")
    runner, base = CliRunner(), ["export", "--model", str(tmp_path / "model")]
    out = tmp_path / "out.urdf"
    done = runner.invoke(
        app, [*base, "--to", "urdf", "--robot", "double_pendulum", "-o", str(out), "--samples", "1", "--json"]
    )
    result = json.loads(done.stdout)
    assert done.exit_code == 0 and result["file"] == str(out) and result["parameters"] == 2 * 13
    assert (
        out.exists()
        and (tmp_path / "out.sample_000.urdf").exists()
        and (tmp_path / "out.report.json").exists()
    )
    for arguments, message in (
        (["--to", "urdf"], "no robot file was given"),
        (["--to", "mjcf", "--robot", "double_pendulum"], "has a different format"),
        (["--to", "sdf"], "format to export to"),
    ):
        failed = runner.invoke(app, [*base, *arguments, "-o", str(tmp_path / "none.urdf")])
        assert failed.exit_code != 0 and not (tmp_path / "none.urdf").exists()
        assert message in f"{failed.output} {failed.exception}"


AGREEMENT = 1e-9
"""Of accelerations by MuJoCo with the learned forces and by the fit, over their size."""


def mujoco_of(robot: forcegp.RobotModel) -> Any:
    """The robot in MuJoCo, with friction that the learned forces must replace."""
    model = mujoco.MjModel.from_xml_string(write_urdf(robot))
    model.opt.gravity[:], model.opt.timestep = robot.gravity.numpy(), 0.002
    model.dof_armature[:], model.dof_damping[:], model.dof_frictionloss[:] = robot.armature.numpy(), 0.7, 0.9
    model.dof_dampingpoly[:] = 0.2, 0.1
    return model


@pytest.mark.parametrize("sample", [False, True])
def test_mujoco_accelerates_as_the_fit_predicts(fit: StructuredFit, sample: bool) -> None:
    robot, model = fit.system.robot, mujoco_of(fit.system.robot)
    field = fit.force_samples(1, torch.Generator().manual_seed(4)) if sample else fit.force_field()
    forces, data = PassiveForces(fit.system, field), mujoco.MjData(model)
    states = 3.0 * torch.randn(
        3, 30, robot.nq, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    found = []
    with forces.installed(model):
        for q, qd, tau in states.unbind(1):
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q.numpy(), qd.numpy(), tau.numpy()
            mujoco.mj_forward(model, data)
            found.append(torch.from_numpy(data.qacc.copy()))
    acceleration = torch.stack(found)
    predicted = fit.predict(*states, "qdd_free").mean
    if sample:
        mean = predicted
        each = [states_at(fit.system, *(x[k : k + 1] for x in states), None)[0] for k in range(30)]
        predicted = torch.cat([at.eom.acceleration(field(fit.system, at)) for at in each])
        assert float((predicted - mean).abs().max()) > 1e-3
    assert float((acceleration - predicted).abs().max()) < AGREEMENT * float(predicted.abs().max())
    assert mujoco.get_mjcb_passive() is None
    assert model.dof_damping.tolist() == [0.7, 0.7] and model.dof_frictionloss.tolist() == [0.9, 0.9]
    assert model.dof_dampingpoly.tolist() == [[0.2, 0.1], [0.2, 0.1]]


def test_mujoco_moves_as_the_rollout_under_the_learned_forces(fit: StructuredFit) -> None:
    model, steps = mujoco_of(fit.system.robot), 1000
    model.opt.timestep, data = 0.0005, mujoco.MjData(model)
    data.qpos[:] = (0.4, -0.2)
    start, tau = torch.tensor([0.4, -0.2], dtype=torch.float64), torch.zeros(steps, 2).double()
    options = RolloutOptions(0.0005, sticking=False)
    path = fit.rollout(start, torch.zeros_like(start), tau, duration=0.5, options=options)
    with PassiveForces(fit.system, fit.force_field()).installed(model):
        for _ in range(steps):
            mujoco.mj_step(model, data)
    assert torch.allclose(torch.tensor(data.qpos), path.q[steps], atol=2e-3)
    assert float((path.q[steps] - start).abs().max()) > 0.05


def test_joints_that_the_simulation_lacks_are_named(fit: StructuredFit) -> None:
    model = mujoco_of(fit.system.robot)
    with pytest.raises(ModelError, match="2 names"):
        PassiveForces(fit.system, fit.force_field(), ["shoulder"])
    with (
        pytest.raises(UnknownNameError, match="wrist"),
        PassiveForces(fit.system, fit.force_field(), ["shoulder", "wrist"]).installed(model),
    ):
        pass
    spec = mujoco.MjSpec.from_string(write_urdf(fit.system.robot))
    motor = spec.add_actuator(target="shoulder", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_dcmotor([1.0, 1.0], 1.0, lugre=[90.0, 0.0, 1.0, 1.0, 0.1])
    forces = PassiveForces(fit.system, fit.force_field())
    with pytest.raises(ModelError, match=r"DC motor .* has LuGre friction"), forces.installed(spec.compile()):
        pass


def test_a_model_lowers_what_is_unknown_and_a_motion_lowers_it_further(fit: StructuredFit) -> None:
    robot = fit.system.robot
    limits = Limits.of(robot, velocity=[3.0], acceleration=[10.0], torque=[50.0])
    region = random_states(robot, limits, 40)
    before = Unknowns.of(robot, limits.low, limits.high, limits.velocity, region)
    known = unknowns_after(fit, before)
    stds = [x.torque_std() for x in (before, known)]
    for part in ("all", "links", "friction"):
        assert bool((stds[1][part] < stds[0][part]).all())
    # The links have the covariance of the posterior, δ = S z.
    prior = next(p for p in fit.force_priors if isinstance(p, InertialPrior))
    index = next(k for k, x in enumerate(fit.force_priors) if x is prior)
    precision = latent_precision(fit.posterior, one_row(fit.posterior, fit.problem), index, robot)
    links, drives = (torch.from_numpy(before.base.combination), torch.eye(len(prior.drives)).double())
    B = torch.block_diag(links, drives) * prior.scale(robot)
    exact = (B @ torch.linalg.solve(precision, B.mT)).diagonal().sqrt()
    found = torch.cat([known.root[known.parts[x]] for x in ("links", "drives")]).norm(dim=-1)[: len(B)]
    assert torch.allclose(found, exact, rtol=0.15, atol=2e-3 * float(before.root.max()))
    system = forcegp.ConstrainedSystem(robot)
    motion = excite(system, 4.0, limits=limits, unknowns=known, restarts=1)
    assert bool((motion.after.torque_std()["all"] < stds[1]["all"]).all())
    assert float(motion.motion.qd.abs().max()) > 0.5


@pytest.fixture(scope="module")
def identified() -> StructuredFit:
    """Links whose mass and centre differ from the file; the drives have no inertia, as in the file."""
    robot = forcegp.load_robot("double_pendulum")
    truth = robot.replace(mass=1.3 * robot.mass, com=0.9 * robot.com)
    return forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical").fit(log(truth, 800))


def inertia_of(identified: StructuredFit) -> tuple[Tensor, Tensor, Tensor, InertialPrior]:
    """States, columns C S of the mean diagonal of M at these, its posterior variance, and the prior."""
    robot, q = identified.specified.robot, identified.training.measurements[0].q[::50]
    p, prior = next((p, x) for p, x in enumerate(identified.force_priors) if isinstance(x, InertialPrior))
    assert isinstance(prior, InertialPrior)
    C = torch.cat([unit_inertia(robot, q), torch.eye(2).double()], dim=-1) * prior.scale(robot)
    precision = latent_precision(
        identified.posterior, one_row(identified.posterior, identified.problem), p, robot
    )
    return q, C, (C @ torch.linalg.solve(precision, C.mT)).diagonal(), prior


def without_offsets(identified: StructuredFit, C: Tensor) -> tuple[Tensor, Tensor]:
    """Variance of the mean inertia given no offset of a torque, and its change between the two estimates."""
    reader = _Reader.of(identified, 0)
    drawn = identified.force_samples(4000, torch.Generator().manual_seed(1))
    assert isinstance(drawn, ForceSamples)
    c = reader._offsets(reader._curves(drawn))[1:]
    M, c = reader._constants(drawn, InertialPrior)[1:] @ C.mT, c - c.mean(0)
    M = M - M.mean(0)
    gain, b = torch.linalg.lstsq(c, M).solution, reader._disagreement()
    curve, inertia = b[:, : -C.shape[-1]].unflatten(1, reader.speeds.shape), b[0, -C.shape[-1] :]
    return (M - c @ gain).var(0), C @ inertia - (reader._offsets(curve) @ gain)[0]


def mean_inertia(robots: list[forcegp.RobotModel], q: Tensor) -> Tensor:
    return torch.stack([mass_matrix(x, q).diagonal(dim1=-2, dim2=-1).mean(0) for x in robots])


def test_errors_of_gains_widen_the_inertia_by_their_effect_on_its_identification(
    fit: StructuredFit, identified: StructuredFit
) -> None:
    """σ² of M_jj grows by s² Σ_k (∂M_jj/∂g_k)² with s = 1 %; 5 % reaches the limits of physical bodies."""
    q, C, known, prior = inertia_of(identified)
    unit = C / prior.scale(identified.specified.robot)
    added = (0.01 * unit @ torch.tensor(prior.per_gain, dtype=torch.float64)).square().sum(-1)
    M = mean_inertia(sampled_robots(identified, 400, gain_std=0.01), q)
    torch.testing.assert_close(M.std(0), (known + added).sqrt(), rtol=0.15, atol=0.0)
    assert bool((added > 3.0 * known).all()), "a gain is the larger error here"
    with pytest.raises(ModelError, match="gains on the inertia is unknown"):
        calibrated(fit, gain_std=0.01)


def test_drives_that_would_be_negative_leave_the_inertia_of_the_joint_as_it_was_measured(
    identified: StructuredFit,
) -> None:
    """Torques tell the sum of link and drive in joint 1 to 0.1 %, and hardly its parts.

    A robot file has no offset of a torque, and the robots are those given that there is none.
    """
    q, C, _, _ = inertia_of(identified)
    known, change = without_offsets(identified, C)
    robots = sampled_robots(identified, 400)
    drives = torch.stack([robot.armature for robot in robots])
    assert float(drives.min()) == 0.0 and float((drives[:, 0] == 0.0).double().mean()) > 0.3
    M, exact = mean_inertia(robots, q), mean_inertia([identified.system.robot], q)[0]
    half = 0.5 * C @ _Reader.of(identified, 0)._disagreement()[0, -C.shape[-1] :]
    expected = (known + 0.25 * change.square()).sqrt()
    assert bool((0.8 * expected < M.std(0)).all() and (M.std(0) < 1.5 * expected).all())
    assert bool(((M.mean(0) - (exact - half)).abs() < 0.5 * expected).all())


def test_the_robot_lies_halfway_between_identification_and_posterior(identified: StructuredFit) -> None:
    q, C, known, _ = inertia_of(identified)
    half = 0.5 * C @ _Reader.of(identified, 0)._disagreement()[0, -C.shape[-1] :]
    exact, found = mean_inertia([identified.system.robot, calibrated(identified).robot], q)
    torch.testing.assert_close(exact - found, half, rtol=0.3, atol=0.1 * float(known.sqrt().min()))


def test_each_sampled_robot_explains_another_motion_nearly_as_well(identified: StructuredFit) -> None:
    """Torques of another log of the true robot, which has no friction and no noise here."""
    file = identified.specified.robot
    other = log(file.replace(mass=1.3 * file.mass, com=0.9 * file.com), 400, seed=3)

    def error(robot: forcegp.RobotModel) -> Tensor:
        tau = inverse_dynamics(robot, other.q, other.qd, other.qdd)
        tau = tau + robot.damping * other.qd + robot.friction * other.qd.sign()
        return (tau - other.tau).square().mean(0).sqrt()

    mean = error(calibrated(identified).robot)
    errors = torch.stack([error(robot) for robot in sampled_robots(identified, 100)])
    assert bool((errors.max(0).values < 1.5 * mean).all())


def test_samples_are_spread_by_the_difference_between_identification_and_posterior(
    fit: StructuredFit, identified: StructuredFit
) -> None:
    """Functions drawn from the joint posterior have its mean δ; the identified robot has δ = 0: b = −E δ."""
    reader = _Reader.of(identified, 0)
    b, (_, C, _, prior) = reader._disagreement()[0], inertia_of(identified)
    p, generator = identified.force_priors.index(prior), torch.Generator().manual_seed(5)
    priors = tuple(
        dataclasses.replace(x, is_error=False) if x is prior else x for x in identified.force_priors
    )
    joint_problem = dataclasses.replace(identified.problem, priors=priors)
    drawn = draw_samples(force_posterior(joint_problem, identified.hyperparameters), 4000, generator)
    one = {name: x[:1] for name, x in reader._features(p).items()}
    delta = drawn.functions.latent(p, one)[:, 0]
    count = C.shape[-1]
    assert bool(((b[-count:] + delta.mean(0)).abs() < 5.0 * delta.std(0) / 4000**0.5).all())
    # Friction of the samples moves with the inertia, from the mean at δ = E δ to that at δ = 0.
    curves = reader._curves(drawn)
    moved = b[: curves[0].numel()].view_as(curves[0])
    joint = next(k for k, x in enumerate(identified.force_priors) if isinstance(x, JointFrictionPrior))
    latent = drawn.functions.latent(joint, reader._features(joint)).mean(0)
    E = identified.force_priors[joint].operator(identified.system, reader.at)
    force = reader._over_poses(torch.einsum("nij,nj->ni", E, latent))
    known = reader._over_poses(damping_force(identified.system.robot, reader.at.qd))
    error = (known + force + moved - curves[0]).abs()
    assert bool((error < 5.0 * curves[1:].std(0) / 4000**0.5 + 1e-9).all())
    assert float(b.norm()) > 0.0 and not _Reader.of(fit, 0)._disagreement().any()


def test_drives_of_an_identified_robot_are_unknown_with_its_links(identified: StructuredFit) -> None:
    """Joint 1 of the pendulum turns about a fixed axis: torque tells the sum of link and drive."""
    robot = identified.specified.robot
    limits = Limits.of(robot, velocity=[3.0], acceleration=[10.0], torque=[50.0])
    before = Unknowns.of(robot, limits.low, limits.high, limits.velocity, random_states(robot, limits, 40))
    known = unknowns_after(identified, before)
    drive = known.root[known.parts["drives"]].norm(dim=-1)[0]
    still = torch.zeros(2, 2, dtype=torch.float64)
    Phi = known.columns(still, still, torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=torch.float64))[1][:, 0]
    both = ((Phi[1] - Phi[0]) @ known.root).norm()
    assert 0.0 < float(both) < 0.3 * float(drive)


def test_simulate_with_a_model_names_it_in_the_log(fit: StructuredFit, tmp_path: Path) -> None:
    fit.save(tmp_path / "model")
    scene, out = tmp_path / "arm.toml", tmp_path / "run.parquet"
    motion = log_of(fit.system.robot, 20, 1)
    motion.write(tmp_path / "motion.parquet")
    scene.write_text('[robot]\nmodel = "double_pendulum"\n[simulation]\ndt = 0.01\n')
    command = ["simulate", "-s", str(scene), "-m", str(tmp_path / "model"), "-o", str(out)]
    said = CliRunner().invoke(app, [*command, "--motion", str(tmp_path / "motion.parquet")])
    assert said.exit_code == 0, said.output
    run = forcegp.Dataset.read(out)
    assert "learned forces" in run.header.provenance[0]
    # Torque and acceleration of the simulated arm are those of the fit.
    predicted = fit.predict(run.q, run.qd, run.tau, "qdd_free").mean
    assert float((predicted - run.qdd_clean).abs().max()) < 0.05 * float(predicted.abs().max())
    with pytest.raises(ParameterError, match="--sample needs a model"):
        CliRunner().invoke(
            app, ["simulate", "-s", str(scene), "--sample", "-o", str(out)], catch_exceptions=False
        )


def test_mjcf_holds_the_memory_of_friction(tmp_path: Path) -> None:
    """Dahl's friction of 1.6 N m over 0.04 rad. Under the same torques, MuJoCo moves with the written file as
    the equations of motion do, which it does not with d q̇ + f sign q̇."""
    robot = forcegp.load_robot("double_pendulum")
    robot = robot.replace(damping=0.0 * robot.mass, friction=0.0 * robot.mass)
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot), "analytical", [JointFrictionPrior(), BristlePrior()]
    )
    fit = model.fit(log(robot, memory=0.04))
    spec = mujoco.MjSpec.from_string(write_urdf(robot))
    spec.option.timestep = 0.0005
    spec.compile()
    files = {name: tmp_path / f"{name}.xml" for name in ("file", "plain", "memory")}
    files["file"].write_text(spec.to_xml())
    write_robot(calibrated(fit).robot, files["file"], files["plain"])
    found = write_calibrated(fit, files["file"], files["memory"], samples=2)
    for p in found.parameters:
        true = {"damping": 0.3, "friction": 1.6, "bristle": 40.0}.get(p.name)
        assert true is None or (p.determined and abs(p.estimate - true) < 3.0 * p.std + 0.01 * true), p
    report = json.loads((tmp_path / "memory.report.json").read_text())
    for pair in report["dry_friction"].values():
        assert pair["static"] == pair["dynamic"]  # Dahl's friction does not fall with the speed
        assert abs(pair["dynamic"]["value"] - 1.6) < 3.0 * pair["dynamic"]["std"] < 0.3
    assert sampled_robots(fit, 1)[0].bristle is None
    drawn = [forcegp.load_robot(path) for path in sorted(tmp_path.glob("memory.sample_*.xml"))]
    stiffness = torch.stack([each.bristle for each in drawn if each.bristle is not None])
    bristles = [p for p in found.parameters if p.name == "bristle"]
    estimate, std = (stiffness.new_tensor([getattr(p, x) for p in bristles]) for x in ("estimate", "std"))
    assert stiffness.shape == (2, 2) and not torch.equal(stiffness[0], stiffness[1])
    assert bool(((stiffness - estimate).abs() < 4.0 * std).all())

    def torque(t: float) -> np.ndarray:
        return np.array([5.0 * np.sin(5.0 * t), 3.0 * np.sin(7.0 * t)])

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        q, v, z = torch.from_numpy(x).view(3, 2)
        tau = torch.from_numpy(torque(t)) - 0.3 * v - 1.6 * z
        return torch.cat([v, forward_dynamics(robot, q, v, tau), (v - v.abs() * z) / 0.04]).numpy()

    solved = solve_ivp(slope, (0.0, 1.0), np.zeros(6), rtol=1e-8, atol=1e-9, max_step=1e-3)
    errors = {}
    for name in ("plain", "memory"):
        engine = mujoco.MjModel.from_xml_path(str(files[name]))
        engine.opt.gravity[:], data = robot.gravity.numpy(), mujoco.MjData(engine)
        while data.time < 1.0 - 1e-9:
            data.qfrc_applied[:] = torque(data.time)
            mujoco.mj_step(engine, data)
        errors[name] = np.abs(data.qpos - solved.y[:2, -1]).max()
    assert np.abs(solved.y[:2]).max() > 0.2
    assert errors["memory"] < 0.3 * errors["plain"] and errors["memory"] < 0.02
