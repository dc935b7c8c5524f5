"""Positions against velocities and the clock: wrapped angles, wrong units of time, bursts, lost rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import forcegp
from forcegp.errors import DataError, MappingError
from forcegp.logs import Imported, import_log, parse_mapping
from log_files import JOINTS, Motion, mapping, motion, write_csv

ROBOT = forcegp.load_robot("double_pendulum")


def kinds(imported: Imported) -> list[str]:
    return [finding.kind for finding in imported.report.findings]


def imported(folder: Path, m: Motion, toml: str | None = None, velocity: bool = True) -> Imported:
    path, text = write_csv(folder, m)
    text = toml or text
    if not velocity:
        text = text[: text.index("[velocity]")] + text[text.index("[torque]") :]
    return import_log(path, ROBOT, parse_mapping(text.encode(), "m.toml"))


def turning(n: int = 600, dt: float = 0.01) -> Motion:
    """A motion in which both joints pass ±π several times."""
    t = np.arange(n) * dt
    x = t[:, None] * np.array([1.0, 2.0])
    return Motion(t, 2.5 + 2.0 * np.sin(x), 2.0 * np.array([1.0, 2.0]) * np.cos(x), np.cos(x))


def wrap(q: np.ndarray, turn: float = 2.0 * np.pi) -> np.ndarray:
    return (q + 0.5 * turn) % turn - 0.5 * turn


@pytest.mark.parametrize("unit", ["rad", "deg", "rev"])
def test_wrapped_angles_are_named_and_made_continuous(tmp_path: Path, unit: str) -> None:
    m, turn = turning(), {"rad": 2.0 * np.pi, "deg": 360.0, "rev": 1.0}[unit]
    logged = Motion(m.t, wrap(m.q) * turn / (2.0 * np.pi), m.qd, m.tau)
    toml = mapping().replace('unit = "rad"\n', f'unit = "{unit}"\nunwrap = true\n')
    result = imported(tmp_path, logged, toml)
    assert (
        kinds(result) == ["unwrapped"]
        and "shoulder, elbow jump by one turn" in result.report.findings[0].message
    )
    np.testing.assert_allclose(result.data.q.numpy(), m.q, atol=1e-12)
    assert float(result.data.qdd.abs().max()) < 20.0
    kept = imported(tmp_path, logged, toml.replace("unwrap = true\n", ""))
    assert "unwrap = true under [position]" in kept.report.findings[0].message
    np.testing.assert_allclose(kept.data.q.numpy(), wrap(m.q), atol=1e-12)


def test_motor_angles_wrap_at_a_turn_of_the_motor(tmp_path: Path) -> None:
    m = turning()
    toml = mapping().replace(
        'unit = "rad"\n', 'unit = "rad"\nunwrap = true\nside = "motor"\ngear_ratio = 3.0\n'
    )
    logged = Motion(m.t, wrap(3.0 * m.q), m.qd, m.tau)
    data = imported(tmp_path, logged, toml).data
    start = data.q[0].numpy() - m.q[0]
    np.testing.assert_allclose(data.q.numpy() - start, m.q, atol=1e-12)


def test_distances_do_not_wrap() -> None:
    toml = mapping().replace('unit = "rad"\n', 'unit = "mm"\nunwrap = true\n')
    with pytest.raises(MappingError, match=r"position.unwrap: a distance does not wrap"):
        parse_mapping(toml.encode(), "m.toml")


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_a_wrong_unit_of_time_is_found_before_the_log_is_used(tmp_path: Path, factor: float) -> None:
    m = motion()
    with pytest.raises(DataError, match=r"the unit of time(?s:.*)under \[time\]"):
        imported(tmp_path, Motion(m.t * factor, m.q, m.qd, m.tau))


@pytest.mark.parametrize("factor", [1.0 / 3.6, 0.0864, 60.0])
def test_velocities_that_no_unit_explains_are_reported(tmp_path: Path, factor: float) -> None:
    m = motion()
    report = imported(tmp_path, Motion(m.t, m.q, m.qd * factor, m.tau))
    assert "velocity" in kinds(report)
    assert f"q̇ is {factor:.3g} times the derivative of q" in str(report)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e6])
def test_a_wrong_unit_of_time_is_found_without_velocities(tmp_path: Path, factor: float) -> None:
    m = motion()
    with pytest.raises(DataError, match=r"the unit of time(?s:.*)under \[time\]"):
        imported(tmp_path, Motion(m.t * factor, m.q, m.qd, m.tau), velocity=False)
    slow = imported(tmp_path, Motion(m.t * 1e3, m.q, m.qd, m.tau), velocity=False)
    assert kinds(slow) == ["clock"]


def test_an_arm_at_rest_has_no_wrong_unit_of_time(tmp_path: Path) -> None:
    """Encoder noise is no velocity: the ratio of both is that of noise."""
    noise = 1e-4 * np.random.default_rng(0).standard_normal((300, 2))
    m = motion()
    assert not kinds(imported(tmp_path, Motion(m.t, 1.0 + noise, 1e-7 * noise, m.tau)))


@pytest.mark.parametrize("velocity", [True, False])
@pytest.mark.parametrize("lost", ["every seventh", "a third", "three bursts", "none"])
def test_lost_rows_with_renumbered_stamps_are_found(tmp_path: Path, lost: str, velocity: bool) -> None:
    m, random = motion(1500, 0.004), np.random.default_rng(1)
    noise = 2e-5 * random.standard_normal(m.q.shape)
    rows = np.arange(len(m.t))
    bursts = ~np.isin(rows // 25, (10, 25, 40))
    keep = {"every seventh": rows % 7 != 3, "a third": random.random(len(rows)) > 0.3, "three bursts": bursts}
    kept = rows[keep.get(lost, rows >= 0)]
    result = imported(
        tmp_path, Motion(m.t[: len(kept)], (m.q + noise)[kept], m.qd[kept], m.tau[kept]), velocity=velocity
    )
    assert kinds(result) == ["lost"] * (lost != "none")
    if lost == "three bursts" and velocity:
        assert result.report.findings[0].rows == ((250, 250), (600, 600), (950, 950))


def test_a_spike_an_impact_and_a_lag_are_no_lost_rows(tmp_path: Path) -> None:
    m = motion(1500, 0.004)
    spiky = m.q.copy()
    spiky[700] += 0.3
    assert not kinds(imported(tmp_path, Motion(m.t, spiky, m.qd, m.tau)))
    held = np.where((np.arange(1500) % 40 == 20)[:, None], np.roll(m.q, 1, axis=0), m.q)
    assert not kinds(imported(tmp_path, Motion(m.t, held, m.qd, m.tau)))
    late = np.concatenate([m.qd[:1].repeat(5, axis=0), m.qd[:-5]])
    assert not kinds(imported(tmp_path, Motion(m.t, m.q, late, m.tau)))
    rate = np.where(m.t < 3.0, 1.0, -0.8)[:, None] * np.array([1.0, -0.5])
    bounce = np.cumsum(rate * 0.004, axis=0)
    for velocity in (True, False):
        assert not kinds(imported(tmp_path, Motion(m.t, bounce, rate, m.tau), velocity=velocity))


def test_stamps_in_bursts_are_the_fault_of_the_clock(tmp_path: Path) -> None:
    """A receiver stamps a packet of eight rows at once: no contact switches, and none is blamed."""
    m = motion(400)
    rows = np.arange(400)
    t = (rows // 8) * 0.08 + (rows % 8) * 2e-4
    with pytest.raises(DataError, match=r"time stamps come in bursts of about 8 rows") as caught:
        imported(tmp_path, Motion(t, m.q, m.qd, m.tau), velocity=False)
    assert "contact" not in str(caught.value)


@pytest.mark.parametrize("velocity", [True, False])
def test_a_clock_that_jumps_is_told_from_a_pause_of_the_logger(tmp_path: Path, velocity: bool) -> None:
    m = motion(1500, 0.004)
    t = m.t + 3.0 * (np.arange(1500) >= 500) + 0.5 * (np.arange(1500) >= 900)
    result = imported(tmp_path, Motion(t, m.q, m.qd, m.tau), velocity=velocity)
    assert kinds(result) == ["gap", "clock"]
    assert "jumps by up to 3 s in 2 rows" in result.report.findings[1].message
    assert result.report.findings[1].rows == ((500, 500), (900, 900))
    kept = (np.arange(1500) < 500) | (np.arange(1500) >= 640)
    pause = Motion(m.t[kept], m.q[kept], m.qd[kept], m.tau[kept])
    assert kinds(imported(tmp_path, pause, velocity=velocity)) == ["gap"]


def test_nanoseconds_without_seconds_are_named(tmp_path: Path) -> None:
    m = motion(350)
    result = imported(tmp_path, Motion(m.t % 1.0, m.q, m.qd, m.tau))
    assert "the column of whole seconds is missing" in result.report.findings[0].message


@pytest.mark.parametrize("name", ["velocity", "unmapped"])
def test_velocities_are_not_required(tmp_path: Path, name: str) -> None:
    m = motion()
    path, toml = write_csv(tmp_path, m)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    kept = [i for i, heading in enumerate(lines[0]) if not heading.startswith("qd_")]
    path.write_text("\n".join(",".join(line[i] for i in kept) for line in lines))
    if name == "unmapped":
        path.write_text(path.read_text().replace("q_", "q.").replace("tau_", "tau."))
        result = import_log(path, ROBOT)
    else:
        result = import_log(path, ROBOT, parse_mapping(toml.encode(), "m.toml"))
        assert (
            "the log has no column 'qd_shoulder': the velocity is computed"
            in result.report.findings[0].message
        )
    np.testing.assert_allclose(result.data.qd.numpy()[10:-10], m.qd[10:-10], atol=2e-3)
    assert result.data.header.derived == ("qd", "qdd")


def test_a_joint_without_torque_sensor_is_unmeasured_and_not_locked(tmp_path: Path) -> None:
    path, toml = write_csv(tmp_path, motion())
    toml = toml.replace('column = "tau_{joint}"', 'columns = { shoulder = "tau_shoulder" }')
    with pytest.raises(
        MappingError, match=r"'elbow' has no column(?s:.*)unmeasured = \[\"elbow\"\]"
    ) as caught:
        import_log(path, ROBOT, parse_mapping(toml.encode(), "m.toml"))
    assert "locked_joints" not in str(caught.value)
    text = toml.replace("[torque]\n", f"[torque]\nunmeasured = [{JOINTS[1]!r}]\n")
    assert import_log(path, ROBOT, parse_mapping(text.encode(), "m.toml")).data.header.unmeasured_torques == (
        "elbow",
    )


@pytest.mark.parametrize(
    ("torque", "finding"),
    [
        ('column = "tau_{joint}"\nunit = "A"\ntorque_constant = 1.0', "currents at 1 N m/A"),
        ('column = "current_{joint}"\nunit = "Nm"', "'current_shoulder' is named like a current"),
        ('column = "target_{joint}"\nunit = "Nm"', "'target_shoulder' is named like a command ('target')"),
        ('column = "tau_{joint}_model"\nunit = "Nm"', "is named like the output of a model ('model')"),
    ],
)
def test_what_is_no_measured_torque_is_named(tmp_path: Path, torque: str, finding: str) -> None:
    path, toml = write_csv(tmp_path, motion())
    lines = path.read_text().split("\n", 1)
    for joint in JOINTS:
        new = torque.split('"')[1].replace("{joint}", joint)
        lines[0] = lines[0].replace(f"tau_{joint}", new)
    path.write_text("\n".join(lines))
    toml = toml.replace('column = "tau_{joint}"\nunit = "Nm"', torque)
    report = import_log(path, ROBOT, parse_mapping(toml.encode(), "m.toml")).report
    assert any(finding in found.message for found in report.findings)


def test_seconds_and_nanoseconds_are_one_clock(tmp_path: Path) -> None:
    m = motion()
    path, toml = write_csv(tmp_path, m)
    lines = path.read_text().splitlines()
    ns = 1_700_000_000_900_000_000 + np.round(1e9 * m.t).astype(np.int64)
    body = [
        f"{k // 10**9},{k % 10**9}," + line.split(",", 1)[1] for k, line in zip(ns, lines[1:], strict=True)
    ]
    path.write_text("\n".join(["sec,nanosec," + lines[0].split(",", 1)[1], *body]))
    toml = toml.replace('column = "t"', 'column = ["sec", "nanosec"]\nunit = ["s", "ns"]')
    result = import_log(path, ROBOT, parse_mapping(toml.encode(), "m.toml"))
    np.testing.assert_allclose(result.data.t.numpy(), m.t + 0.9, atol=1e-12)
    assert any("added up sec and nanosec" in step for step in result.report.steps)
    with pytest.raises(MappingError, match=r"time.unit: the columns of the clock need one unit each"):
        parse_mapping(toml.replace('["s", "ns"]', '"s"').encode(), "m.toml")


def swapped(n: int = 900, dt: float = 0.01, shift: float = 0.0) -> Motion:
    """A motion of which the last link is the base in the second third; jumps differ from that by `shift`."""
    t = np.arange(n) * dt
    x = t[:, None] * np.array([1.1, 1.7])
    q, qd = 0.6 * np.sin(x) + [0.2, 1.2], 0.6 * np.array([1.1, 1.7]) * np.cos(x)
    other = (t >= 3.0) & (t < 6.0)
    # θ_1 of the other base is the absolute angle of link 2, up to half a turn.
    q[other, 0] += q[other, 1] - np.pi + shift
    return Motion(t, q, qd, np.cos(x))


def test_a_log_with_two_bases_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"the base of the robot changes in rows 300, 600: .*'shoulder'"
    ) as it:
        imported(tmp_path, swapped(), velocity=False)
    assert it.value.hint is not None and "[time]" in it.value.hint
    with_gap, m = swapped(), swapped()
    keep = ~((m.t > 2.9) & (m.t < 3.0))
    with_gap = Motion(m.t[keep], m.q[keep], m.qd[keep], m.tau[keep])
    with pytest.raises(DataError, match="the base of the robot changes"):
        imported(tmp_path, with_gap, velocity=False)


def test_other_jumps_are_not_those_of_a_base(tmp_path: Path) -> None:
    result = imported(tmp_path, swapped(shift=0.3), velocity=False)
    assert "lost" in kinds(result)
    m = swapped()
    same = (m.t < 3.0) | (m.t >= 6.0)
    parts = [Motion(m.t[rows], m.q[rows], m.qd[rows], m.tau[rows]) for rows in (same & (m.t < 3.0), ~same)]
    assert all(len(imported(tmp_path, part, velocity=False).data) for part in parts)
