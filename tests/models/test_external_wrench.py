"""Pushes that MuJoCo applies, found by a fit to free motion: error, coverage, detection, and the command."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import lfilter
from typer.testing import CliRunner

import forcegp
from benchmarks.classical_wrench import momentum_residual, quasi_static, wrench_of
from forcegp.cli import app
from forcegp.errors import DataError, ModelError, UnknownNameError
from forcegp.forces.external_wrench import WrenchFrame
from forcegp.forces.priors.sets import friction_priors
from forcegp.models.external_wrench import ExternalWrench, false_alarm_rate
from forcegp.models.structured_fit import StructuredFit
from forcegp.simulate.urdf import write_urdf

mujoco = pytest.importorskip("mujoco")

STEP, PERIOD = 0.001, 0.01
QDD_NOISE, QD_NOISE = 0.05, 1e-3
DAMPING = np.array([4.0, 4.0, 3.0, 1.0, 0.8, 0.5])
TOOL = "tool"
HOME = np.array([0.0, -1.2, 1.6, -1.9, -1.57, 0.0])


def simulated(seconds: float, seed: int, pushed: bool) -> tuple[forcegp.Dataset, torch.Tensor]:
    """A UR5 with viscous friction in slow motion, pushed at the tool for the second half of every two
    seconds; and the wrench on the tool (force, moment), world axes."""
    robot = forcegp.load_robot("ur5")
    random = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(write_urdf(robot))
    model.opt.timestep, model.opt.gravity[:] = STEP, robot.gravity.numpy()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, known = mujoco.MjData(model), mujoco.MjData(model)
    body, index = model.nbody - 1, robot.frame_index(TOOL)
    w, phase = random.uniform(1.0, 3.0, (3, 6)), random.uniform(0.0, 6.0, (3, 6))
    rows, truth, force = [], [], np.zeros(3)
    for k in range(round(seconds / STEP)):
        t = k * STEP
        q = HOME + 0.2 * np.sin(w * t + phase).sum(0)
        qd, qdd = 0.2 * (w * np.cos(w * t + phase)).sum(0), -0.2 * (w**2 * np.sin(w * t + phase)).sum(0)
        if k == 0:
            data.qpos[:], data.qvel[:] = q, qd
        if k % round(1.0 / STEP) == 0:
            force = random.uniform(-30.0, 30.0, 3) if pushed and round(t) % 2 else np.zeros(3)
        known.qpos[:], known.qvel[:] = q, qd
        known.qacc[:] = qdd + 100.0 * (q - data.qpos) + 20.0 * (qd - data.qvel)
        mujoco.mj_inverse(model, known)
        tau = known.qfrc_inverse.copy()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        tool = data.xpos[body] + data.xmat[body].reshape(3, 3) @ robot.frame_position[index].numpy()
        arm = tool - data.xipos[body]
        data.xfrc_applied[body] = np.concatenate([force, np.cross(arm, force)])
        data.qfrc_applied[:] = tau - DAMPING * data.qvel
        mujoco.mj_forward(model, data)
        if k % round(PERIOD / STEP) == 0:
            noise = random.normal(size=(3, 6))
            speed, qacc = data.qvel + QD_NOISE * noise[0], data.qacc + QDD_NOISE * noise[1]
            rows.append([t, *data.qpos, *speed, *(tau + 0.1 * noise[2]), *qacc])
            truth.append([*force, 0.0, 0.0, 0.0])
        mujoco.mj_step(model, data)
    x = torch.tensor(np.array(rows))
    return forcegp.Dataset(x[:, 0], *x[:, 1:].split(6, dim=1), robot.joint_names), torch.tensor(truth)


@cache
def fitted() -> StructuredFit:
    """Trained on free motion."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("ur5"))
    model = forcegp.StructuredGP(system, "analytical", friction_priors(system), noise=QDD_NOISE)
    return model.fit(simulated(12.0, 0, pushed=False)[0])


