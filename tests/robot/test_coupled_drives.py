"""Drives that move with several joints, against MuJoCo, whose fixed tendons have the same physics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import forcegp
from forcegp.compiled import compile_dynamics
from forcegp.errors import MappingError, ParameterError, ShapeError, UnknownNameError, UnsupportedRobotError
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.identification import identify, parameter_vector, regressor
from forcegp.logs.mapping import parse_mapping
from forcegp.models.calibrated import write_calibrated

mujoco = pytest.importorskip("mujoco")

ARM = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body pos="0 0 .5"><joint name="a" axis="0 1 0"/><inertial pos="0 0 .2" mass="1.5" diaginertia=".02 .02 .01"/>
<body pos="0 0 .4"><joint name="b" axis="0 1 0"/><inertial pos="0 0 .1" mass=".8" diaginertia=".01 .01 .004"/>
<body pos="0 0 .2"><joint name="c" axis="0 0 1"/>
<inertial pos=".03 0 .05" mass=".4" diaginertia=".003 .003 .002"/>
</body></body></body></worldbody>{tendon}</mujoco>"""
INERTIA, VISCOUS, DRY = 0.03, 0.2, 0.4
TENDON = f"""<tendon><fixed armature="{INERTIA}" damping="{VISCOUS}" frictionloss="{{dry}}">
<joint joint="b" coef="1"/><joint joint="c" coef="1"/></fixed></tendon>"""
COUPLING = {"c": {"b": 1.0}}
"""The drive of joint c moves by q_c + q_b."""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The arm without its tendon."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM.format(tendon=""))
    return path


@pytest.fixture(scope="module")
def robot(path: Path) -> forcegp.RobotModel:
    """The arm whose last drive is coupled, with the tendon's inertia and viscous friction."""
    own = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    robot = forcegp.load_robot(path, coupling=COUPLING)
    return robot.replace(armature=INERTIA * own, damping=VISCOUS * own)


def engine(dry: float = DRY) -> Any:
    """MuJoCo's model of the arm with the tendon."""
    return mujoco.MjModel.from_xml_string(ARM.format(tendon=TENDON.format(dry=dry)))


def log(seconds: float, seed: int) -> forcegp.Dataset:
    """The arm with the tendon under feedback along sums of sines, with noise of torques and accelerations."""
    model, random = engine(), np.random.default_rng(seed)
    data, rows = mujoco.MjData(model), []
    size, w = random.uniform(0.2, 0.7, (4, 3)), random.uniform(0.5, 5.0, (4, 3))
    phase = random.uniform(0.0, 6.28, (4, 3))
    for k in range(round(1000 * seconds)):
        angle = w * k * 1e-3 + phase
        wanted, speed = (size * np.sin(angle)).sum(0), (size * w * np.cos(angle)).sum(0)
        if k == 0:
            data.qpos[:], data.qvel[:] = wanted, speed
        if k % 5 == 0:
            data.qfrc_applied[:] = [60.0, 30.0, 10.0] * (wanted - data.qpos) + 3.0 * (speed - data.qvel)
        mujoco.mj_step1(model, data)
        mujoco.mj_step2(model, data)
        if k % 5 == 2:
            mujoco.mj_forward(model, data)
            rows.append([data.qpos.copy(), data.qvel.copy(), data.qacc.copy(), data.qfrc_applied.copy()])
    q, qd, qdd, tau = torch.from_numpy(np.array(rows)).unbind(1)
    noise = torch.from_numpy(random.standard_normal((2, *q.shape)))
    t = 0.005 * torch.arange(len(q), dtype=torch.float64)
    return forcegp.Dataset(t, q, qd, tau + 0.02 * noise[0], qdd + 0.05 * noise[1], ("a", "b", "c"))


