"""Error bars beyond the trained region: distance, growth learned from regimes, joints that contact hides."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp import dynamics, kinematics
from forcegp.cli.common import warn_beyond
from forcegp.forces.posterior import GROWTH, RELATIVE, distance_beyond, trained_region
from forcegp.forces.term import NEAR_REST
from forcegp.models.structured_fit import StructuredFit

LEG = """<robot name="leg">
  <link name="root"/>
  <joint name="slider" type="prismatic"><parent link="root"/><child link="base"/><axis xyz="0 0 1"/>
    <limit effort="100" lower="-1" upper="1" velocity="10"/></joint>
  <link name="base"><inertial><mass value="0.5"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hip" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <link name="upper"><inertial><origin xyz="0 0 -0.08"/><mass value="0.15"/>
    <inertia ixx="0.0004" iyy="0.0004" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="knee" type="continuous"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 -0.16"/></joint>
  <link name="lower"><inertial><origin xyz="0 0 -0.08"/><mass value="0.03"/>
    <inertia ixx="0.0001" iyy="0.0001" izz="0.00001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="sole" type="fixed"><parent link="lower"/><child link="foot"/>
    <origin xyz="0 0 -0.16"/></joint>
  <link name="foot"/>
</robot>
"""
SLIDER, DRY, VISCOUS = 2.0, 0.05, 0.02
"""Dry friction of the slider [N]; dry and viscous friction of the joints [N m, N m s]."""


def test_distance_from_the_trained_region() -> None:
    x = torch.linspace(-1.0, 1.0, 2001, dtype=torch.float64)
    qd = torch.stack([x, torch.zeros_like(x)], -1)
    tau = torch.stack([10.0 + 2.0 * x, torch.zeros_like(x)], -1)
    region = trained_region(qd, tau, torch.tensor([20.0, 1.0], dtype=torch.float64))
    at = torch.tensor([[0.5, 0.0], [2.0, 0.0], [0.0, 0.2]], dtype=torch.float64)
    torque = torch.tensor([[11.0, 0.0], [-5.0, 0.0], [10.0, 0.0]], dtype=torch.float64)
    found = distance_beyond(region, at, torque)
    speed, load = (2.0 - 0.98) * math.sqrt(3.0), (15.0 - 1.96) * math.sqrt(3.0) / 2.0
    expected = torch.tensor([[0.0, 0.0], [math.hypot(speed, load), 0.0], [0.0, 0.2 / NEAR_REST]]).double()
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=0.0)
    assert not distance_beyond({}, at, torque).any()


def swing(robot: forcegp.RobotModel, n: int, speed: float, drag: float, seed: int) -> forcegp.Dataset:
    """A double pendulum with friction, and drag −drag |q̇| q̇ that no default prior has."""
    generator = torch.Generator().manual_seed(seed)
    t = 0.01 * torch.arange(n, dtype=torch.float64)
    w = 1.0 + 3.0 * torch.rand(3, 2, generator=generator, dtype=torch.float64)
    # The amplitude comes and goes, so that the log has calm and lively parts.
    size = speed * (0.15 + 0.85 * torch.sin(0.5 * t) ** 2)[:, None, None]
    angle = w * t[:, None, None] + 6.3 * torch.rand(3, 2, generator=generator, dtype=torch.float64)
    qd, qdd = (size * torch.sin(angle)).sum(1), (size * w * torch.cos(angle)).sum(1)
    q = 0.01 * qd.cumsum(0)
    noise = 0.05 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    friction = 0.3 * torch.tanh(qd / 0.02) + 0.2 * qd + drag * qd.abs() * qd
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd) + friction + noise
    return forcegp.Dataset(t=t, q=q, qd=qd, qdd=qdd, tau=tau, joint_names=robot.joint_names)


@pytest.fixture(scope="module")
def pendulum() -> forcegp.RobotModel:
    robot = forcegp.load_robot("double_pendulum")
    return robot.replace(damping=torch.zeros_like(robot.damping), friction=torch.zeros_like(robot.friction))


def fitted(robot: forcegp.RobotModel, drag: float) -> StructuredFit:
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical", noise=0.01)
    return model.fit(swing(robot, 600, 0.5, drag, 0))


def test_growth_is_learned_from_regimes(
    pendulum: forcegp.RobotModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where fast motion was worse predicted than noise allows, faster motion is less certain."""
    dragged, exact = fitted(pendulum, 3.0), fitted(pendulum, 0.0)
    growth = [fit.hyperparameters[GROWTH] / fit.problem.typical_load() for fit in (dragged, exact)]
    assert bool((growth[0] > 1.5 * growth[1]).all()) and bool((growth[1] < 0.5 * RELATIVE).all())
    test = swing(pendulum, 400, 2.0, 3.0, 1)
    found = dragged.predict(test.q, test.qd, test.tau, "total_force", noise=True)
    M = dynamics.mass_matrix(dragged.system.robot, test.q)
    error = ((M @ test.qdd[..., None])[..., 0] - found.mean).abs()
    assert float((error <= 2.0 * found.std).double().mean()) > 0.8

    assert found.beyond is not None and float(found.beyond.max()) > 3.0
    (warning,) = found.warnings
    assert "of 400 states lie beyond the trained speeds and torques" in warning and "train on" in warning
    warn_beyond(dragged, test)
    assert " ".join(capsys.readouterr().err.split()) == f"warning: {warning}"
    inside = swing(pendulum, 600, 0.5, 3.0, 0)
    assert not dragged.predict(inside.q, inside.qd, inside.tau, covariance=False).warnings

    dragged.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model").predict(
        test.q, test.qd, test.tau, "total_force", noise=True
    )
    assert torch.equal(again.beyond, found.beyond) and again.warnings == found.warnings
    torch.testing.assert_close(again.std, found.std, rtol=1e-9, atol=0.0)


