"""From each format to a data set, and real logs with one call each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import DataError, MappingError
from forcegp.logs import import_log, parse_mapping, read_log
from log_files import REAL, WRITERS, Motion, motion, real_logs, write_csv
from robots import ARMS

NANOSECOND = 1e-9
"""Resolution of the stamps of ROS messages."""


@pytest.fixture
def robot() -> forcegp.RobotModel:
    return forcegp.load_robot("double_pendulum")


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_gives_the_values_that_were_written(
    kind: str, tmp_path: Path, robot: forcegp.RobotModel
) -> None:
    m = motion()
    path, toml = WRITERS[kind](tmp_path, m)
    data = read_log(path, robot, parse_mapping(toml.encode(), "mapping.toml"))
    assert data.joint_names == ("shoulder", "elbow")
    np.testing.assert_array_equal(data.q.numpy(), m.q)
    np.testing.assert_array_equal(data.qd.numpy(), m.qd)
    if kind == "lerobot":
        assert data.segment.tolist() == [0] * 150 + [1] * 150
    else:
        np.testing.assert_allclose(data.t.numpy(), m.t, rtol=0.0, atol=NANOSECOND)
    # q̈ of the motion is −ω² q; the filter's bias at 11 samples is below 1 %, more at the ends.
    acceleration = -np.array([4.0, 9.0]) * m.q
    inner = np.r_[6:144, 156:294] if kind == "lerobot" else np.r_[6:294]
    np.testing.assert_allclose(data.qdd.numpy()[inner], acceleration[inner], atol=0.01)
    out = tmp_path / "log.parquet"
    data.write(out)
    again = forcegp.Dataset.read(out)
    assert torch.equal(again.q, data.q) and torch.equal(again.qdd_std, data.qdd_std)
    assert again.header.robot_fingerprint == robot.fingerprint


@pytest.mark.parametrize("kind", ["rosbag 1", "rosbag 2", "mcap"])
def test_a_joint_state_with_the_robots_names_needs_no_mapping(
    kind: str, tmp_path: Path, robot: forcegp.RobotModel
) -> None:
    path, _ = WRITERS[kind](tmp_path, motion())
    assert len(read_log(path, robot)) == 300


def test_a_data_set_is_imported_without_a_mapping(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    path, toml = write_csv(tmp_path, motion())
    data = read_log(path, robot, parse_mapping(toml.encode(), "mapping.toml"))
    data.write(tmp_path / "log.parquet")
    again = read_log(tmp_path / "log.parquet", robot)
    assert torch.equal(again.q, data.q) and torch.equal(again.qdd, data.qdd)


def test_columns_without_a_meaning_are_refused(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    path, _ = write_csv(tmp_path, motion())
    with pytest.raises(MappingError, match=r"quantities of the columns(?s:.*)q.shoulder(?s:.*)--guess"):
        read_log(path, robot)


def test_units_signs_gears_and_currents(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    m = motion()
    ratio, constant = 100.0, 0.05
    raw = Motion(
        1e3 * m.t,
        np.degrees(m.q) * ratio + 7.0,
        np.degrees(m.qd),
        -m.tau / (ratio * constant) * 1e3 + np.array([3.0, 0.0]),
    )
    path, toml = write_csv(tmp_path, raw)
    for before, after in (
        ('column = "t"', 'column = "t"\nunit = "ms"'),
        ('unit = "rad"\n', f'unit = "deg"\nside = "motor"\ngear_ratio = {ratio}\noffset = 7.0\n'),
        ('unit = "rad/s"', 'unit = "deg/s"'),
        ('unit = "Nm"', f'unit = "mA"\nside = "motor"\nsign = -1\ntorque_constant = {constant}\n'
         f"gear_ratio = {{ shoulder = {ratio}, elbow = {ratio} }}\noffset = {{ shoulder = 3, elbow = 0 }}"),
    ):  # fmt: skip
        assert before in toml
        toml = toml.replace(before, after)
    toml += "[derivatives]\nfilter_torque = false\n"
    data = read_log(path, robot, parse_mapping(toml.encode(), "mapping.toml"))
    for name in ("t", "q", "qd", "tau"):
        # Rounding of a product of five factors, on values up to 15.
        np.testing.assert_allclose(getattr(data, name).numpy(), getattr(m, name), rtol=0.0, atol=1e-13)


def test_a_joint_without_a_torque_sensor_is_named(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    """Its torque is 0 in the data set, whose header says so also after it was written."""
    m = motion()
    path, toml = write_csv(tmp_path, m)
    lacking = toml.replace('unit = "Nm"', 'unit = "Nm"\nunmeasured = ["shoulder"]')
    path.write_text(path.read_text().replace("tau_shoulder", "other"))
    data = read_log(path, robot, parse_mapping(lacking.encode(), "mapping.toml"))
    assert not bool(data.tau[:, 0].any())
    data.write(tmp_path / "log.parquet")
    assert forcegp.Dataset.read(tmp_path / "log.parquet").header.unmeasured_torques == ("shoulder",)
    unknown = lacking.replace('["shoulder"]', '["knee"]')
    with pytest.raises(MappingError, match="'knee' is not a joint of the robot"):
        read_log(path, robot, parse_mapping(unknown.encode(), "mapping.toml"))


def test_joints_are_matched_by_name_and_not_by_order(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    m = motion()
    path, toml = write_csv(tmp_path, m)
    swapped = toml.replace("[joints]\n", '[joints]\nelbow = "shoulder"\nshoulder = "elbow"\n')
    data = read_log(path, robot, parse_mapping(swapped.encode(), "mapping.toml"))
    np.testing.assert_array_equal(data.q.numpy(), m.q[:, ::-1])


def test_position_only_logs_get_velocity_and_acceleration(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    m = motion()
    path, toml = write_csv(tmp_path, m)
    a, b = toml.index("[velocity]"), toml.index("[torque]")
    data = read_log(path, robot, parse_mapping((toml[:a] + toml[b:]).encode(), "mapping.toml"))
    assert data.header.filter_span == pytest.approx(11.0 * data.header.dt), "the default window"
    inner = slice(6, -6)
    # Bias of a cubic over 11 samples at 3 rad/s.
    np.testing.assert_allclose(data.qd.numpy()[inner], m.qd[inner], atol=1e-3)
    np.testing.assert_allclose(data.qdd.numpy()[inner], -np.array([4.0, 9.0]) * m.q[inner], atol=0.05)


def test_the_report_says_what_was_done(tmp_path: Path, robot: forcegp.RobotModel) -> None:
    path, toml = write_csv(tmp_path, motion())
    seen: list[tuple[int, int]] = []
    imported = import_log(
        path,
        robot,
        parse_mapping(toml.encode(), "m.toml"),
        progress=lambda done, total: seen.append((done, total)),
    )
    assert imported.report.format == "text" and imported.report.rows_read == 300
    assert any("Savitzky-Golay" in step for step in imported.data.header.provenance)
    assert seen[-1][0] == seen[-1][1] == path.stat().st_size
    assert imported.data.header.filtered


def test_a_log_that_holds_accelerations_is_not_said_to_be_filtered(
    tmp_path: Path, robot: forcegp.RobotModel
) -> None:
    m = motion()
    head = ",".join(["t", *(f"{name}.{joint}" for name in ("q", "qd", "qdd", "tau") for joint in (1, 2))])
    path = tmp_path / "run.csv"
    table = np.column_stack([m.t, m.q, m.qd, -np.array([4.0, 9.0]) * m.q, m.tau])
    np.savetxt(path, table, delimiter=",", header=head, comments="")
    toml = """
    time = { column = "t" }
    joints = { shoulder = "1", elbow = "2" }
    position = { column = "q.{joint}", unit = "rad" }
    velocity = { column = "qd.{joint}", unit = "rad/s" }
    acceleration = { column = "qdd.{joint}", unit = "rad/s2" }
    torque = { column = "tau.{joint}", unit = "Nm" }
    """
    assert not read_log(path, robot, parse_mapping(toml.encode(), "m.toml")).header.filtered


def ur(name: str) -> forcegp.RobotModel:
    return next(arm for arm in ARMS if arm.name == name).load()


@real_logs
def test_the_bag_and_the_matlab_file_of_one_motion_are_one_data_set() -> None:
    robot = ur("ur3")
    bag = read_log(REAL / "ur3" / "id1.bag", robot, "ur3_bag")
    mat = read_log(REAL / "ur3" / "id1.mat", robot, "ur3_mat")
    assert len(bag) == len(mat) == 5199 and torch.equal(bag.t, mat.t)
    for name in ("q", "qd", "tau", "qdd", "qdd_std"):
        # The stamps of the two files agree to 7e-15 s, which the uneven clock's interpolation amplifies.
        torch.testing.assert_close(getattr(bag, name), getattr(mat, name), rtol=0.0, atol=1e-10)


@real_logs
def test_a_bare_ros2_file() -> None:
    data = read_log(REAL / "ros2" / "ur10_exciting_trajectory.db3", ur("ur10"))
    assert len(data) == 3441 and data.header.dt == pytest.approx(0.008)
    assert data.q[0, 0] == pytest.approx(0.61977826) and data.q[0, 2] == pytest.approx(1.66889345)


@real_logs
@pytest.mark.slow  # restarting clocks of written files: test_clock.py
@pytest.mark.parametrize(("folder", "rows", "segments"), [("motion_a", 36143, 10), ("motion_b", 12639, 4)])
def test_a_folder_of_text_files_with_restarting_clocks(folder: str, rows: int, segments: int) -> None:
    robot = forcegp.load_robot(REAL / "kuka_iiwa14" / "iiwa14.urdf")
    place = REAL / "kuka_iiwa14" / folder
    data = read_log(place, robot, "iiwa14_txt")
    assert len(data) == rows and int(data.segment[-1]) + 1 == segments
    torque = np.loadtxt(place / "joint_torque_measured.txt")
    np.testing.assert_array_equal(data.tau.numpy(), -torque)


@real_logs
@pytest.mark.parametrize("run", ["143339", "143524", "143601", "143704"])
def test_a_double_pendulum_with_an_uneven_clock(run: str, tmp_path: Path) -> None:
    folder = REAL / "double_pendulum" / "design_C.1"
    text = (folder / "model_1.1.urdf").read_text()
    if '<link name="world"' not in text:
        text = text.replace('<link name="base_link">', '<link name="world"/>\n<link name="base_link">', 1)
    (tmp_path / "model.urdf").write_text(text)
    robot = forcegp.load_robot(tmp_path / "model.urdf")
    data = read_log(folder / f"20230629-{run}.csv", robot, "double_pendulum_csv")
    raw = np.genfromtxt(folder / f"20230629-{run}.csv", delimiter=",", names=True)
    assert len(data) >= 4990
    interpolated = np.interp(data.t.numpy(), raw["time"], raw["tau_meas2"])
    assert data.tau.shape == (len(data), 2) and np.isfinite(interpolated).all()
    position = np.interp(data.t.numpy(), raw["time"], raw["pos_meas1"])
    # Between samples 2 ms apart, spline and straight line differ by the encoder's steps.
    assert np.abs(data.q.numpy()[:, 0] - position).max() < 2e-3


def test_a_log_that_is_not_there(robot: forcegp.RobotModel, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such log"):
        read_log(tmp_path / "nothing.csv", robot, "ros_joint_states")
