"""Logs of currents with wrong torque constants, of an arm that MuJoCo moves."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import forcegp
from forcegp.checks import check
from forcegp.errors import DataError, MappingError, ModelError
from forcegp.evaluation.judgement import torque_response
from forcegp.logs import import_log
from forcegp.logs.mapping import parse_mapping
from forcegp.models.calibrated import write_calibrated
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.write_back import write_robot
from servo_arm import ARM, ARMATURE, DAMPING, FRICTION, STIFFNESS, VISCOUS, commanded, engine

mujoco = pytest.importorskip("mujoco")
CONSTANTS, WRONG = np.array([2.0, 1.5, 0.5]), np.array([1.2, 0.85, 1.2])
"""Torque per current with the gear [N m/A], and the nominal ones over these. No link shows the last one."""
MOTORS = """<actuator><motor joint="a"/><position joint="b" kp="30" kv="1"/><motor joint="c" gear="2"/>
</actuator>"""


def logged(path: Path, seed: int, seconds: float = 20.0) -> Path:
    """Positions of the true arm and currents, with noise, at 250 Hz."""
    model = engine(ARMATURE, FRICTION, VISCOUS)
    data, rows, random = mujoco.MjData(model), [], np.random.default_rng(seed)
    for k in range(round(1000 * seconds)):
        t = 1e-3 * k
        tau = STIFFNESS * (commanded(seed, t) - data.qpos) - DAMPING * data.qvel
        if k % 4 == 0:
            measured = tau + 0.01 * STIFFNESS / 100.0 * random.standard_normal(3)
            rows.append([np.full(3, t), data.qpos + 1e-5 * random.standard_normal(3), measured / CONSTANTS])
        data.qfrc_applied[:] = tau
        mujoco.mj_step(model, data)
    t, q, current = np.array(rows).transpose(1, 0, 2)
    np.savez(path, t=t[:, 0], q=q, i=current)
    return path


def mapping(more: str = "", wrong: np.ndarray = WRONG) -> Any:
    """The mapping with nominal torque constants."""
    constants = ", ".join(f"{j} = {x}" for j, x in zip("abc", wrong * CONSTANTS, strict=True))
    toml = f"""time = {{ column = "t" }}
    joints = {{ a = "0", b = "1", c = "2" }}
    position = {{ column = "q[{{joint}}]", unit = "rad" }}
    derivatives = {{ window = 21 }}
    [torque]
    column = "i[{{joint}}]"
    unit = "A"
    torque_constant = {{ {constants} }}
    {more or "torque_constant_std = 0.3"}"""
    return parse_mapping(toml.encode(), "currents")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The robot file and two logs."""
    made = tmp_path_factory.mktemp("currents")
    (made / "arm.xml").write_text(ARM.replace("</mujoco>", f"{MOTORS}</mujoco>"))
    logged(made / "train.npz", 0)
    logged(made / "test.npz", 1, 5.0)
    return made


@pytest.fixture(scope="module")
def robot(folder: Path) -> forcegp.RobotModel:
    """The arm of the robot file."""
    return forcegp.load_robot(folder / "arm.xml")


@pytest.fixture(scope="module")
def fit(folder: Path, robot: forcegp.RobotModel) -> StructuredFit:
    """The defaults, with torque constants that are wrong."""
    data = forcegp.read_log(folder / "train.npz", robot, mapping())
    return forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(data)


def test_torque_constants_are_learned_where_links_fix_them(fit: StructuredFit, folder: Path) -> None:
    own = {p.name: p for p in fit.parameters()}
    true = 1.0 / WRONG - 1.0
    for joint, error in zip("ab", true, strict=False):
        scale = own[f"drives.scale of {joint}"]
        assert scale.determined
        assert abs(scale.value - error) <= min(2.0 * scale.std, 0.05)
    last = own["drives.scale of c"]
    assert not last.determined
    assert last.value == 0.0
    known = forcegp.read_log(folder / "train.npz", fit.specified.robot, mapping("torque_constant_std = 0.0"))
    assert known.header.torque_scale_std is None
    named = {p.of: p.value for p in fit.robot_parameters() if p.name == "torque scale" and p.determined}
    found = {p.of: p for p in fit.robot_parameters() if p.name == "torque constant"}
    for joint, true in zip("ab", CONSTANTS, strict=False):
        one = found[joint]
        assert one.determined and one.unit == "N m/A" and abs(one.value - true) < 2.0 * (one.std or 0.0)
    assert not found["c"].determined
    assert named == {joint: 1.0 + own[f"drives.scale of {joint}"].value for joint in "ab"}


