"""Proposed mappings: headings, units and signs of logs as different programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import DataError, MappingError
from forcegp.logs import Mapping, guess, parse_mapping, read_log
from forcegp.logs.headings import declared_unit
from forcegp.logs.mapping import Draft
from log_files import REAL, WRITERS, motion, real_logs
from robots import ARMS

ROWS, DT = 600, 0.006


def kuka_log() -> tuple[forcegp.ConstrainedSystem, dict[str, np.ndarray]]:
    """A motion of the bundled arm that presses on its table with 20 N, torques by inverse dynamics."""
    system = forcegp.load_scene("kuka_plane").system()
    robot = system.robot
    t = np.arange(ROWS) * DT
    rate = np.array([1.0, 1.4, 1.2, 1.8, 2.1, 1.6, 2.3])
    x = t[:, None] * rate + np.linspace(0.0, 2.0, 7)
    start = np.array([0.0, 0.6, 0.0, -1.4, 0.0, 0.9, 0.0])
    q, qd, qdd = start + 0.6 * np.sin(x), 0.6 * rate * np.cos(x), -0.6 * rate**2 * np.sin(x)
    state = [torch.from_numpy(v) for v in (q, qd, qdd)]
    J = forcegp.kinematics.point_jacobian(robot, state[0], "lbr_iiwa_link_7", (0, 0, 0.1))
    tau = forcegp.dynamics.inverse_dynamics(robot, *state) - 20.0 * J[:, 2]
    friction = 0.5 * np.tanh(qd / 0.01) + 0.3 * qd
    noise = 0.02 * np.random.default_rng(0).standard_normal(q.shape)
    return system, {"t": t, "q": q, "qd": qd, "tau": tau.numpy() + friction + noise}


def written(folder: Path, columns: dict[str, np.ndarray], separator: str, decimal: str) -> Path:
    rows = [
        separator.join(repr(float(x)).replace(".", decimal) for x in row)
        for row in zip(*columns.values(), strict=True)
    ]
    (folder / "run.csv").write_text("\n".join([separator.join(columns), *rows]), encoding="utf-8")
    return folder / "run.csv"


def mapping_of(proposal: Draft) -> Mapping:
    return parse_mapping(proposal.toml().encode(), "proposed mapping")


@pytest.mark.parametrize(
    ("angle", "speed", "sign"), [("deg", "deg/s", 1.0), ("rad", "rad/s", -1.0), ("deg", "rpm", -1.0)]
)
def test_units_and_signs_are_found_from_the_values(
    tmp_path: Path, angle: str, speed: str, sign: float
) -> None:
    system, log = kuka_log()
    factor = {"rad": 1.0, "deg": 180.0 / np.pi, "rad/s": 1.0, "deg/s": 180.0 / np.pi, "rpm": 30.0 / np.pi}
    columns = {"Zeit": 1e3 * log["t"]}
    for i in range(7):
        columns[f"Achse{i + 1}_Pos"] = factor[angle] * log["q"][:, i]
        columns[f"Achse{i + 1}_Speed"] = factor[speed] * log["qd"][:, i]
        columns[f"Achse{i + 1}_Torque"] = sign * log["tau"][:, i]
        columns[f"Achse{i + 1}_Temp"] = np.full(ROWS, 30.0 + i)
    path = written(tmp_path, columns, ";", ",")
    proposal = guess.guess_mapping(path, system)
    sections = mapping_of(proposal).sections
    assert sections.time.unit == "ms" and sections.position.unit == angle
    assert sections.velocity is not None and sections.velocity.unit == speed
    assert sections.torque.sign == sign and sections.torque.unit == "Nm"
    assert any("base to tip" in doubt for doubt in proposal.doubts), "numbers are no names"
    # Friction of half a newton metre per joint hides nothing: 20 N show as one state.
    assert sections.contact["table"].source == "always"
    data = read_log(path, system, mapping_of(proposal))
    np.testing.assert_allclose(data.q.numpy(), log["q"], atol=1e-12)
    np.testing.assert_allclose(data.qd.numpy(), log["qd"], atol=1e-12)


@pytest.mark.parametrize("kind", ["rosbag 1", "mcap", "csv", "npz", "lerobot"])
def test_formats_with_names_leave_no_doubt_about_joints(kind: str, tmp_path: Path) -> None:
    path, _ = WRITERS[kind](tmp_path, motion())
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    proposal = guess.guess_mapping(path, system)
    mapping = mapping_of(proposal)
    numbered = kind in ("npz", "lerobot")
    assert any("base to tip" in doubt for doubt in proposal.doubts) == numbered
    if not numbered:
        assert "similarity" not in " ".join(proposal.doubts)
        data = read_log(path, system, mapping)
        np.testing.assert_array_equal(data.q.numpy(), motion().q)


def test_declared_units_are_taken_from_headings() -> None:
    from forcegp.logs.table import Stream

    stream = Stream("", {}, {"pos": "[deg]"})
    names = ("pos", "q1 [rad]", "vel (deg/s)", "tau_Nm", "t_ms", "x", "qd_rad_s", "deg_pan", "q []")
    found = [declared_unit(n, stream) for n in names]
    assert found == ["deg", "rad", "deg/s", "Nm", "ms", None, "rad/s", "deg", None]


def test_logs_whose_columns_say_nothing(tmp_path: Path) -> None:
    system, log = kuka_log()
    with pytest.raises(MappingError, match="no column increases like time"):
        guess.guess_mapping(written(tmp_path, {"a": log["q"][:, 0]}, ",", "."), system)
    path = written(tmp_path, {"t": log["t"], "a": log["q"][:, 0]}, ",", ".")
    proposal = guess.guess_mapping(path, system)
    assert proposal.incomplete == ["position", "torque"]
    assert "# CHECK: no position was recognised" in proposal.toml() and "unused columns: a" in proposal.toml()
    with pytest.raises(MappingError, match=r"m.toml:10: position: joint 'lbr_iiwa_joint_1' has no column"):
        read_log(path, system, parse_mapping(proposal.toml().encode(), "m.toml"))


def two_joints() -> tuple[forcegp.ConstrainedSystem, dict[str, np.ndarray]]:
    """A motion of the double pendulum, torques by inverse dynamics."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    t, rate = np.arange(ROWS) * DT, np.array([3.0, 4.0])
    x = t[:, None] * rate + np.array([0.0, 1.0])
    state = [torch.from_numpy(v) for v in (np.sin(x), rate * np.cos(x), -(rate**2) * np.sin(x))]
    tau = forcegp.dynamics.inverse_dynamics(system.robot, *state).numpy()
    return system, {"t": t, "q": np.sin(x), "qd": rate * np.cos(x), "tau": tau}


