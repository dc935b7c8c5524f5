"""Logs of servos without torques, of an arm that MuJoCo moves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import DataError, MappingError
from forcegp.logs import import_log
from forcegp.logs.mapping import parse_mapping
from servo_arm import ARM, ARMATURE, DAMPING, FRICTION, STIFFNESS, VISCOUS, commanded, engine

mujoco = pytest.importorskip("mujoco")

WRONG = np.array([1.3, 1.0 / 1.3, 1.3])
"""Nominal stiffness and damping over the true ones. No link shows the scale of the last servo."""
DELAY = 0.012


@dataclass(frozen=True)
class Raw:
    """A log as it comes: time, positions and commands."""

    t: np.ndarray
    q: np.ndarray
    command: np.ndarray

    def write(self, path: Path) -> Path:
        """Write the columns."""
        np.savez(path, t=self.t, q=self.q, c=self.command)
        return path


def logged(seed: int, seconds: float, every: int = 4) -> Raw:
    """Positions of the true arm with noise, and commands, every few milliseconds."""
    model = engine(ARMATURE, FRICTION, VISCOUS)
    data, rows, random = mujoco.MjData(model), [], np.random.default_rng(seed)
    for k in range(round(1000 * seconds)):
        t = 1e-3 * k
        if k % every == 0:
            rows.append([np.full(3, t), data.qpos + 1e-5 * random.standard_normal(3), commanded(seed, t)])
        late = commanded(seed, max(0.0, t - DELAY))
        data.qfrc_applied[:] = STIFFNESS * (late - data.qpos) - DAMPING * data.qvel
        mujoco.mj_step(model, data)
    t, q, command = np.array(rows).transpose(1, 0, 2)
    return Raw(t[:, 0], q, command)


def mapping(more: str = "", servo: bool = True, window: int = 21) -> Any:
    """The mapping with nominal gains."""
    stiffness, damping = (
        ", ".join(f"{j} = {x}" for j, x in zip("abc", nominal, strict=True))
        for nominal in (WRONG * STIFFNESS, WRONG * DAMPING)
    )
    toml = f"""time = {{ column = "t" }}
    joints = {{ a = "0", b = "1", c = "2" }}
    position = {{ column = "q[{{joint}}]", unit = "rad" }}
    derivatives = {{ window = {window} }}
    """
    if servo:
        toml += f"""[servo]
        column = "c[{{joint}}]"
        unit = "rad"
        stiffness = {{ {stiffness} }}
        damping = {{ {damping} }}
        {more}"""
    return parse_mapping(toml.encode(), "servo")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> forcegp.RobotModel:
    """The arm of the robot file, without drives and friction."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return forcegp.load_robot(path)


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds at 250 Hz."""
    return logged(0, 20.0).write(tmp_path_factory.mktemp("servo") / "log.npz")


def test_torques_follow_from_commands_that_are_late(robot: forcegp.RobotModel, raw: Path) -> None:
    """The delay is found within 2 ms; the header and the commands describe the servos."""
    found = import_log(raw, robot, mapping())
    data, (step,) = found.data, [step for step in found.report.steps if "commands" in step]
    assert abs(float(step.split("commands ")[1].split(" ms")[0]) - 1e3 * DELAY) < 2.0
    assert data.header.torque_scale_std == 0.3
    assert data.header.servo_stiffness == pytest.approx(WRONG * STIFFNESS)
    given = import_log(raw, robot, mapping("delay = 0.012", window=5)).data
    late = np.array([commanded(0, float(t) - DELAY) for t in given.t])
    assert np.abs(given.extras["command"].numpy() - late).max() < 1e-4
    spring = WRONG * STIFFNESS * (late - given.q.numpy()) - WRONG * DAMPING * given.qd.numpy()
    inner = slice(10, -10)
    assert np.abs(spring - given.tau.numpy())[inner].max() < 0.05 * np.abs(spring).max()


def test_gains_are_learned_where_links_fix_their_scale(robot: forcegp.RobotModel, raw: Path) -> None:
    """Error bars hold, and the scale of the last servo, which moves hardly any link, stays as stated."""
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(forcegp.read_log(raw, robot, mapping()))
    own = {p.name: p for p in fit.parameters()}
    for joint, wrong in zip("ab", WRONG, strict=False):
        scale = own[f"drives.scale of {joint}"]
        assert scale.determined
        assert abs(scale.value - (1.0 / wrong - 1.0)) < 3.0 * scale.std + 0.01
        assert scale.std < 0.15
    named = {p.of: p for p in fit.robot_parameters() if p.name == "torque scale"}
    assert [named[joint].determined for joint in "abc"] == [True, True, False]
    assert named["a"].value == 1.0 + own["drives.scale of a"].value and named["c"].value == 1.0
    last = own["drives.scale of c"]
    assert (last.value, last.std, last.determined) == (0.0, pytest.approx(0.3), False)
    # Relative to the nominal torque of this servo
    assert float(fit.system.robot.armature[2]) == pytest.approx(WRONG[2] * ARMATURE[2], rel=0.15)


def test_playback_of_commands_follows_the_true_arm(
    robot: forcegp.RobotModel, raw: Path, tmp_path: Path
) -> None:
    """Two seconds of other commands: a quarter of the error of the file with nominal gains, in MuJoCo."""
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(forcegp.read_log(raw, robot, mapping()))
    test = logged(1, 5.0).write(tmp_path / "test.npz")
    log = forcegp.read_log(test, robot, mapping())
    log = log[250:751]
    path = fit.rollout(log.q[0], log.qd[0], log, duration=2.0)
    rows = ((log.t - log.t[0]) / (path.t[1] - path.t[0])).round().long()
    ours = (path.q.view(-1, 3)[rows] - log.q).square().mean().sqrt()
    model, errors = engine(armature=1e-3), []
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = log.q[0], log.qd[0]
    start, k_p, k_d = float(log.t[0]), WRONG * STIFFNESS, WRONG * DAMPING
    model.dof_damping[:] = k_d  # implicit, as explicit damping of light joints is unstable
    for k in range(2000):
        if k % 4 == 0:
            errors.append(data.qpos - log.q[k // 4].numpy())
        data.qfrc_applied[:] = k_p * (commanded(1, start + 1e-3 * k) - data.qpos)
        mujoco.mj_step(model, data)
    file = np.sqrt(np.square(errors).mean())
    assert ours < 0.005
    assert ours < 0.25 * file


def test_rows_in_which_a_servo_saturates_are_dropped(robot: forcegp.RobotModel, raw: Path) -> None:
    """With a limit of 8 N m for the first servo, and one that is always exceeded."""
    found = import_log(raw, robot, mapping("limit = { a = 8.0, b = 1e3, c = 1e3 }"))
    (finding,) = [f for f in found.report.findings if f.kind == "clipped"]
    assert "servo of a saturates" in finding.message
    assert found.data.tau[:, 0].abs().max() < 8.0
    with pytest.raises(DataError, match="saturates in every row"):
        import_log(raw, robot, mapping("limit = 1e-9"))


def test_commands_of_velocities_and_torques_are_part_of_the_torque(
    robot: forcegp.RobotModel, raw: Path, tmp_path: Path
) -> None:
    """τ = k_p (q_c − q) + k_d (q̇_c − q̇) + τ_c of late commands, in other units and with a sign."""
    logged = dict(np.load(raw))
    speed, torque = np.cos(3.0 * logged["t"]), 4.0 * np.sin(2.0 * logged["t"])
    more = {"v": np.rad2deg(np.stack([speed, -speed, speed], axis=1)), "f": -np.stack([torque] * 3, axis=1)}
    np.savez(tmp_path / "more.npz", **logged, **more)
    tables = """delay = 0.012
        [servo_velocity]
        column = "v[{joint}]"
        unit = "deg/s"
        [servo_torque]
        column = "f[{joint}]"
        unit = "Nm"
        sign = -1.0"""
    plain = import_log(raw, robot, mapping("delay = 0.012")).data
    data = import_log(tmp_path / "more.npz", robot, mapping(tables)).data
    late = data.t.numpy() - DELAY
    speeds = np.cos(3.0 * late)[:, None] * np.array([1.0, -1.0, 1.0])
    added = WRONG * DAMPING * speeds + 4.0 * np.sin(2.0 * late)[:, None]
    inner = slice(20, -20)
    assert np.abs((data.tau - plain.tau).numpy() - added)[inner].max() < 0.02
    with pytest.raises(MappingError, match="commands need those of positions"):
        parse_mapping(
            b'time = { column = "t" }\nposition = { column = "q", unit = "rad" }\n'
            b'torque = { column = "c", unit = "Nm" }\nservo_torque = { column = "f", unit = "Nm" }',
            "servo",
        )


def test_a_stiffness_without_nominal_value_is_found(
    robot: forcegp.RobotModel, raw: Path, tmp_path: Path
) -> None:
    """Within 2 %, from positions with and without noise; the last servo moves hardly any link."""
    asked = mapping()
    unknown = {"a": "auto", "b": "auto", "c": 20.0}

    def given(stiffness: object) -> Any:
        servo = asked.sections.servo.model_copy(update={"stiffness": stiffness, "damping": 0.0})
        return replace(asked, sections=asked.sections.model_copy(update={"servo": servo}))

    random, log = np.random.default_rng(5), dict(np.load(raw))
    noisy = tmp_path / "noisy.npz"
    np.savez(noisy, **{**log, "q": log["q"] + 4e-4 * random.standard_normal(log["q"].shape)})
    for path in (raw, noisy):
        found = import_log(path, robot, given(unknown))
        assert found.data.header.servo_stiffness == pytest.approx([*STIFFNESS[:2], 20.0], rel=0.02)
        assert any("found the stiffness from the motion" in step for step in found.report.steps)
    with pytest.raises(DataError, match="does not determine the stiffness of c"):
        import_log(raw, robot, given("auto"))


def test_invalid_servos_are_named(robot: forcegp.RobotModel, raw: Path) -> None:
    """Neither torques nor commands, a stiffness below zero, and a log without time for its delay."""
    with pytest.raises(MappingError, match="torques or commands of servos are needed"):
        mapping(servo=False)
    with pytest.raises(MappingError, match="not a valid limit"):
        mapping("limit = -1.0")
    with pytest.raises(MappingError, match="stiffness"):
        parse_mapping(
            b'time = { column = "t" }\nposition = { column = "q", unit = "rad" }\n'
            b'servo = { column = "c", unit = "rad" }',
            "servo",
        )
    with pytest.raises(DataError, match="shorter than the delay"):
        import_log(raw, robot, mapping("delay = 100.0"))


def test_check_does_not_judge_torques_of_nominal_gains(robot: forcegp.RobotModel, raw: Path) -> None:
    """Their errors are learned by a fit, and are no fault of the log."""
    report = forcegp.check(forcegp.ConstrainedSystem(robot), forcegp.read_log(raw, robot, mapping()))
    assert "nominal gains" in report.skipped["dynamics"]
    assert not [f for f in report.findings if f.severity == "error"]


def test_a_delay_that_cannot_be_found_is_no_number(robot: forcegp.RobotModel, tmp_path: Path) -> None:
    """Later than the longest delay that is tried, an arm that rests, a short log, and commands in steps."""
    raw = logged(2, 6.0)
    late = Raw(raw.t[40:], raw.q[40:], np.roll(raw.command, -40, axis=0)[40:])
    rests = Raw(raw.t, np.zeros_like(raw.q), raw.command)
    short = Raw(raw.t[:30], raw.q[:30], raw.command[:30])
    steps = Raw(raw.t, raw.q, raw.command[np.arange(len(raw.t)) // 5 * 5])
    unfound = {"late": late, "rests": rests, "short": short, "held over several rows": steps}
    for text, each in unfound.items():
        with pytest.raises(DataError, match="too short" if text == "short" else "cannot be found"):
            import_log(each.write(tmp_path / f"{text}.npz"), robot, mapping())


def test_a_known_stiffness_has_no_unknown_scale(robot: forcegp.RobotModel, raw: Path) -> None:
    """`stiffness_std = 0` makes torques known, as measured ones."""
    data = forcegp.read_log(raw, robot, mapping("stiffness_std = 0.0"))
    assert data.header.torque_scale_std is None
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(data)
    assert not [p for p in fit.parameters() if p.name.startswith("drives")]


def test_a_saved_data_set_and_model_keep_the_servos(
    robot: forcegp.RobotModel, raw: Path, tmp_path: Path
) -> None:
    """Commands and gains survive a file, and a loaded model predicts the same torque scale."""
    data = forcegp.read_log(raw, robot, mapping())
    data.write(tmp_path / "log.parquet")
    again = forcegp.Dataset.read(tmp_path / "log.parquet")
    assert torch.equal(again.extras["command"], data.extras["command"])
    assert again.header.servo_damping == data.header.servo_damping
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot)).fit(again[::5])
    fit.save(tmp_path / "model.safetensors")
    loaded, at = forcegp.load_model(tmp_path / "model.safetensors"), (data.q[:3], data.qd[:3], data.tau[:3])
    assert torch.equal(loaded.predict(*at).mean, fit.predict(*at).mean)