def test_programs_and_files_have_the_scales(fit: StructuredFit, folder: Path, tmp_path: Path) -> None:
    test = forcegp.read_log(folder / "test.npz", fit.specified.robot, mapping())[:50]
    state, theirs = (test.q, test.qd, test.tau), fit.predict(test.q, test.qd, test.tau, noise=True)
    fit.save(tmp_path / "model")
    for one in (fit.compiled(), forcegp.load_model(tmp_path / "model")):
        ours = one.predict(*state, noise=True)
        assert ours.covariance is not None
        assert theirs.covariance is not None
        torch.testing.assert_close(ours.mean, theirs.mean, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(ours.covariance, theirs.covariance, rtol=1e-6, atol=1e-9)
    # Beyond the trained region, too
    far = test.q, test.qd, 3.0 * test.tau
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ours, theirs = fit.compiled().predict(*far), fit.predict(*far)
    assert theirs.beyond is not None
    assert float(theirs.beyond.max()) > 0.0
    assert ours.covariance is not None
    torch.testing.assert_close(ours.covariance, theirs.covariance, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(ours.beyond, theirs.beyond, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(fit.beyond(far[1], far[2]), theirs.beyond)
    along = fit.linearize(*(x[:3] for x in state))
    for j, step in enumerate(1e-5 * torch.eye(3, dtype=torch.float64)):
        ends = [fit.predict(*(x[:3] for x in state[:2]), test.tau[:3] + s * step).mean for s in (1.0, -1.0)]
        torch.testing.assert_close(along.dtau[..., j], (ends[0] - ends[1]) / 2e-5, rtol=1e-5, atol=1e-5)


def test_an_added_current_has_its_full_effect(fit: StructuredFit, folder: Path) -> None:
    test = forcegp.read_log(folder / "test.npz", fit.specified.robot, mapping())
    response = torque_response(fit, fit.system.robot, test)
    assert response == pytest.approx([1.0, 1.0, 1.0], abs=0.02)
    scale = fit.system.robot.torque_scale
    assert scale is not None
    scores = forcegp.evaluate(fit, test).predictors[0]
    assert min(scores.explained) > 0.95
    size = np.array(scores.torque.all) / np.array(scores.torque.normalised)
    assert size == pytest.approx((test.tau * scale).std(0).numpy(), rel=0.01)


def test_currents_are_not_mixed_with_measured_torques(folder: Path, robot: forcegp.RobotModel) -> None:
    known = forcegp.read_log(folder / "test.npz", robot, mapping("torque_constant_std = 0.0"))
    currents = forcegp.read_log(folder / "test.npz", robot, mapping())
    with pytest.raises(DataError, match="unknown scales"):
        forcegp.Dataset.concatenate([known, currents])
    other = forcegp.read_log(folder / "test.npz", robot, mapping("torque_constant_std = 0.1"))
    assert forcegp.Dataset.concatenate([other, currents]).header.torque_scale_std == 0.3
    first = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(known)
    with pytest.raises(ModelError, match="unknown scales"):
        forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(currents, after=first)


def test_constants_beyond_what_is_stated_are_named(folder: Path, robot: forcegp.RobotModel) -> None:
    wrong = mapping("torque_constant_std = 0.2", np.array([2.0, 0.85, 1.0]))
    data = forcegp.read_log(folder / "train.npz", robot, wrong)
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(data)
    (doubt,) = (text for text in fit.result.warnings if "beyond what is stated" in text)
    assert "a 0.5" in doubt


def test_scales_are_learned_with_the_inertia_of_the_file(folder: Path) -> None:
    """Otherwise, the best fit would be no torque at all."""
    robot = forcegp.load_robot(folder / "arm.xml")
    robot = robot.replace(armature=robot.armature + torch.from_numpy(ARMATURE))
    data = forcegp.read_log(folder / "train.npz", robot, mapping())
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), inertia="file").fit(data)
    assert fit.system.robot.torque_scale is not None
    error = fit.system.robot.torque_scale[:2] * torch.from_numpy(WRONG[:2]) - 1.0
    assert float(error.abs().max()) < 0.05


def test_rollouts_scale_nominal_torques_once(fit: StructuredFit, folder: Path) -> None:
    test = forcegp.read_log(folder / "test.npz", fit.specified.robot, mapping())
    path = fit.rollout(test.q[100], test.qd[100], test[100:120])
    step = float(path.t[1] - path.t[0])
    first = (path.qd.reshape(len(path.t), -1)[1] - test.qd[100]) / step
    predicted = fit.predict(test.q[100], test.qd[100], test.tau[100]).mean
    torch.testing.assert_close(first, predicted, rtol=0.1, atol=0.5)
    torch.testing.assert_close(path.tau.reshape(-1, 3)[0], test.tau[100], rtol=1e-6, atol=1e-6)


def test_written_motors_and_servos_are_scaled(fit: StructuredFit, folder: Path, tmp_path: Path) -> None:
    found = write_calibrated(fit, folder / "arm.xml", tmp_path / "out.xml", samples=2)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert found.robot.torque_scale is not None
    a, b, c = found.robot.torque_scale.tolist()
    assert c == 1.0
    assert model.actuator_gear[:3, 0] == pytest.approx([a, 1.0, 2.0 * c])
    assert model.actuator_gainprm[1, 0] == pytest.approx(30.0 * b)
    assert model.actuator_biasprm[1, 1:3] == pytest.approx([-30.0 * b, -b])
    scales = [p for p in found.parameters if p.name == "torque_scale"]
    assert [p.element for p in scales] == ["a", "b", "c"]
    assert [p.determined for p in scales] == [True, True, False]


def test_a_motor_with_inertia_is_left_alone(folder: Path, tmp_path: Path) -> None:
    """Its armature acts on the joint with the square of the gear."""
    text = (folder / "arm.xml").read_text().replace('joint="a"', 'joint="a" armature="0.02" damping="0.1"')
    (tmp_path / "arm.xml").write_text(text)
    robot = forcegp.load_robot(tmp_path / "arm.xml")
    scaled = robot.replace(torque_scale=torch.tensor([1.2, 1.1, 1.0], dtype=torch.float64))
    written = write_robot(scaled, tmp_path / "arm.xml", tmp_path / "out.xml")
    assert [change.element for change in written.changes] == ["b", "b"]
    (loss,) = written.losses
    assert "a 1.2" in loss


def test_urdf_names_the_scales_that_it_cannot_hold(tmp_path: Path) -> None:
    robot = forcegp.load_robot("double_pendulum")
    scaled = robot.replace(torque_scale=torch.tensor([1.1, 1.0], dtype=torch.float64))
    written = write_robot(scaled, "double_pendulum", tmp_path / "out.urdf")
    (loss,) = written.losses
    assert "1.1" in loss
    assert robot.joint_names[0] in loss
    assert robot.joint_names[1] not in loss


def test_invalid_deviations_are_named() -> None:
    with pytest.raises(MappingError, match="torque_constant_std"):
        mapping("torque_constant_std = -0.1")


@pytest.mark.parametrize(
    ("noise", "friction", "named"), [(0.0, 0.0, True), (1e-4, 0.0, False), (0.0, 0.5, False)]
)
def test_torques_of_a_model_are_named(noise: float, friction: float, named: bool, tmp_path: Path) -> None:
    """Only torques without noise and without friction are the output of a model."""
    robot, random = forcegp.load_robot("double_pendulum"), np.random.default_rng(0)
    t = 0.002 * np.arange(4000)
    w, phase = random.uniform(2.0, 9.0, (2, 1, 2)), random.uniform(0.0, 6.0, (2, 1, 2))
    q, qd, qdd = (
        torch.from_numpy(sum(f(w[k] * t[:, None] + phase[k]) * w[k] ** n for k in range(2)))
        for n, f in enumerate((np.sin, np.cos, lambda x: -np.sin(x)))
    )
    tau = forcegp.dynamics.inverse_dynamics(robot, q, qd, qdd) + friction * torch.sign(qd)
    tau = tau + noise * torch.from_numpy(random.standard_normal(tau.shape)) * tau.abs().mean()
    np.savez(tmp_path / "log.npz", t=t, q=q.numpy(), u=tau.numpy())
    toml = """time = { column = "t" }
    position = { column = "q[{joint}]", unit = "rad" }
    torque = { column = "u[{joint}]", unit = "Nm" }
    [joints]
    """ + "\n".join(f'{joint} = "{i}"' for i, joint in enumerate(robot.joint_names))
    found = import_log(tmp_path / "log.npz", robot, parse_mapping(toml.encode(), "model"))
    assert any(kind == "modelled" for kind, _ in found.data.header.imported) == named
    report = check(forcegp.ConstrainedSystem(robot), found.data)
    assert any(each.kind == "torque-noiseless" for each in report.findings) == named