@pytest.mark.parametrize(
    ("positions", "torques", "factor", "unit"),
    [
        ("shoulder_pos_deg elbow_pos_deg", "shoulder_trq_Nm elbow_trq_Nm", 1.0, "Nm"),
        ("pan_pos_deg tilt_pos_deg", "u1_Nm u2_Nm", 1.0, "Nm"),
        ("q1_deg q2_deg", "u1_mNm u2_mNm", 1e3, "mNm"),
        ("Shoulder Angle (deg)|Elbow Angle (deg)", "Shoulder Effort [Nm]|Elbow Effort [Nm]", 1.0, "Nm"),
        ("az_deg el_deg", "az_Nm el_Nm", 1.0, "Nm"),
        ("deg_shoulder deg_elbow", "mNm_shoulder mNm_elbow", 1e3, "mNm"),
        ("arm 1 deg|wrist deg", "tau_wide tau_narrow", 1.0, "Nm"),
        ("ang_a[deg] ang_b[deg]", "current_a[mA] current_b[mA]", 1e3, "mA"),
        ("Istwinkel1[deg] Istwinkel2[deg]", "IstDrehmoment1[Nm] IstDrehmoment2[Nm]", 1.0, "Nm"),
    ],
)
def test_names_with_quantities_and_units(
    tmp_path: Path, positions: str, torques: str, factor: float, unit: str
) -> None:
    system, log = two_joints()
    q, tau = (names.split("|" if "|" in names else " ") for names in (positions, torques))
    columns = {"time_ms": 1e3 * log["t"], "temp_degC": np.full(ROWS, 30.0)}
    columns |= {name: np.degrees(log["q"][:, i]) for i, name in enumerate(q)}
    columns |= {name: factor * log["tau"][:, i] for i, name in enumerate(tau)}
    path = written(tmp_path, columns, ",", ".")
    proposal = guess.guess_mapping(path, system)
    sections = mapping_of(proposal).sections
    assert not proposal.incomplete and (sections.position.unit, sections.torque.unit) == ("deg", unit)
    data = read_log(path, system, mapping_of(proposal))
    np.testing.assert_allclose(data.q.numpy(), log["q"], atol=1e-12)
    assert np.corrcoef(data.tau.numpy().T[1], log["tau"].T[1])[0, 1] > 0.99
    assert ("torque constant" in " ".join(proposal.doubts)) == (unit == "mA")