@cache
def pushed() -> tuple[forcegp.Dataset, torch.Tensor]:
    return simulated(16.0, 1, pushed=True)


@pytest.mark.parametrize("method", ["acceleration", "momentum"])
def test_pushes_are_estimated_with_bars_that_cover_them(method: str) -> None:
    data, truth = pushed()
    wrench = fitted().external_wrench(data, TOOL, method=method)
    # The filter follows a step within some tenths of a second.
    late = (data.t % 1.0) > 0.5
    error = (wrench.mean - truth)[late]
    frame = WrenchFrame(TOOL)
    file = quasi_static(fitted().specified.robot, data, frame)[late] - truth[late]
    rmse, rmse_file = (float(e[:, :3].square().sum(-1).mean().sqrt()) for e in (error, file))
    assert rmse < 2.0
    assert rmse < 0.5 * rmse_file
    assert wrench.std is not None
    covered = (error.abs() <= 2.0 * wrench.std[late]).double().mean(0)
    assert bool((covered > 0.9).all()), covered


def test_the_wrench_turns_with_its_axes() -> None:
    data, _ = pushed()
    R, _ = forcegp.kinematics.frame_pose(fitted().system.robot, data.q, TOOL)
    world, local = (fitted().external_wrench(data, TOOL, reference=r) for r in ("world", "local"))
    turned = (R @ local.mean[:, :3, None])[..., 0]
    torch.testing.assert_close(turned, world.mean[:, :3], rtol=1e-6, atol=1e-6)
    forces = fitted().external_wrench(data, TOOL, axes=("fx", "fy", "fz"))
    assert forces.mean.shape == (len(data), 3)
    # Knowing that there is no moment makes the force more certain.
    assert bool((forces.std <= world.std[:, :3] + 1e-9).all())