def test_the_region_stays_where_noise_is_not_learned_again(pendulum: forcegp.RobotModel) -> None:
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(pendulum), "analytical", noise=0.01)
    data = swing(pendulum, 200, 0.5, 0.0, 0)
    first = model.fit(data)
    second = model.fit(data, learn=["joint_friction"], after=first)
    assert torch.equal(first.hyperparameters[GROWTH], second.hyperparameters[GROWTH])


def leg(folder: Path) -> forcegp.ConstrainedSystem:
    path = folder / "leg.urdf"
    path.write_text(LEG, encoding="utf-8")
    ground = forcegp.Plane(normal=(0.0, 0.0, 1.0), offset=0.0)
    sole = forcegp.SurfaceContact("ground", frame="foot", point=(0.0, 0.0, 0.0), surface=ground)
    return forcegp.ConstrainedSystem(forcegp.load_robot(path), [sole])


def squats(
    system: forcegp.ConstrainedSystem, n: int, size: float, rate: float
) -> tuple[forcegp.Dataset, Tensor]:
    """A leg that stands and squats without force sensor, and the true normal force."""
    generator, robot = torch.Generator().manual_seed(n), system.robot
    t = 0.005 * torch.arange(n, dtype=torch.float64)
    wave = [size * rate**k * torch.sin(rate * t + k * math.pi / 2) for k in range(3)]
    # The foot stays below the hip: the knee bends twice as far, and the slider follows the foot.
    bend = torch.tensor([0.0, 1.0, -2.0], dtype=torch.float64)
    q = wave[0][:, None] * bend + torch.tensor([0.0, 0.8, -1.6], dtype=torch.float64)
    qd, qdd = wave[1][:, None] * bend, wave[2][:, None] * bend
    q[:, 0] -= kinematics.frame_pose(robot, q, "foot")[1][:, 2]
    active = torch.ones(n, 1, dtype=torch.bool)
    A = system.equations(q, qd, active).A[:, 0]
    qd[:, 0] = -(A[:, 1:] * qd[:, 1:]).sum(-1) / A[:, 0]
    eom = system.equations(q, qd, active)
    qdd[:, 0] = (eom.b[:, 0] - (A[:, 1:] * qdd[:, 1:]).sum(-1)) / A[:, 0]
    friction = DRY * torch.tanh(qd / 0.02) + VISCOUS * qd
    friction[:, 0] = SLIDER * torch.tanh(qd[:, 0] / 0.005)
    force = dynamics.inverse_dynamics(robot, q, qd, qdd) + friction
    multiplier = force[:, 0] / A[:, 0]
    tau = force - A * multiplier[:, None]
    tau[:, 1:] += 0.003 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    noise = torch.tensor([0.3, 0.3, 0.3]) * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    data = forcegp.Dataset(
        t=t,
        q=q,
        qd=qd,
        qdd=qdd + noise,
        tau=tau,
        joint_names=robot.joint_names,
        contact={"ground": active[:, 0]},
    )
    return data, multiplier