def test_joints_named_like_positions(tmp_path: Path) -> None:
    """Joint names `q1` and `q2` are part of `dq1`, which is not a position."""
    robot = Path(forcegp.__file__).parent / "robot" / "bundled" / "double_pendulum.urdf"
    text = robot.read_text().replace('"shoulder"', '"q1"').replace('"elbow"', '"q2"')
    (tmp_path / "robot.urdf").write_text(text)
    system = forcegp.ConstrainedSystem(forcegp.load_robot(tmp_path / "robot.urdf"))
    assert system.robot.joint_names == ("q1", "q2")
    _, log = two_joints()
    columns = {"t": log["t"]}
    for name in ("q", "qd", "tau"):
        columns |= {f"{name.replace('qd', 'dq')}{i + 1}": log[name][:, i] for i in range(2)}
    path = written(tmp_path, columns, ",", ".")
    proposal = guess.guess_mapping(path, system)
    assert set(proposal.families) == {"position", "velocity", "torque"}
    data = read_log(path, system, mapping_of(proposal))
    for name in ("q", "qd"):
        np.testing.assert_allclose(getattr(data, name).numpy(), log[name], atol=1e-12)


@real_logs
@pytest.mark.slow  # 12,639 rows of seven joints
def test_the_sign_of_a_real_arms_torque() -> None:
    robot = forcegp.load_robot(REAL / "kuka_iiwa14" / "iiwa14.urdf")
    system = forcegp.ConstrainedSystem(robot)
    sections = mapping_of(guess.guess_mapping(REAL / "kuka_iiwa14" / "motion_b", system)).sections
    assert sections.torque.sign == -1.0 and sections.position.unit == "rad" and sections.time.unit == "s"


@real_logs
def test_names_that_are_only_alike_are_matched_and_doubted() -> None:
    robot = next(arm for arm in ARMS if arm.name == "ur3").load()
    proposal = guess.guess_mapping(REAL / "ur3" / "id1.bag", forcegp.ConstrainedSystem(robot))
    joints = mapping_of(proposal).sections.joints
    assert list(joints.values()) == ["Base", "Shoulder", "Elbow", "Wrist 1", "Wrist 2", "Wrist 3"]
    assert any("similarity" in doubt for doubt in proposal.doubts)
    assert mapping_of(proposal).sections.torque.sign == -1.0


