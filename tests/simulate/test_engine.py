"""Engines obey our equations of motion, on the bundled arms and on trees with sliding joints."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp import ConstrainedSystem, Plane, SurfaceContact, dynamics
from forcegp.errors import InertiaError, UnknownNameError, UnsupportedRobotError
from forcegp.robot.model import RobotModel
from forcegp.simulate import Engine, SimulationConfig, check_engine, make_engine, simulate
from forcegp.simulate.engines import MAKERS as ENGINES
from forcegp.simulate.urdf import write_urdf
from robots import ARMS

FORCES = 1e-9
"""Inertias and forces of some hundreds, summed over tens of links in another order."""
ACCELERATIONS = 1e-6
"""Differences of joint speeds over one step of 1/240 s; what the task asks of a simulation."""
DT = 1.0 / 240.0
TREES = ("kuka_iiwa", "franka_panda", "double_pendulum", "tiago_dual", "z1")


def _robot(name: str) -> RobotModel:
    arm = next(arm for arm in ARMS if arm.name == name)
    robot = arm.load(base_position=(0.1, -0.2, 0.3), base_rpy=(0.3, -0.5, 0.7), gravity=(1.0, 2.0, -9.0))
    return robot.replace(armature=torch.zeros_like(robot.armature))


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> Iterator[Engine]:
    pytest.importorskip(request.param)
    with closing(make_engine(forcegp.load_robot("kuka_iiwa"), DT, request.param)) as made:
        yield made


@pytest.mark.parametrize("name", TREES)
@pytest.mark.parametrize("engine_name", ENGINES)
def test_mass_matrix_inverse_dynamics_and_accelerations_are_ours(engine_name: str, name: str) -> None:
    pytest.importorskip(engine_name)
    robot = _robot(name)
    contact = SurfaceContact("wall", robot.frame_names[-1], (0.0, 0.0, 0.1), Plane((1.0, 0.2, 0.3), 0.0))
    with closing(make_engine(robot, DT, engine_name)) as engine:
        report = check_engine(
            ConstrainedSystem(robot, [contact]), engine, torch.Generator().manual_seed(0), states=20
        )
    assert report.mass_matrix < FORCES
    assert report.inverse_dynamics < FORCES * 100
    scale = max(1.0, report.largest_acceleration)
    assert report.free_acceleration < ACCELERATIONS * scale
    assert report.constrained_acceleration < ACCELERATIONS * scale
    assert f"{report.mass_matrix:.1e}" in str(report) and engine_name in str(report)


def test_the_check_finds_a_wrong_mass() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    heavier = robot.replace(mass=robot.mass * 1.001)
    with closing(make_engine(robot, DT, "mujoco")) as engine:
        report = check_engine(ConstrainedSystem(heavier), engine, torch.Generator().manual_seed(0), states=5)
    assert report.mass_matrix > 1e-4 and report.inverse_dynamics > 1e-3 and report.free_acceleration > 1e-4


def test_a_step_is_semi_implicit_euler(engine: Engine) -> None:
    generator = torch.Generator().manual_seed(1)
    q, qd, force = torch.randn(3, 7, dtype=torch.float64, generator=generator)
    engine.reset(q, qd)
    torch.testing.assert_close(engine.state(), (q, qd), rtol=0.0, atol=0.0)
    engine.step(force)
    q_next, qd_next = engine.state()
    torch.testing.assert_close(q_next, q + DT * qd_next, rtol=0.0, atol=1e-14)
    assert engine.dt == pytest.approx(DT, abs=1e-15)


def test_force_and_speed_are_never_clamped(engine: Engine) -> None:
    q = torch.zeros(7, dtype=torch.float64)
    fast = torch.tensor([0.0, 0, 0, 0, 0, 0, 300.0], dtype=torch.float64)
    force = torch.full_like(q, 5e4)
    engine.reset(q, fast)
    engine.step(force)
    expected = dynamics.forward_dynamics(forcegp.load_robot("kuka_iiwa"), q, fast, force)
    torch.testing.assert_close((engine.state()[1] - fast) / DT, expected, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize("name", TREES)
def test_a_written_robot_reads_back_the_same(tmp_path: Path, name: str) -> None:
    robot = _robot(name)
    path = tmp_path / "robot.urdf"
    path.write_text(write_urdf(robot), encoding="utf-8")
    again = forcegp.load_robot(path, gravity=robot.gravity.tolist())
    order = [again.joint_names.index(joint) for joint in robot.joint_names]
    q = torch.randn(10, robot.nq, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    q_again = torch.empty_like(q)
    q_again[:, order] = q
    ours, theirs = dynamics.mass_matrix(robot, q), dynamics.mass_matrix(again, q_again)
    torch.testing.assert_close(ours, theirs[:, order][:, :, order], rtol=0.0, atol=FORCES)
    gravity = dynamics.gravity_force(again, q_again)[:, order]
    torch.testing.assert_close(dynamics.gravity_force(robot, q), gravity, rtol=0.0, atol=100 * FORCES)


def test_drive_inertia_is_mujocos_alone() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    geared = robot.replace(armature=torch.full_like(robot.armature, 0.3))
    with closing(make_engine(geared, DT, "mujoco")) as engine:
        report = check_engine(ConstrainedSystem(geared), engine, torch.Generator().manual_seed(0), states=5)
    assert max(report.mass_matrix, report.inverse_dynamics) < FORCES
    assert report.free_acceleration < ACCELERATIONS
    pytest.importorskip("pybullet")
    with pytest.raises(UnsupportedRobotError, match="lbr_iiwa_joint_1"):
        make_engine(geared, DT, "pybullet")


def test_impossible_inertia_is_an_error_that_names_the_link() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    inertia = robot.inertia.clone()
    inertia[2] = torch.diag(torch.tensor([0.1, 0.1, 0.3], dtype=torch.float64))  # 0.1 + 0.1 < 0.3
    system = ConstrainedSystem(robot.replace(inertia=inertia))
    for contact in ("rigid", "solver"):
        config = SimulationConfig(duration=0.1, engine="mujoco", contact=contact)
        with pytest.raises(InertiaError, match=f"link_of_{robot.joint_names[2]}.*\n.*<inertial>"):
            simulate(system, config)


def test_an_unknown_engine_is_named() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'mujoco'"):
        make_engine(forcegp.load_robot("kuka_iiwa"), DT, "mujoko")


def test_a_robot_that_one_engine_cannot_simulate_is_refused_or_simulated_by_the_other() -> None:
    """Bullet sets moments that violate the triangle inequality to zero, even by rounding."""
    pytest.importorskip("pybullet")
    robot = forcegp.load_robot("kuka_iiwa")
    geared = robot.replace(armature=torch.full_like(robot.armature, 0.3))
    with closing(make_engine(geared, DT, "auto")) as engine:
        assert engine.name.startswith("mujoco")
    inertia = robot.inertia.clone()
    inertia[5] = torch.diag(torch.tensor([0.1, 0.1, 0.201], dtype=torch.float64))
    for name in ("auto", *ENGINES):
        with pytest.raises(InertiaError, match=robot.joint_names[5]):
            make_engine(robot.replace(inertia=inertia), DT, name)


@pytest.mark.parametrize("engine_name", ENGINES)
def test_a_thin_plate_is_simulated_in_any_orientation(engine_name: str) -> None:
    """Moments (a, b, a + b) in turned axes obey the triangle inequality only up to rounding."""
    pytest.importorskip(engine_name)
    robot = forcegp.load_robot("kuka_iiwa")
    generator = torch.Generator().manual_seed(2)
    axes = torch.linalg.qr(torch.randn(7, 3, 3, dtype=torch.float64, generator=generator))[0]
    moments = torch.tensor([[0.02, 0.02, 0.04], [0.01, 0.02, 0.03]], dtype=torch.float64).repeat(4, 1)[:7]
    inertia = axes @ torch.diag_embed(moments) @ axes.mT
    flat = robot.replace(inertia=0.5 * (inertia + inertia.mT))
    with closing(make_engine(flat, DT, engine_name)) as engine:
        report = check_engine(ConstrainedSystem(flat), engine, torch.Generator().manual_seed(0), states=5)
    assert report.mass_matrix < FORCES


def test_an_engine_with_another_robot_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever an engine makes of a file, its dynamics are compared with the robot before it is used."""
    robot = forcegp.load_robot("kuka_iiwa")
    heavier = robot.replace(mass=robot.mass * torch.tensor([1.0] * 6 + [1.001], dtype=torch.float64))
    monkeypatch.setattr("forcegp.simulate.engines.write_urdf", lambda _: write_urdf(heavier))
    with pytest.raises(UnsupportedRobotError, match=r"simulates a different robot(.|\n)*relative"):
        make_engine(robot, DT, "mujoco")