def coverage(fit: StructuredFit, data: forcegp.Dataset, force: Tensor) -> float:
    found = fit.predict(data.q, data.qd, data.tau, "multiplier", noise=True)
    return float(((found.mean[:, 0] - force).abs() <= 2.0 * found.std[:, 0]).double().mean())


GANTRY = """<robot name="gantry">
  <link name="root"/>
  <joint name="x" type="prismatic"><parent link="root"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit effort="100" lower="-1" upper="1" velocity="10"/></joint>
  <link name="cart"><inertial><mass value="3"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="z" type="prismatic"><parent link="cart"/><child link="tool"/><axis xyz="0 0 1"/>
    <limit effort="100" lower="-1" upper="1" velocity="10"/></joint>
  <link name="tool"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""


@pytest.mark.parametrize(("free", "widest"), [(0, 6.0), (100, 6.0), (1000, 1.0)])
def test_friction_that_contact_hides_has_its_stated_size(tmp_path: Path, free: int, widest: float) -> None:
    """The table holds any force of the vertical axis, whose friction only samples in free motion show."""
    path, slope = tmp_path / "gantry.urdf", -math.tan(0.2)
    path.write_text(GANTRY, encoding="utf-8")
    table = forcegp.Plane(normal=(math.sin(0.2), 0.0, math.cos(0.2)), offset=0.0)
    contact = forcegp.SurfaceContact("table", frame="tool", point=(0.0, 0.0, 0.0), surface=table)
    system = forcegp.ConstrainedSystem(forcegp.load_robot(path), [contact])
    n, generator = 2000, torch.Generator().manual_seed(0)
    t = 0.005 * torch.arange(n, dtype=torch.float64)
    rates, sizes = torch.tensor([1.3, 3.1]).double(), torch.tensor([0.3, 0.1]).double()
    waves = [sizes * rates**k * torch.sin(rates * t[:, None] + k * math.pi / 2) for k in range(3)]
    q, qd, qdd = (torch.stack([x.sum(-1), slope * x.sum(-1)], -1) for x in waves)
    closed = torch.arange(n) >= free
    for k, x in enumerate((q, qd, qdd)):
        lift = 0.05 * 5.0**k * torch.sin(5.0 * t + k * math.pi / 2) + (0.06 if k == 0 else 0.0)
        x[:, 1] += torch.where(closed, 0.0, lift)
    force = torch.where(closed, 30.0 + 5.0 * torch.sin(2.0 * t), 0.0)
    friction = torch.tensor([2.0, 3.0]) * torch.tanh(qd / 0.01) + torch.tensor([3.0, 5.0]) * qd
    tau = dynamics.inverse_dynamics(system.robot, q, qd, qdd) + friction
    tau = tau - system.equations(q, qd, closed[:, None]).A[:, 0] * force[:, None]
    noise = 0.05 * torch.randn(2, n, 2, generator=generator, dtype=torch.float64)
    names, contacts = system.robot.joint_names, {"table": closed}
    data = forcegp.Dataset(t, q, qd, tau + noise[0], qdd + noise[1], names, contact=contacts)
    fit = forcegp.StructuredGP(system).fit(data)
    at = data[closed]
    found = fit.predict(at.q, at.qd, at.tau, "multiplier", noise=True)
    error = (found.mean[:, 0] - force[closed]).abs()
    assert float((error <= 2.0 * found.std[:, 0]).double().mean()) > 0.9
    assert float(found.std.median()) < widest


@pytest.mark.slow
def test_a_joint_that_contact_hides_is_not_trusted(tmp_path: Path) -> None:
    """All that the knee does wrong acts along the normal, where no acceleration shows it."""
    system = leg(tmp_path)
    train, force = squats(system, 400, 0.1, 3.0)
    fit = forcegp.StructuredGP(system, "analytical").fit(train)
    assert coverage(fit, train, force) > 0.9
    test, force = squats(system, 200, 0.3, 9.0)
    assert coverage(fit, test, force) > 0.8
    assert "(slider)" in fit.predict(test.q, test.qd, test.tau).warnings[0]