def test_inertia_and_damping_are_those_of_mujoco(robot: forcegp.RobotModel) -> None:
    """M, and M q̈ − Q_C − Q_G − Q_D, at random states; eager and compiled."""
    model, random = engine(dry=0.0), np.random.default_rng(0)
    data = mujoco.MjData(model)
    for _ in range(5):
        q, qd, qdd = random.standard_normal((3, 3))
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(model, data)
        M, needed = np.zeros((3, 3)), np.zeros(3)
        for unit, column in zip(np.eye(3), M, strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        needed = M @ qdd + data.qfrc_bias - data.qfrc_passive
        states = [torch.from_numpy(x) for x in (q, qd, qdd)]
        ours = forcegp.dynamics.inverse_dynamics(robot, *states)
        ours = ours - forcegp.dynamics.damping_force(robot, states[1])
        assert np.abs(forcegp.dynamics.mass_matrix(robot, states[0]).numpy() - M).max() < 1e-12
        assert np.abs(ours.numpy() - needed).max() < 1e-12
        back = forcegp.dynamics.forward_dynamics(robot, *states[:2], ours)
        friction = forcegp.dynamics.damping_force(robot, states[1])
        assert torch.allclose(
            forcegp.dynamics.forward_dynamics(robot, *states[:2], ours + friction), states[2], atol=1e-10
        )
        assert not torch.allclose(back, states[2])
    names = "mass_matrix", "inverse_dynamics", "forward_dynamics"
    mass_matrix, inverse, forward = (compile_dynamics(robot, name) for name in names)
    states = torch.randn(3, 50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(mass_matrix(states[0]), forcegp.dynamics.mass_matrix(robot, states[0]), atol=1e-12)
    needed = forcegp.dynamics.inverse_dynamics(robot, *states)
    assert torch.allclose(inverse(*states), needed, atol=1e-11)
    assert torch.allclose(forward(*states[:2], needed), states[2], atol=1e-9)
    by_columns = regressor(robot, *states) @ parameter_vector(robot) + states[2] @ robot.drive_inertia
    assert torch.allclose(by_columns, needed, atol=1e-11)


def test_a_fit_finds_friction_and_inertia_of_the_coupled_drive(path: Path, robot: forcegp.RobotModel) -> None:
    """Trained on MuJoCo's motion; another motion is predicted far better than with a drive per joint."""
    train, test = log(20.0, 0), log(6.0, 1)
    errors, fits = [], []
    for coupling in (None, COUPLING):
        system = forcegp.ConstrainedSystem(forcegp.load_robot(path, coupling=coupling))
        fit = forcegp.StructuredGP(system, "analytical").fit(train)
        mean = fit.predict(test.q, test.qd, test.tau).mean
        M = forcegp.dynamics.mass_matrix(robot, test.q)
        errors.append((M @ (mean - test.qdd)[..., None])[..., 0].square().mean(0).sqrt())
        fits.append(fit)
    assert (errors[1][1:] < 0.3 * errors[0][1:]).all(), errors
    assert errors[1].max() < 0.15  # of torques up to 10 N m; friction of MuJoCo's solver creeps
    fit = fits[1]
    a = fit.system.robot.armature
    assert a[2] == pytest.approx(INERTIA, rel=0.1)
    assert a[:2].max() < 0.1 * INERTIA
    speed = robot.drive_motion(test.qd)[:, 2]
    fast = speed.abs() > 0.3
    expected = -(VISCOUS * speed + DRY * speed.sign())[fast]
    force = fit.predict(test.q, test.qd, test.tau, "joint_friction").mean[fast]
    assert force[:, 0].abs().max() < 0.05
    for joint in (1, 2):
        assert (force[:, joint] - expected).square().mean().sqrt() < 0.04  # of up to 1.8 N m


def test_rollouts_slow_down_as_the_coupled_drive_does(path: Path) -> None:
    """Half a second without torque, from one state, in MuJoCo and by fits with and without the coupling."""
    model, errors = engine(), []
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.3, 0.4, -0.2], [0.0, 1.0, 3.0]
    q, qd = (torch.from_numpy(x.copy()) for x in (data.qpos, data.qvel))
    for _ in range(500):
        mujoco.mj_step(model, data)
    for coupling in (None, COUPLING):
        system = forcegp.ConstrainedSystem(forcegp.load_robot(path, coupling=coupling))
        fit = forcegp.StructuredGP(system, "analytical").fit(log(20.0, 0))
        rollout = fit.rollout(q, qd, lambda t, q, qd: torch.zeros_like(q), duration=0.5)
        errors.append(np.abs(rollout.q[-1].view(-1).numpy() - data.qpos).max())
    assert errors[1] < 0.06
    assert errors[1] < 0.3 * errors[0]


def test_an_uncoupled_matrix_changes_nothing(path: Path) -> None:
    """C = 1 gives the same fit as no coupling."""
    data, fits = log(4.0, 2), []
    for coupling in (None, np.eye(3).tolist()):
        system = forcegp.ConstrainedSystem(forcegp.load_robot(path, coupling=coupling))
        fits.append(forcegp.StructuredGP(system, "analytical").fit(data))
    means = [fit.predict(data.q, data.qd, data.tau).mean for fit in fits]
    assert torch.allclose(*means, rtol=1e-6, atol=1e-6)


def test_least_squares_knows_the_drive(robot: forcegp.RobotModel) -> None:
    """The baseline of `evaluate` has friction of drives as well."""
    train, test = log(10.0, 0), log(4.0, 1)
    errors = []
    for each in (robot, robot.replace(coupling=None)):
        fit = identify_rigid(forcegp.ConstrainedSystem(each), train)
        M = forcegp.dynamics.mass_matrix(robot, test.q)
        mean = fit.predict(test)
        errors.append(float((M @ (mean - test.qdd)[..., None]).square().mean()))
    assert errors[0] < 0.1 * errors[1]


def test_motor_side_columns_become_those_of_joints(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    """Ratios 10, 20 and −5: q = C⁻¹ q_m/N and τ = Cᵀ N τ_m, with the same power."""
    data, N = log(1.0, 3), torch.tensor([10.0, 20.0, -5.0], dtype=torch.float64)
    motors = robot.drive_motion(data.q) * N, robot.drive_torque(data.tau) / N
    np.savez(tmp_path / "log.npz", t=data.t.numpy(), q=motors[0].numpy(), tau=motors[1].numpy())
    side = 'side = "motor"\ngear_ratio = { a = 10.0, b = 20.0, c = -5.0 }'
    toml = f"""time = {{ column = "t" }}
    joints = {{ a = "0", b = "1", c = "2" }}
    derivatives = {{ filter_torque = false }}
    [position]
    column = "q[{{joint}}]"
    unit = "rad"
    {side}
    [torque]
    column = "tau[{{joint}}]"
    unit = "Nm"
    {side}"""
    found = forcegp.read_log(tmp_path / "log.npz", robot, parse_mapping(toml.encode(), "motors"))
    rows = [int((data.t - t).abs().argmin()) for t in found.t]
    assert torch.allclose(found.q, data.q[rows], atol=1e-3)
    assert torch.allclose(found.tau, data.tau[rows], atol=1e-9)
    head, torque = toml.split("[torque]")
    lacking = f'{head}[torque]{torque.replace("b = 20.0, ", "")}\n    unmeasured = ["b"]'
    with pytest.raises(MappingError, match="'b' has a coupled drive, but no column"):
        forcegp.read_log(tmp_path / "log.npz", robot, parse_mapping(lacking.encode(), "motors"))


def test_a_scene_and_a_saved_fit_keep_the_coupling(tmp_path: Path, path: Path) -> None:
    """`[robot] coupling` of a scene file, and files of models."""
    (tmp_path / "scene.toml").write_text(
        f'[robot]\nmodel = "{path}"\ncoupling = {{ c = {{ b = 1.0 }} }}\n', encoding="utf-8"
    )
    system = forcegp.load_scene(tmp_path / "scene.toml").system()
    fit = forcegp.StructuredGP(system, "analytical").fit(log(4.0, 0))
    fit.save(tmp_path / "fit.safetensors")
    again = forcegp.load_model(tmp_path / "fit.safetensors")
    assert again.system.robot.coupling.tolist() == [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]]
    q, qd, tau = torch.ones(3, 1, 3, dtype=torch.float64)
    assert torch.equal(again.predict(q, qd, tau).mean, fit.predict(q, qd, tau).mean)
    with pytest.raises(UnsupportedRobotError, match="an exported program does not support"):
        fit.export(tmp_path / "c")
    with pytest.raises(UnsupportedRobotError, match="a robot file does not support"):
        write_calibrated(fit, path, tmp_path / "out.xml")


def test_check_does_not_judge_torques_by_friction_of_joints(robot: forcegp.RobotModel) -> None:
    """A right log has no finding about torques, and the report says what was not compared."""
    report = forcegp.check(forcegp.ConstrainedSystem(robot), log(10.0, 0))
    assert not [f for f in report.findings if f.severity != "note"], report.findings
    assert "coupled drives" in report.skipped["dynamics"]


def test_invalid_couplings_are_named(path: Path) -> None:
    """Singular, of the wrong shape, not finite, or of a joint that does not exist."""
    with pytest.raises(ParameterError, match="singular"):
        forcegp.load_robot(path, coupling={"c": {"c": 0.0}})
    with pytest.raises(ParameterError, match="singular"):
        forcegp.load_robot(path, coupling={"c": {"b": float("nan")}})
    with pytest.raises(ShapeError, match="wrong shape"):
        forcegp.load_robot(path, coupling=[[1.0, 0.0], [0.0, 1.0]])
    with pytest.raises(UnknownNameError, match="'wrist'"):
        forcegp.load_robot(path, coupling={"wrist": {"b": 1.0}})


def test_base_parameters_are_identified_with_a_coupled_drive(robot: forcegp.RobotModel) -> None:
    """`identify` subtracts the inertia of the drives, which are not parameters of links."""
    g = torch.Generator().manual_seed(0)
    q, qd, qdd = torch.randn(3, 200, 3, dtype=torch.float64, generator=g)
    still = robot.replace(damping=0 * robot.damping)
    found = identify(still, q, qd, qdd, forcegp.dynamics.inverse_dynamics(still, q, qd, qdd))
    assert found.value == pytest.approx(found.base.of(still), abs=1e-8)
