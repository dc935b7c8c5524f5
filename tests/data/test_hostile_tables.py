"""Files that are small on disk and huge in memory, slow to read, or of another kind than their name says."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from forcegp.data import Dataset
from forcegp.data.table import IgnoredColumnsWarning
from forcegp.errors import DataError
from logs import random_log

SLOW = 5.0
"""Seconds: what no refusal may take, on a busy machine."""
MEMORY = 1 << 30
"""Bytes: what reading may add to an idle process."""

READ = """
import re, sys, warnings
from pathlib import Path
from forcegp.data import Dataset
from forcegp.errors import DataError
import pyarrow.csv, pyarrow.parquet # what is measured is the file, not the libraries
warnings.simplefilter("ignore")
def peak(): # not ru_maxrss, which a child inherits from the process that started it
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
before = peak()
try:
    Dataset.read(sys.argv[1]); print("read")
except DataError as error:
    print("refused")
print((peak() - before) * 1024)
"""


def read_elsewhere(path: Path) -> tuple[str, int]:
    """What came of reading in a process of its own, and the memory that it added [bytes]."""
    done = subprocess.run(
        [sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True, timeout=60
    )
    outcome, memory = done.stdout.split()
    return outcome, int(memory)


def valid_columns(rows: int = 60) -> pa.Table:
    zero = pa.array(np.zeros(rows))
    return pa.table(
        {"t": pa.array(np.arange(rows) * 0.01), **{f"{x}.a": zero for x in ("q", "qd", "tau", "qdd")}}
    )


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="peak memory is read from /proc")
def test_a_list_column_is_left_out_without_being_unpacked(tmp_path: Path) -> None:
    """50 million zeros in some kilobytes."""
    rows, each = 60, 10_000_000
    path = tmp_path / "bomb.parquet"
    table = valid_columns(rows)
    schema = table.schema.append(pa.field("image", pa.list_(pa.float64())))
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for row in range(rows):
            values = pa.array(np.zeros(each if row < 5 else 0))
            bomb = pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)
            writer.write_table(table.slice(row, 1).append_column("image", bomb))
    assert path.stat().st_size < 1 << 20
    outcome, memory = read_elsewhere(path)
    assert outcome == "read"
    assert memory < MEMORY / 4


def test_floats_that_expand_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.parquet"
    flat = pa.table({"t": pa.array(np.zeros(20_000_000))})
    pq.write_table(flat, path, compression="zstd")
    assert path.stat().st_size < 1 << 20
    outcome, memory = read_elsewhere(path)
    assert outcome == "refused"
    assert memory < MEMORY / 16


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_thirty_thousand_columns_are_refused_in_no_time(kind: str, tmp_path: Path) -> None:
    path, names = tmp_path / f"wide.{kind}", [f"q.{i}" for i in range(30_000)]
    if kind == "csv":
        path.write_text("t," + ",".join(names) + "\n" + "0," * 30_000 + "0\n")
    else:
        pq.write_table(pa.table({name: pa.array([0.0]) for name in names}), path)
    start = time.perf_counter()
    with pytest.raises(DataError, match="too many columns"):
        Dataset.read(path)
    assert time.perf_counter() - start < SLOW


def test_many_joints_and_a_missing_column_are_refused_in_no_time(tmp_path: Path) -> None:
    names = ["t", *(f"q.{'x' * 80}{i}" for i in range(4000))]
    pq.write_table(pa.table({name: pa.array([0.0]) for name in names}), tmp_path / "wide.parquet")
    start = time.perf_counter()
    with pytest.raises(DataError, match="too many joints"):
        Dataset.read(tmp_path / "wide.parquet")
    assert time.perf_counter() - start < SLOW


def test_a_list_inside_a_column_of_the_same_name_is_refused(tmp_path: Path) -> None:
    """Columns are read by name, and a name also selects what lies inside it."""
    table = valid_columns().append_column("q", pa.array([{"a": 1.0, "b": [2.0]}] * 60))
    table = table.append_column("q.a.b", pa.array([[1.0]] * 60))
    pq.write_table(table, tmp_path / "log.parquet")
    with (
        pytest.raises(DataError, match=r"'q\.a.*lies inside column 'q\.a'"),
        pytest.warns(IgnoredColumnsWarning),
    ):
        Dataset.read(tmp_path / "log.parquet")


@pytest.mark.parametrize(
    "content", [b"t,q.\xe9\n1,2\n", b"\xff\xfe\x00t\n", b"t,q.a\n\xe9,2\n", b"", b"\n\n", b"\x00" * 99]
)
def test_csv_that_is_not_utf8_is_a_data_error(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(DataError, match=r"log\.csv"):
        Dataset.read(tmp_path / "log.csv")


def test_a_line_without_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_bytes(b"t" * (2 << 20))
    with pytest.raises(DataError, match="first line is too long"):
        Dataset.read(tmp_path / "log.csv")


@pytest.mark.parametrize("value", [1e300, 1e101, float("-inf")])
def test_numbers_beyond_all_mechanics_are_refused(value: float) -> None:
    log = random_log()
    qd = log.qd.clone()
    qd[3, 1] = value
    with pytest.raises(DataError, match=r"'qd\.elbow' holds .* in row 3"):
        log.replace(qd=qd)


@pytest.mark.parametrize("value", [1e300, 0.5, float("inf"), -(2.0**60)])
def test_a_segment_is_an_integer_that_float64_holds(value: float, tmp_path: Path) -> None:
    table = valid_columns().append_column("segment", pa.array([value] * 60))
    pq.write_table(table, tmp_path / "log.parquet")
    with pytest.raises(DataError, match="'segment' is not a trajectory number in row 0"):
        Dataset.read(tmp_path / "log.parquet")


@pytest.mark.parametrize("field", ['"noise_std": -0.1', '"dt": 0.0', '"dt": -1.0'])
def test_a_header_with_impossible_numbers_is_refused(field: str, tmp_path: Path) -> None:
    text = f'{{"format": "forcegp-dataset", "version": 1, {field}}}'
    table = valid_columns().replace_schema_metadata({b"forcegp": text.encode()})
    pq.write_table(table, tmp_path / "log.parquet")
    with pytest.raises(DataError, match=r"header field '(noise_std|dt)'"):
        Dataset.read(tmp_path / "log.parquet")


def test_what_is_no_tensor_is_named() -> None:
    script = Path(__file__).with_name("wrong_kinds.py")
    paths = os.pathsep.join([str(script.parents[1]), *sys.path])
    done = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 13
    for line in lines:
        name, kind, message = line.split(" ", 2)
        assert kind == "DataError", line
        assert f"{name!r} is no" in message, line
