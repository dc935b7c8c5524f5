"""The data set: what it refuses, its operations, and files of every sort of damage."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

import forcegp
from forcegp import limits
from forcegp.data import DataHeader, Dataset, NotLoggedError, RobotMismatchWarning
from forcegp.data.table import IgnoredColumnsWarning
from forcegp.errors import DataError, UnknownNameError
from logs import JOINTS, random_log


def same(a: Dataset, b: Dataset) -> bool:
    """Whether two data sets hold the same numbers under the same names."""
    plain = all(
        torch.equal(getattr(a, name), getattr(b, name)) for name in ("t", "segment", "q", "qd", "tau")
    )
    groups = [(a.contact, b.contact), (a.extras, b.extras)]
    groups += [(a.contact_extras[name], b.contact_extras[name]) for name in a.contact_extras]
    named = all(x.keys() == y.keys() and all(torch.equal(x[k], y[k]) for k in x) for x, y in groups)
    return plain and torch.equal(a.qdd, b.qdd) and named and a.joint_names == b.joint_names


def test_what_is_written_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    log = random_log(segments=3)
    log.write(tmp_path / "log.parquet")
    back = Dataset.read(tmp_path / "log.parquet")
    assert same(log, back)
    assert back.contact_extras.keys() == {"multiplier", "F_I"}
    assert back.header.provenance == ("drawn",) and back.header.noise_std == 0.1
    assert back.header.joint_names == JOINTS and back.header.contact_names == ("table",)


def test_reading_in_another_precision(tmp_path: Path) -> None:
    log = random_log()
    log.to(dtype=torch.float32).write(tmp_path / "log.parquet")
    assert Dataset.read(tmp_path / "log.parquet").dtype == torch.float64
    assert same(Dataset.read(tmp_path / "log.parquet", dtype=torch.float32), log.to(dtype=torch.float32))


def test_extras_are_attributes_and_what_is_not_logged_says_so() -> None:
    log = random_log()
    assert log.Q_z is log.extras["Q_z"]
    assert log.multiplier["table"] is log.contact_extras["multiplier"]["table"]
    assert not hasattr(log, "Q_I")
    with pytest.raises(
        NotLoggedError, match=r"'Q_I' is not logged.*\n  expected: one of q, .*Q_z, multiplier"
    ):
        _ = log.Q_I


def test_rows_by_slice_mask_and_indices() -> None:
    log = random_log(10)
    assert torch.equal(log[2:5].q, log.q[2:5])
    assert torch.equal(log[log.t > 0.02].tau, log.tau[log.t > 0.02])
    picked = log[[7, 0, -1]]
    assert torch.equal(picked.F_I["table"], log.F_I["table"][[7, 0, 9]])
    assert log[2:5].header.ordered and not picked.header.ordered
    assert len(log[[]]) == 0


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (torch.ones(3, dtype=torch.bool), "mask and the data set differ in length"),
        ([0, 10], "no such row\n  expected: 0 to 9\n  got: 10"),
        ([-11], "no such row"),
        ([0.5], "a slice, a mask or a list"),
        (3, "a slice, a mask or a list"),
        (["a"], "a slice, a mask or a list"),
        ("t", "a slice, a mask or a list"),
    ],
)
def test_rows_that_do_not_exist(rows: object, message: str) -> None:
    with pytest.raises(DataError, match=message):
        random_log(10)[rows]


def test_selecting_joints_reorders_every_joint_vector() -> None:
    log = random_log()
    turned = log.select(("wrist", "shoulder"))
    assert turned.joint_names == ("wrist", "shoulder") == turned.header.joint_names
    assert torch.equal(turned.Q_z, log.Q_z[:, [2, 0]]) and torch.equal(turned.qdd, log.qdd[:, [2, 0]])
    with pytest.raises(UnknownNameError, match="did you mean 'wrist'"):
        log.select(("wirst",))


def test_rows_in_any_order_make_a_data_set_of_points() -> None:
    """Selecting points needs no header: the data set itself records that time does not increase."""
    log = random_log(segments=2)
    assert log[3:].header.ordered and log[[1, 4, 7]].header.ordered
    assert same(log[::-1], log[list(range(len(log)))[::-1]])
    for points in (log[[7, 4, 1]], log[::-1], log[[2, 2]], log[[5, 1, 3]][torch.tensor([0, 1])]):
        assert not points.header.ordered
    order = torch.arange(len(log) - 1, -1, -1)
    fields = {name: getattr(log, name)[order] for name in ("t", "q", "qd", "tau", "qdd", "segment")}
    again = log[[7, 0, 3]].in_time_order()
    assert again.header.ordered and torch.equal(again.t, log.t[[0, 3, 7]])
    twice = log[[7, 0, 7]].in_time_order()
    assert not twice.header.ordered and torch.equal(twice.t, log.t[[0, 7, 7]])
    with pytest.raises(DataError, match=r"'t' does not increase(.|\n)*data\[rows\](.|\n)*ordered=False"):
        Dataset(**fields, joint_names=log.joint_names)
    points = Dataset(**fields, joint_names=log.joint_names, header=DataHeader(ordered=False))
    assert torch.equal(points.q, log[::-1].q)


def test_the_summary_is_short_and_true() -> None:
    log = random_log(segments=3)
    text = repr(log)
    closed = float(log.contact["table"].double().mean())
    parts = [log.t[log.segment == k] for k in range(3)]
    seconds = sum(float(t.max() - t.min()) for t in parts)
    assert text.startswith(
        f"<Dataset of 'arm': {len(log)} samples of {log.nq} joints; {seconds:.4g} s in 3 seg"
    )
    assert f"contact table ({closed:.0%} closed)" in text and text.endswith("; float64 on cpu>")
    assert all(name in text for name in (*log.extras, *log.contact_extras))
    assert len(text) < 250 and "tensor" not in text
    assert "2 samples of" in repr(log[[4, 1]]) and "not in time order" in repr(log[[4, 1]])
    assert repr(log[:0]).startswith("<Dataset of 'arm': 0 samples")
    assert repr(log.replace(header=DataHeader())).startswith(f"<Dataset: {len(log)} samples")


def test_concatenation_keeps_segments_apart() -> None:
    a, b = random_log(10, segments=2), random_log(5, seed=1)
    joined = Dataset.concatenate([a, b, a])
    assert joined.segment.tolist() == [0] * 5 + [1] * 5 + [2] * 5 + [3] * 5 + [4] * 5
    assert torch.equal(joined.q, torch.cat([a.q, b.q, a.q]))
    assert joined.header.noise_std == 0.1 and joined.header.seed is None
    with pytest.raises(DataError, match="extras of data set 1 differ"):
        Dataset.concatenate([a, b.replace(extras={})])
    with pytest.raises(DataError, match="no data sets to concatenate"):
        Dataset.concatenate([])


def replaced(name: str, row: int, value: float) -> Callable[[], Dataset]:
    def make() -> Dataset:
        log = random_log()
        column = getattr(log, name).clone()
        column[(row, 1) if column.ndim == 2 else row] = value
        return log.replace(**{name: column})

    return make


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (replaced("qdd", 7, float("nan")), r"column 'qdd.elbow' holds nan in row 7"),
        (replaced("tau", 0, float("inf")), r"column 'tau.elbow' holds inf in row 0"),
        (replaced("t", 9, 0.0), r"column 't' does not increase in row 9\n  expected: more than 0.0333"),
        (lambda: random_log().replace(segment=torch.arange(60) % 2), "rows of segment 0 are not contiguous"),
        (lambda: random_log().replace(q=torch.zeros(60, 2, dtype=torch.float64)), r"'q' has the wrong shape"),
        (lambda: random_log().replace(qd=torch.zeros(60, 3)), "'qd' is of another type"),
        (
            lambda: random_log().replace(contact={"table": torch.zeros(60)}),
            "'contact.table' has the wrong type",
        ),
        (lambda: random_log().replace(contact={}), "'multiplier' is logged for contact 'table'"),
        (lambda: random_log().replace(extras={"qd": torch.zeros(60, 3).double()}), "'qd' cannot be the name"),
        (lambda: random_log().replace(extras={"a.b": torch.zeros(60, 3).double()}), "'a.b' cannot be"),
        (lambda: random_log().replace(extras={"F_I": torch.zeros(60, 3).double()}), "'F_I' cannot be"),
        (lambda: random_log().replace(joint_names=("a", "a", "b")), "joint names are not valid"),
        (
            lambda: random_log().replace(contact={"elbow": torch.ones(60).bool()}, contact_extras={}),
            "name of a joint and of a contact",
        ),
    ],
)
def test_what_a_data_set_refuses(make: Callable[[], Dataset], message: str) -> None:
    with pytest.raises(DataError, match=message):
        make()


def test_robot_check_names_the_joint_and_reports_another_robot() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    log = random_log(joints=robot.joint_names)
    log.check_robot(robot)
    with pytest.raises(DataError, match=r"call data.select\(robot.joint_names\)"):
        log.select(robot.joint_names[::-1]).check_robot(robot)
    with pytest.raises(
        DataError, match=r"(?s)joint 'lbr_iiwa_joint_1' of robot .*is 'lbr_iiwa_joint1' in the data"
    ):
        log.replace(joint_names=("lbr_iiwa_joint1", *robot.joint_names[1:])).check_robot(robot)
    foreign = log.replace(header=log.header.model_copy(update={"robot_fingerprint": "0123"}))
    with pytest.warns(RobotMismatchWarning, match="kinematics, base or gravity differ"):
        foreign.check_robot(robot)


def test_a_log_is_one_trajectory_unless_it_says_otherwise() -> None:
    zero = torch.zeros(4, 1, dtype=torch.float64)
    t = torch.arange(4, dtype=torch.float64)
    log = Dataset(t=t, q=zero, qd=zero, tau=zero, qdd=zero, joint_names=("a",))
    assert log.segment.tolist() == [0] * 4 and log.segment.dtype == torch.int64


def test_contacts_as_a_table_and_the_missing_one() -> None:
    log = random_log()
    assert torch.equal(log.active(["table"])[:, 0], log.contact["table"])
    assert log.active([]).shape == (60, 0)
    with pytest.raises(DataError, match=r"column 'contact.wall' is missing"):
        log.active(["wall"])


def rewrite(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    pq.write_table(change(pq.read_table(path)), path)


def renamed(old: str, new: str) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.rename_columns([new if name == old else name for name in table.column_names])


def column(name: str, values: object) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.set_column(table.column_names.index(name), name, pa.array(values))


def header(text: bytes) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.replace_schema_metadata({b"forcegp": text})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            renamed("qd.elbow", "qd.elbwo"),
            r"column 'qd.elbow' is missing(?s:.*)did you mean column 'qd.elbwo'",
        ),
        (renamed("t", "time"), "column 't' is missing"),
        (renamed("Q_z.wrist", "Q_z.wirst"), "column 'Q_z.wrist' is missing"),
        (lambda table: table.drop_columns([f"qdd.{j}" for j in JOINTS]), "SavitzkyGolay"),
        (
            column("q.elbow", [1.0] * 59 + [None]),
            "column 'q.elbow' has 1 missing values, the first in row 59",
        ),
        (column("q.elbow", [1.0] * 59 + [float("nan")]), "column 'q.elbow' holds nan in row 59"),
        (column("contact.table", [0.5] * 60), "'contact.table' is not a flag in row 0"),
        (column("segment", [0.5] * 60), "'segment' is not a trajectory number in row 0"),
        (column("q.elbow", ["a"] * 60), "column 'q.elbow' is missing"),
        (header(b'{"format": "forcegp-dataset", "version": 2}'), "version 2"),
        (header(b"not json"), "not JSON"),
        (header(b'{"format": "forcegp-dataset", "version": 1, "dt": "x"}'), "header field 'dt'"),
    ],
)
@pytest.mark.filterwarnings("ignore::forcegp.data.table.IgnoredColumnsWarning")
def test_files_that_are_no_valid_log(
    tmp_path: Path, change: Callable[[pa.Table], pa.Table], message: str
) -> None:
    path = tmp_path / "log.parquet"
    random_log().write(path)
    rewrite(path, change)
    with pytest.raises(DataError, match=message) as caught:
        Dataset.read(path)
    assert str(path) in str(caught.value)


def test_missing_files_and_other_kinds(tmp_path: Path) -> None:
    random_log().write(tmp_path / "log.parquet")
    with pytest.raises(DataError, match=r"no such file\n  hint: did you mean .*log.parquet"):
        Dataset.read(tmp_path / "lgo.parquet")
    (tmp_path / "log.pkl").write_bytes(b"")
    with pytest.raises(DataError, match="this type of data file is not supported"):
        Dataset.read(tmp_path / "log.pkl")
    with pytest.raises(DataError, match=r"end the name in .parquet"):
        random_log().write(tmp_path / "log.csv")


def test_a_file_that_claims_to_be_huge_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.parquet"
    columns = pa.table({"t": pa.array(np.zeros(2_000_000))})
    pq.write_table(columns, path)  # runs of equal values: some kilobytes on disk
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(limits, "FREE_TABLE_BYTES", 1_000_000)
    with pytest.raises(DataError, match="declared size of the file exceeds"):
        Dataset.read(path)


def test_damaged_files_are_data_errors_and_nothing_else(tmp_path: Path) -> None:
    path, rng = tmp_path / "log.parquet", random.Random(0)
    random_log(20).write(path)
    whole = path.read_bytes()
    refused = 0
    for case in range(400):
        damaged = bytearray(whole)
        if case % 2:
            damaged = damaged[: rng.randrange(len(whole))]
        else:
            for _ in range(rng.randint(1, 8)):
                damaged[rng.randrange(len(whole))] = rng.randrange(256)
        path.write_bytes(damaged)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", IgnoredColumnsWarning)
                Dataset.read(path)
        except DataError:
            refused += 1
    # Every truncated file is refused; a flipped byte may fall into numbers or padding.
    assert refused >= 200


def test_csv_log_with_its_accelerations_computed(tmp_path: Path) -> None:
    t = np.arange(200) / 100.0
    rows = ["t,q.a,tau.a,comment", *(f"{x!r},{float(np.sin(3 * x))!r},0.0,fine" for x in t.tolist())]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    with pytest.warns(IgnoredColumnsWarning, match="comment"):
        log = Dataset.read(tmp_path / "log.csv", differentiate=forcegp.data.SavitzkyGolay(window=11, order=4))
    # Bias of a quartic fitted to a sine over ±0.05 s.
    assert float((log.qd[:, 0] - torch.cos(3 * log.t) * 3).abs().max()) < 1e-3
    assert float((log.qdd[:, 0] + torch.sin(3 * log.t) * 9).abs().max()) < 0.1
    assert "qd and qdd" in log.header.provenance[0]
    assert log.header.noise_std is not None and log.qdd_std.shape == (200, 1)
    (tmp_path / "bad.csv").write_text("t,q.a\n1,2,3\n")
    with pytest.raises(DataError, match="cannot be read as CSV"):
        Dataset.read(tmp_path / "bad.csv")
