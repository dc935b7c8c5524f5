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


@pytest.mark.parametrize("quote", ['"', "'"])
@pytest.mark.parametrize("separator", [",", ";", ", ", "\t", " "])
@pytest.mark.parametrize("decimal", [".", ","])
def test_quoted_fields_with_decimal_commas(tmp_path: Path, quote: str, separator: str, decimal: str) -> None:
    """Headings in quotes may contain separators, and so may numbers with a decimal comma."""
    names = ["Zeit [s]", "Winkel, A1 [°]", "Moment; A1"]
    rows = [names, *(line.split(" ") for line in lines(" ", decimal))]
    text = "\n".join(separator.join(f"{quote}{field}{quote}" for field in row) for row in rows)
    columns = read(written(tmp_path, text)).streams[0].columns
    assert list(columns) == names
    np.testing.assert_array_equal(np.column_stack(list(columns.values())), VALUES)


def test_quotes_in_the_heading_only(tmp_path: Path) -> None:
    columns = read(written(tmp_path, '"t","a, b","c"\n' + "\n".join(lines(",")))).streams[0].columns
    assert list(columns) == ["t", "a, b", "c"]


@pytest.mark.parametrize(
    ("start", "end", "seconds"),
    [
        ("27.11.2025 23:59:59,250", "28.11.2025 00:00:01,5", 2.25),
        ("2025-11-27T23:59:59.250Z", "2025-11-28T01:00:01.5+01:00", 2.25),
        ("2025/11/27 23:59:59.250", "2025/11/28 0:00:01.5", 2.25),
        ("11/27/2025 11:59:59.250 PM", "11/28/2025 12:00:01.5 AM", 2.25),
        ("11/12/2025 23:59:59.250", "12/12/2025 00:00:01.5", 2.25),
        ("11/12/2025 23:59:59.250", "11/13/2025 00:00:01.5", 2.25),
        ("27-11-25 23:59:59.250", "28-11-25 00:00:01.5", 2.25),
        ("23:59:59.250", "00:00:01.5", 2.25),
        ("23:59:59.250000001", "00:00:01.5", 2.249999999),
        ("2024-02-28", "2024-03-01", 2 * 86400.0),
        ("28-Feb-2026 23:59:59.250", "01-Mar-2026 00:00:01.5", 2.25),  # MATLAB
        ("Nov 30 2026 23:59:59.250", "Dec 1 2026 00:00:01.5", 2.25),
        ("April 30, 2026, 11:59:59.250 PM", "May 1, 2026, 12:00:01.5 AM", 2.25),
        ("31. Dezember 2025 23:59:59,250", "1. Januar 2026 00:00:01,5", 2.25),
        ("28.Feb.26 23:59:59,250", "1.März.26 00:00:01,5", 2.25),
        ("30 juin 2026 23:59:59", "1 juillet 2026 00:00:01", 2.0),
        ("31 août 2026 23:59:59", "1 sept. 2026 00:00:01", 2.0),
        ("30 de septiembre de 2026 23:59:59", "1 de octubre de 2026 00:00:01", 2.0),
    ],
)
def test_dates_of_countries(tmp_path: Path, start: str, end: str, seconds: float) -> None:
    columns = read(written(tmp_path, f"when;q\n{start};0\n{start};1\n{end};2\n")).streams[0].columns
    assert columns["when"][2] - columns["when"][0] == pytest.approx(seconds, abs=1e-7)


def test_a_date_and_a_time_of_day_are_not_added_twice(tmp_path: Path) -> None:
    rows = ["27.11.2025;23:59:59,5;0", "28.11.2025;00:00:00,5;1"]
    columns = read(written(tmp_path, "\n".join(["Datum;Uhrzeit;q", *rows]))).streams[0].columns
    np.testing.assert_allclose(np.diff(columns["Datum"] + columns["Uhrzeit"]), 1.0, atol=1e-7)


def test_an_impossible_date_names_its_row_and_the_formats(tmp_path: Path) -> None:
    rows = [f"27.11.2025 14:03:{k % 60:02d};{k}" for k in range(300)]
    rows[250] = "yesterday;250"
    with pytest.raises(DataError, match=r"invalid date or time in row 250(?s:.*)27.11.2025(?s:.*)yesterday"):
        read(written(tmp_path, "\n".join(["when;q", *rows])))


@pytest.mark.parametrize("month", range(1, 13))
def test_every_month_has_its_number(tmp_path: Path, month: int) -> None:
    """Names in full and in short, against the same date in digits."""
    names = (
        "jan feb mar apr may jun jul aug sep oct nov dec",
        "January February March April May June July August September October November December",
        "Jan. Feb. März Apr. Mai Juni Juli Aug. Sept. Okt. Nov. Dez.",
        "Januar Februar Mrz April Mai Jun Jul August September Oktober November Dezember",
        "janv. févr. mars avr. mai juin juil. août sept. oct. nov. déc.",
        "janvier février mars avril mai juin juillet aout septembre octobre novembre décembre",
        "ene feb mar abr may jun jul ago sep oct nov dic",
        "enero febrero marzo abril mayo junio julio agosto septiembre octubre noviembre diciembre",
        "gennaio febbraio marzo aprile maggio giugno luglio agosto settembre ottobre novembre dicembre",
    )
    for name in (language.split()[month - 1] for language in names):
        text = f"when;q\n5 {name} 2026 01:02:03;0\n5.{month}.2026 01:02:03;1\n"
        when = read(written(tmp_path, text)).streams[0].columns["when"]
        assert when[0] == when[1], name


def test_dates_of_other_forms_are_named_with_the_supported_ones(tmp_path: Path) -> None:
    rows = [f"Sat 28 XI 01:02:{k:02d} MMXXVI;{k};1" for k in range(20)]
    table = read(written(tmp_path, "\n".join(["when;q;tau", *rows])))
    (remark,) = table.remarks
    assert "'when' was ignored" in remark and "Sat 28 XI" in remark and "27-Nov-2025 14:03:22" in remark
    with pytest.raises(DataError, match="27-Nov-2025"):
        table.stream_of("when")


def test_a_column_that_starts_empty_is_read(tmp_path: Path) -> None:
    """The first rows decide nothing: a sensor may start later than the logger."""
    rows = [f"{k};;;{'' if k < 400 else '1,5'};{'' if k < 400 else 'off'}" for k in range(500)]
    table = read(written(tmp_path, "\n".join(["t;never;;late;word", *rows])))
    late = table.streams[0].columns["late"]
    assert np.isnan(late[:400]).all() and (late[400:] == 1.5).all()
    assert list(table.streams[0].columns) == ["t", "late"]
    assert any("'never' contains no numbers" in remark for remark in table.remarks)


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
