"""Logs are read as they are, broken or not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from forcegp.checks import log_of, read_log
from forcegp.checks.log import of_robot
from forcegp.errors import DataError, UnknownNameError
from forcegp.robot import load_robot
from logs import random_log


@pytest.fixture
def file(tmp_path: Path) -> Path:
    random_log(300, segments=2).write(tmp_path / "run.parquet")
    return tmp_path / "run.parquet"


def change(file: Path, name: str, values: pa.Array) -> None:
    table = pq.read_table(file)
    pq.write_table(table.set_column(table.column_names.index(name), name, values), file)


def test_a_data_set_and_its_file_give_the_same_log(file: Path) -> None:
    read, made = read_log(file), log_of(random_log(300, segments=2))
    for name in ("t", "q", "qd", "qdd", "tau", "segment"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    assert [(s.start, s.stop) for s in read.stretches] == [(0, 150), (150, 300)]
    assert read.header.noise_std == 0.1 and list(read.contact) == ["table"]


def test_empty_values_become_nan(file: Path) -> None:
    values = [float(k) for k in range(300)]
    change(file, "q.elbow", pa.array([None if k == 7 else v for k, v in enumerate(values)]))
    log = read_log(file)
    assert np.flatnonzero(~log.finite).tolist() == [7]
    assert [(s.start, s.stop) for s in log.stretches] == [(8, 150), (150, 300)]


def test_missing_derivatives_are_computed(tmp_path: Path) -> None:
    t = np.arange(500) / 250.0
    columns = {"t": t, "q.a": np.sin(2.0 * t), "tau.a": 0.0 * t}
    pq.write_table(pa.table(columns), tmp_path / "q.parquet")
    log = read_log(tmp_path / "q.parquet")
    assert log.derived == {"qd", "qdd"}
    # A cubic over 0.1 s follows a sine at 2 rad/s to (0.2)⁴.
    np.testing.assert_allclose(log.qd[:, 0], 2.0 * np.cos(2.0 * t), atol=2e-3)
    np.testing.assert_allclose(log.qdd[50:-50, 0], -4.0 * np.sin(2.0 * t)[50:-50], atol=2e-2)


def test_joints_are_matched_by_name() -> None:
    robot = load_robot("double_pendulum")
    log = log_of(random_log(20, joints=(*reversed(robot.joint_names), "gripper")))
    matched = of_robot(log, robot)
    assert matched.joint_names == robot.joint_names
    np.testing.assert_array_equal(matched.tau, log.tau[:, [1, 0]])
    with pytest.raises(DataError, match=r"is not in the data"):
        of_robot(log_of(random_log(20, joints=("elbow", "wrist"))), robot)


def test_an_unknown_kind_is_refused() -> None:
    from forcegp.checks import Finding

    with pytest.raises(UnknownNameError, match="did you mean 'time-gap'"):
        Finding("time-gab", "", ((0, 1),))
