"""Text tables: separators, decimal marks, headings, encodings, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs.readers import read

VALUES = np.column_stack([np.arange(30) * 0.01, np.sin(np.arange(30)), -1e-7 * np.arange(30.0)])


def lines(separator: str, decimal: str = ".") -> list[str]:
    """The values as text that gives the same numbers back."""
    return [separator.join(repr(float(x)).replace(".", decimal) for x in row) for row in VALUES]


def written(folder: Path, text: str, encoding: str = "utf-8", name: str = "run.csv") -> Path:
    (folder / name).write_bytes(text.encode(encoding))
    return folder / name


@pytest.mark.parametrize("separator", [",", ";", "\t", "|", " ", "   ", " ; "])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_separators_and_decimal_marks(tmp_path: Path, separator: str, decimal: str, ending: str) -> None:
    if separator == decimal:
        pytest.skip("a comma cannot be both")
    path = written(tmp_path, ending.join([separator.join("tab"), *lines(separator, decimal)]) + ending)
    columns = read(path).streams[0].columns
    assert list(columns) == ["t", "a", "b"]
    np.testing.assert_array_equal(np.column_stack(list(columns.values())), VALUES)


def test_no_heading_preamble_comments_and_units(tmp_path: Path) -> None:
    body = "\n".join(lines(";"))
    bare = read(written(tmp_path, body)).streams[0]
    assert list(bare.columns) == ["0", "1", "2"]
    head = "# robot: arm 7\n% 2024-05-01\n\nTime;Angle;Torque\n[s];[deg];[Nm]\n"
    full = read(written(tmp_path, head + body)).streams[0]
    assert full.units == {"Time": "s", "Angle": "deg", "Torque": "Nm"} and len(full) == 30
    commented = read(written(tmp_path, "# t;a;b\n" + body)).streams[0]
    assert list(commented.columns) == ["t", "a", "b"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_encodings(tmp_path: Path, encoding: str) -> None:
    path = written(tmp_path, "Zeit,Gelenk [°],b\n" + "\n".join(lines(",")), encoding)
    assert list(read(path).streams[0].columns) == ["Zeit", "Gelenk [°]", "b"]


def test_text_flags_dates_and_gaps(tmp_path: Path) -> None:
    rows = [
        f"2024-05-01 12:00:00.{k:03d},{k},auto,{'true' if k > 4 else 'false'},{'' if k == 3 else k}"
        for k in range(10)
    ]
    table = read(written(tmp_path, "when,n,mode,touch,gap\n" + "\n".join(rows)))
    columns = table.streams[0].columns
    assert "mode" not in columns and any("'mode'" in remark for remark in table.remarks)
    np.testing.assert_allclose(np.diff(columns["when"]), 1e-3, atol=1e-7)
    assert columns["touch"].tolist() == [0.0] * 5 + [1.0] * 5
    assert np.isnan(columns["gap"][3]) and np.isfinite(columns["gap"]).sum() == 9


def test_decimal_commas_are_not_separators(tmp_path: Path) -> None:
    """Two columns, where splitting at commas gives more fields that are numbers."""
    path = written(tmp_path, "t;q\n0,0;1,5\n0,1;1,75\n")
    assert read(path).streams[0].columns["q"].tolist() == [1.5, 1.75]


def test_only_the_columns_and_rows_that_are_wanted(tmp_path: Path) -> None:
    path = written(tmp_path, "\n".join(["t,a,b", *lines(",")]))
    table = read(path, wanted=lambda name: name != "a", rows=7)
    assert list(table.streams[0].columns) == ["t", "b"] and len(table.streams[0]) == 7


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"hello\nworld\n", "no table of numbers"),
        (b"a,b\n1,2\n\x00\x01", "binary"),
        (b"a,a\n1,2\n", "more than once"),
        (b"a,b\n" + b"1,2\n" * 500 + b"1,2,3\n", "damaged"),
        (b"a,b\n" + b"1,2\n" * 500 + b"1,x\n", "damaged"),
        (b"1," * 5000 + b"1\n", "too many columns"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "run.csv").write_bytes(content)
    with pytest.raises(DataError, match=message):
        read(tmp_path / "run.csv")


def test_a_file_of_one_line_without_end_is_refused_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "run.txt").write_bytes(b"1 2\n" * 400 + b"7 " * (limits.LINE_BYTES * 4))
    with pytest.raises(DataError):
        read(tmp_path / "run.txt")