def test_the_window_follows_the_noise(tmp_path: Path) -> None:
    """At 1 kHz with noisy encoders, a window of 11 samples leaves accelerations of noise alone."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    t = np.arange(4000) * 1e-3
    x = t[:, None] * np.array([3.0, 4.0]) + np.array([0.0, 1.0])
    q, qd, qdd = np.sin(x), np.array([3.0, 4.0]) * np.cos(x), -np.array([9.0, 16.0]) * np.sin(x)
    tau = forcegp.dynamics.inverse_dynamics(
        system.robot, *(torch.from_numpy(v) for v in (q, qd, qdd))
    ).numpy()
    noisy = q + 1e-4 * np.random.default_rng(0).standard_normal(q.shape)
    columns = {"time": t} | {
        f"{name}_{joint}": values[:, i]
        for name, values in (("position", noisy), ("torque", tau))
        for i, joint in enumerate(system.robot.joint_names)
    }
    path = written(tmp_path, columns, ",", ".")
    proposal = guess.guess_mapping(path, system)
    assert proposal.window > 41 and "cross-validation asks for" in proposal.toml()
    errors = {}
    for window in (11, proposal.window):
        proposal.window = window
        data = read_log(path, system.robot, mapping_of(proposal))
        true = -np.array([9.0, 16.0]) * np.sin(
            data.t.numpy()[:, None] * np.array([3.0, 4.0]) + np.array([0.0, 1.0])
        )
        errors[window] = float(np.sqrt(((data.qdd.numpy() - true)[200:-200] ** 2).mean()))
    assert errors[proposal.window] < 0.1 * errors[11]


def archive(folder: Path, log: dict[str, np.ndarray], **more: np.ndarray) -> Path:
    """A NumPy archive of one array per quantity."""
    np.savez(folder / "run.npz", t=log["t"], q=log["q"], tau=log["tau"], **more)  # type: ignore[arg-type]
    return folder / "run.npz"


def test_derivatives_spelled_with_d_are_no_positions(tmp_path: Path) -> None:
    system, log = kuka_log()
    qdd = np.gradient(log["qd"], DT, axis=0)
    proposal = guess.guess_mapping(archive(tmp_path, log, d_q=log["qd"], d_d_q=qdd), system)
    patterns = {name: family.pattern for name, family in proposal.families.items()}
    assert patterns == {
        "position": "q[{joint}]",
        "velocity": "d_q[{joint}]",
        "acceleration": "d_d_q[{joint}]",
        "torque": "tau[{joint}]",
    }
    assert not any("also available" in doubt for doubt in proposal.doubts)


def test_a_velocity_of_the_other_sign_is_asked_about(tmp_path: Path) -> None:
    system, log = kuka_log()
    turned = log["qd"] * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
    proposal = guess.guess_mapping(archive(tmp_path, log, dq=turned), system)
    assert list(proposal.families["velocity"].sign.values()) == [1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0]  # type: ignore[union-attr]
    assert "# CHECK: the velocity of some joints is minus" in proposal.toml()
    proposal = guess.guess_mapping(archive(tmp_path, log, dq=log["qd"]), system)
    assert not any("minus" in doubt for doubt in proposal.doubts)


def test_a_boolean_array_is_the_state_of_the_contacts(tmp_path: Path) -> None:
    _, log = kuka_log()
    two = forcegp.load_scene("kuka_two_points").system()
    closed = np.stack([log["t"] % 1.0 < 0.5, log["t"] % 0.7 < 0.3], axis=1)
    proposal = guess.guess_mapping(archive(tmp_path, log, contact=closed), two)
    found = {name: table["column"] for name, table in proposal.further.items()}
    assert found == {f"contact.{name}": f"contact[{i}]" for i, name in enumerate(two.contact_names)}
    assert any("in the order of the columns" in doubt for doubt in proposal.doubts)
    one = guess.guess_mapping(archive(tmp_path, log, contact=closed[:, :1]), kuka_log()[0])
    assert one.further["contact.table"] == {"source": "column", "column": "contact"}


@pytest.mark.parametrize("rest", [("q", "qd", "tau"), ("own", "q", "qd", "tau")])
def test_a_file_of_times_that_does_not_fit_is_named(tmp_path: Path, rest: tuple[str, ...]) -> None:
    system, log = kuka_log()
    files = {"time": np.append(log["t"], 9.0)[:, None], "own": log["t"][:, None], **log}
    (tmp_path / "run").mkdir()
    for name in ("time", *rest):
        np.savetxt(tmp_path / "run" / f"{name}.txt", files[name])
    if "own" not in rest:
        with pytest.raises(MappingError, match=r"like time, with 600 rows[\s\S]*time\[0\] \(601 rows\)"):
            guess.guess_mapping(tmp_path / "run", system)
    else:
        proposal = guess.guess_mapping(tmp_path / "run", system)
        assert any("time[0] was left out: 601 rows" in doubt for doubt in proposal.doubts)


def two_joint_csv(folder: Path, time: dict[str, np.ndarray], **more: np.ndarray) -> Path:
    """A log of the double pendulum with the given columns of time, and further columns by name."""
    _, log = two_joints()
    columns = dict(time)
    for name in ("q", "qd", "tau"):
        columns |= {f"{name}_{joint}": log[name][:, i] for i, joint in enumerate(("shoulder", "elbow"))}
    return written(folder, {k: v for k, v in (columns | more).items() if v is not None}, ",", ".")


SECONDS = np.arange(ROWS) * DT
NANOSECONDS = 1_700_000_000_700_000_000 + np.round(1e9 * SECONDS).astype(np.int64)


@pytest.mark.parametrize(
    ("time", "column", "unit"),
    [
        (
            {"stamp.sec": NANOSECONDS // 10**9, "stamp.nanosec": NANOSECONDS % 10**9},
            ["stamp.sec", "stamp.nanosec"],
            ["s", "ns"],
        ),
        (
            {"tv_sec": NANOSECONDS // 10**9, "tv_usec": NANOSECONDS % 10**9 / 1e3},
            ["tv_sec", "tv_usec"],
            ["s", "us"],
        ),
        ({"time": 45987.5 + SECONDS / 86400.0}, "time", "d"),
        ({"time": SECONDS / 3600.0}, "time", "h"),
        ({"time": 1e3 * SECONDS}, "time", "ms"),
        ({"time": NANOSECONDS}, "time", "ns"),
    ],
)
def test_clocks(tmp_path: Path, time: dict[str, np.ndarray], column: object, unit: object) -> None:
    system, _ = two_joints()
    path = two_joint_csv(tmp_path, time)
    proposal = guess.guess_mapping(path, system)
    assert (proposal.time["column"], proposal.time["unit"]) == (column, unit)
    data = read_log(path, system, mapping_of(proposal))
    assert len(data) == ROWS and int(data.segment[-1]) == 0
    assert float(data.t.diff().median()) == pytest.approx(DT, rel=1e-3)


@pytest.mark.parametrize("names", [["Date", "Time"], ["date", "time of day"], ["Datum", "Uhrzeit"]])
def test_a_date_and_a_time_of_day_are_one_clock(tmp_path: Path, names: list[str]) -> None:
    system, _ = two_joints()
    path = two_joint_csv(tmp_path, {"q0": SECONDS})
    lines = path.read_text().splitlines()
    stamps = [86_398.5 + x for x in SECONDS]
    days = ["27.11.2025", "28.11.2025"]
    body = [
        f"{days[int(x // 86400)]},{x % 86400 // 3600:02.0f}:{x % 3600 // 60:02.0f}:{x % 60:06.3f},{line}"
        for x, line in zip(stamps, lines[1:], strict=True)
    ]
    path.write_text("\n".join([f"{names[0]},{names[1]}," + lines[0].replace("q0", "n"), *body]))
    proposal = guess.guess_mapping(path, system)
    assert proposal.time["column"] == names
    data = read_log(path, system, mapping_of(proposal))
    np.testing.assert_allclose(data.t.numpy() - data.t[0].item(), SECONDS, atol=1e-6)


def test_the_velocity_tells_the_unit_of_time(tmp_path: Path) -> None:
    """Steps of 0.06 could be seconds; the velocity in rad/s shows that they are milliseconds."""
    system, log = two_joints()
    fast = 100.0 * log["qd"]
    t = 0.06 * np.arange(ROWS)
    path = two_joint_csv(tmp_path, {"t": t}, qd_shoulder=fast[:, 0], qd_elbow=fast[:, 1])
    proposal = guess.guess_mapping(path, system)
    assert proposal.time["unit"] == "ms" and proposal.families["velocity"].unit == "rad/s"
    assert any("time is in ms, not s" in doubt for doubt in proposal.doubts)


@pytest.mark.parametrize("factor", [1.0, 180.0 / np.pi])
def test_wrapped_angles_are_unwrapped_and_the_velocity_keeps_its_sign(tmp_path: Path, factor: float) -> None:
    system, log = kuka_log()
    q = log["q"] + np.array([3.0, 0, 0, 0, 2.9, 0, 0])
    columns = {"t": log["t"]}
    for i in range(7):
        columns[f"pos_{i + 1}"] = factor * ((q[:, i] + np.pi) % (2.0 * np.pi) - np.pi)
        columns[f"vel_{i + 1}"] = factor * log["qd"][:, i]
        columns[f"trq_{i + 1}"] = log["tau"][:, i]
    path = written(tmp_path, columns, ",", ".")
    proposal = guess.guess_mapping(path, system)
    sections = mapping_of(proposal).sections
    assert sections.position.unwrap and sections.position.unit == ("rad" if factor == 1.0 else "deg")
    assert sections.velocity is not None and sections.velocity.sign == 1.0
    assert any("jump by one turn" in doubt and "pos_1" in doubt for doubt in proposal.doubts)
    data = read_log(path, system, mapping_of(proposal))
    np.testing.assert_allclose(np.diff(data.q.numpy(), axis=0), np.diff(q, axis=0), atol=1e-9)


@pytest.mark.parametrize(
    ("pattern", "kind"),
    [
        ("target_moment_{}", "a command ('target')"),
        ("tau{}_cmd", "a command ('cmd')"),
        ("u{}", "a command ('u')"),
        ("tau_J_d_{}", "a command ('d')"),
        ("tauref{}", "a command ('ref')"),
        ("SollMoment{}", "a command ('soll')"),
        ("desiredTorque{}", "a command ('desired')"),
        ("tau_ext_hat_filtered_{}", "the output of a model ('ext')"),
        ("model_torque_{}", "the output of a model ('model')"),
    ],
)
@pytest.mark.parametrize("alone", [True, False])
def test_commands_and_model_outputs_are_no_measurements(
    tmp_path: Path, pattern: str, kind: str, alone: bool
) -> None:
    system, log = two_joints()
    columns = {"t": log["t"]} | {f"q{i + 1}": log["q"][:, i] for i in range(2)}
    columns |= {pattern.format(i + 1): log["tau"][:, i] for i in range(2)}
    if not alone:
        columns |= {f"effort{i + 1}": log["tau"][:, i] for i in range(2)}
    proposal = guess.guess_mapping(written(tmp_path, columns, ",", "."), system)
    chosen = list(proposal.families["torque"].columns.values())
    assert chosen == [(pattern if alone else "effort{}").format(i + 1) for i in range(2)]
    marked = any(
        f"is named like {kind}, which is not a measured torque" in doubt for doubt in proposal.doubts
    )
    assert marked == alone


def test_arrays_with_an_axis_of_length_one_and_what_the_reader_leaves_out(tmp_path: Path) -> None:
    import h5py

    system, log = two_joints()
    flat = {name: log[name].T[:, None, :] for name in ("q", "qd", "tau")}
    np.savez(tmp_path / "run.npz", t=log["t"], **flat)
    proposal = guess.guess_mapping(tmp_path / "run.npz", system)
    np.testing.assert_array_equal(read_log(tmp_path / "run.npz", system, mapping_of(proposal)).q, log["q"])
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, values in {"t": log["t"], **flat}.items():
            file[name] = values
    proposal = guess.guess_mapping(tmp_path / "run.h5", system)
    np.testing.assert_array_equal(read_log(tmp_path / "run.h5", system, mapping_of(proposal)).q, log["q"])
    cube = np.stack([log["tau"].T, log["tau"].T], axis=1)
    np.savez(tmp_path / "cube.npz", t=log["t"], q=log["q"], tau=cube)
    proposal = guess.guess_mapping(tmp_path / "cube.npz", system)
    omitted = f"'tau' of shape (2, 2, {ROWS}) and type float64 was left out"
    assert omitted in proposal.toml() and any(omitted in doubt for doubt in proposal.doubts)
    assert "unused columns: (none)" in " ".join(proposal.doubts)
    text = proposal.toml().replace('columns = { shoulder = "", elbow = "" }', 'column = "tau[{joint}]"')
    mapping = parse_mapping(text.encode(), "m.toml")
    with pytest.raises(DataError, match=r"the log has no column 'tau\[0\]'; not read: 'tau' of shape"):
        read_log(tmp_path / "cube.npz", system, mapping)


def test_a_joint_without_torque_is_proposed_as_unmeasured(tmp_path: Path) -> None:
    system, log = two_joints()
    columns = (
        {"t": log["t"]} | {f"q{i + 1}": log["q"][:, i] for i in range(2)} | {"effort2": log["tau"][:, 1]}
    )
    path = written(tmp_path, columns, ",", ".")
    proposal = guess.guess_mapping(path, system)
    assert not proposal.incomplete and proposal.families["torque"].unmeasured == ["shoulder"]
    assert any("no torque of shoulder" in doubt for doubt in proposal.doubts)
    data = read_log(path, system, mapping_of(proposal))
    np.testing.assert_allclose(data.q.numpy(), log["q"], atol=1e-12)
    assert data.header.unmeasured_torques == ("shoulder",)


@pytest.mark.parametrize(
    ("pattern", "factor", "unit"), [("pos_rad_m{}", 1.0, "rad"), ("pos_m{}", 57.3, "deg")]
)
def test_units_of_positions_without_torques(tmp_path: Path, pattern: str, factor: float, unit: str) -> None:
    system, log = kuka_log()
    columns = {"t": log["t"]} | {pattern.format(i + 1): factor * log["q"][:, i] for i in range(7)}
    proposal = guess.guess_mapping(written(tmp_path, columns, ",", "."), system)
    assert proposal.incomplete == ["torque"] and proposal.families["position"].unit == unit
    assert not any("rad was assumed" in doubt for doubt in proposal.doubts)


@pytest.mark.parametrize("period", [0.002, 0.0008, 0.001])
def test_the_window_is_at_most_60_ms(period: float) -> None:
    from forcegp.logs.table import Signals

    t = np.arange(4000) * period
    noise = np.random.default_rng(0).standard_normal((4000, 1))
    trial = Signals(
        ("a",), t, np.arange(4000), np.zeros(4000, np.int64), {"q": np.sin(t)[:, None] + 0.1 * noise}
    )
    draft = Draft("log")
    guess._window(draft, trial)
    assert draft.window % 2 == 1 and 0.055 < draft.window * period <= 0.06 + 1e-12


@pytest.mark.parametrize("late", [True, False])
def test_the_first_messages_decide_nothing(tmp_path: Path, late: bool) -> None:
    """Torques that start late, and messages of a gripper before those of the arm."""
    import forcegp.logs.mapping as of_mapping
    from log_files import joint_state_bag

    m = motion()
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    path = joint_state_bag(tmp_path, m, late)
    mapping = of_mapping.default_mapping(path, system)
    assert mapping.sections.torque.column == "effort.{joint}" and mapping.sections.velocity is None
    proposal = guess.guess_mapping(path, system)
    assert proposal.time.get("missing") == ("drop" if late else None)
    data = read_log(path, system, mapping_of(proposal))
    assert len(data) == len(m.t) - 20 * late
    np.testing.assert_allclose(data.q.numpy(), m.q[20 * late :], atol=1e-12)