def test_a_torque_that_clips_is_not_trusted() -> None:
    """With the third torque wrong by 40 N m and said to be unknown, the other five still find the force."""
    data, truth = pushed()
    off = torch.tensor([0.0, 0.0, 40.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    wrong = data.replace(tau=data.tau + off)
    stated = wrong.replace(extras={**data.extras, "tau_std": off.expand_as(data.tau)})
    error, doubted = (fitted().external_wrench(log, TOOL).mean - truth for log in (wrong, stated))
    assert float(doubted[:, :3].norm(dim=-1).mean()) < 0.25 * float(error[:, :3].norm(dim=-1).mean())
    found = fitted().external_wrench(stated, TOOL)
    assert found.std is not None
    assert float(((found.mean - truth).abs() <= 2.0 * found.std).double().mean()) > 0.9


def test_contacts_are_detected_without_false_alarms() -> None:
    data, truth = pushed()
    found = fitted().external_wrench(data, TOOL).detect()
    touched = truth[:, :3].norm(dim=-1) > 10.0
    assert float(found[touched].double().mean()) > 0.95
    free, _ = simulated(20.0, 2, pushed=False)
    assert not bool(fitted().external_wrench(free, TOOL).detect(hold=2).any())


def test_detection_keeps_its_false_alarm_rate() -> None:
    # Of an estimate without a wrench, with as good as no prior, d² is χ² with k degrees of freedom.
    generator = torch.Generator().manual_seed(0)
    mean = torch.randn(20_000, 3, dtype=torch.float64, generator=generator)
    wrench = ExternalWrench(mean, torch.eye(3, dtype=torch.float64).expand(20_000, 3, 3))
    assert float(wrench.detect(2.0).double().mean()) == pytest.approx(false_alarm_rate(2.0), rel=0.1)


def test_a_limit_from_free_motion_keeps_lasting_errors_from_being_contacts() -> None:
    """Errors that last 0.1 s, with heavier tails than their covariance says: a limit read off one minute
    bounds the false alarms of ten, of which the threshold for Gaussian errors has many."""
    generator = torch.Generator().manual_seed(0)
    t = 0.004 * torch.arange(150_000, dtype=torch.float64)
    keep = math.exp(-0.04)
    steps = torch.randn(len(t), 6, generator=generator, dtype=torch.float64).numpy()
    errors = torch.from_numpy(lfilter([(1.0 - keep**2) ** 0.5], [1.0, -keep], steps, axis=0))
    # A scale that changes slowly makes the tails heavy.
    scale = 1.0 + 0.7 * torch.sin(0.5 * t).square()
    covariance = torch.eye(6, dtype=torch.float64).expand(len(t), 6, 6)
    free = ExternalWrench(scale[:, None] * errors, covariance)
    minute = ExternalWrench(free.mean[:15_000], covariance[:15_000])
    limit = minute.exceeded_once_in(600.0, t[:15_000])

    def alarms(found: torch.Tensor) -> int:
        rows = found.nonzero()[:, 0]
        return int(len(rows) > 0) + int((rows.diff() > 125).sum())

    assert alarms(free.detect(limit=limit)) <= 4, "a Poisson variable of mean 1, at 4 of 1000"
    assert alarms(free.detect()) > 20
    with pytest.raises(DataError, match="free motion is too short"):
        minute.exceeded_once_in(600.0, t[:15_000] / 100.0)


def test_the_observer_without_learning_finds_a_push_of_a_frictionless_arm() -> None:
    robot = forcegp.load_robot("ur5")
    data, truth = pushed()
    losses = torch.from_numpy(DAMPING)
    residual = momentum_residual(robot, data, 20.0, lambda qd: losses * qd)
    found = wrench_of(WrenchFrame(TOOL).jacobian(robot, data.q), residual)
    late = (data.t % 1.0) > 0.5
    assert float((found - truth)[late, :3].abs().mean()) < 2.0


def test_damping_shortens_a_wrench() -> None:
    J = WrenchFrame(TOOL).jacobian(forcegp.load_robot("ur5"), torch.from_numpy(HOME)[None])
    force = torch.ones(1, 6, dtype=torch.float64)
    plain, damped = wrench_of(J, force), wrench_of(J, force, 0.2)
    torch.testing.assert_close((J.mT @ plain[..., None])[..., 0], force)
    assert float(damped.norm()) < float(plain.norm())


def test_errors() -> None:
    data, _ = pushed()
    with pytest.raises(UnknownNameError, match="frame"):
        fitted().external_wrench(data, "toool")
    with pytest.raises(UnknownNameError, match="method"):
        fitted().external_wrench(data, TOOL, method="static")
    with pytest.raises(DataError, match="in time order"):
        fitted().external_wrench(data[[3, 1, 2]], TOOL, method="momentum")
    plain = forcegp.StructuredGP(
        fitted().specified,
        "analytical",
        friction_priors(fitted().specified),
        noise=forcegp.Noise(0.05, torque=None),
    )
    with pytest.raises(ModelError, match="no learned torque noise"):
        plain.fit(data[:50], learn=[]).external_wrench(data, TOOL, method="momentum")


def test_by_command(tmp_path: Path) -> None:
    data, truth = pushed()
    names = {name: tmp_path / f"{name}.parquet" for name in ("data", "out")}
    data.write(names["data"])
    fitted().save(tmp_path / "model")
    files = ("-m", tmp_path / "model.safetensors", "-d", names["data"], "-o", names["out"])
    command = ["predict", *map(str, files), "-q", "external_wrench", "--json"]
    failed = CliRunner().invoke(app, command)
    assert "--frame" in str(failed.exception)
    done = CliRunner().invoke(app, [*command, "--frame", TOOL, "--momentum"])
    assert done.exit_code == 0, done.output
    assert 0.3 < json.loads(done.stdout)["detected"] < 0.7
    written = forcegp.Dataset.read(names["out"])
    late = (data.t % 1.0) > 0.5
    force = written.contact_extras["predicted_external_force"][TOOL]
    assert float((force - truth[:, :3])[late].square().sum(-1).mean().sqrt()) < 2.0
    assert bool((written.contact_extras["predicted_external_moment_std"][TOOL] > 0.0).all())
