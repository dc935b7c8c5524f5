"""Mapping files: every error names file, line and key."""

from __future__ import annotations

import pytest

from forcegp.errors import MappingError
from forcegp.logs import load_mapping, parse_mapping, units
from forcegp.logs.mapping import BUNDLED

GOOD = """\
[time]
column = "t"

[joints]
shoulder = "1"
elbow = "2"

[position]
column = "q{joint}"
unit = "deg"

[torque]
column = "i{joint}"
unit = "A"
side = "motor"
gear_ratio = { shoulder = 100, elbow = 50 }
torque_constant = 0.1
"""


@pytest.mark.parametrize("name", BUNDLED)
def test_every_mapping_that_is_shipped_is_valid(name: str) -> None:
    assert load_mapping(name).sections.position.column


def test_columns_and_numbers_of_joints() -> None:
    mapping = parse_mapping(GOOD.encode(), "m.toml")
    assert mapping.columns_of("position", ("shoulder", "elbow")) == ["q1", "q2"]
    assert mapping.per_joint("torque", "gear_ratio", ("elbow", "shoulder")).tolist() == [50.0, 100.0]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('column = "t"', 'colum = "t"', r"m.toml:2: time.colum: unknown key(?s:.*)'column'"),
        ('unit = "deg"', 'unit = "degree"', r"m.toml:10: position.unit: unknown (?s:.*)'deg'"),
        ('unit = "A"', 'unit = "Nm"', r"m.toml:14: torque.unit: a current needs a torque constant"),
        ("gear_ratio = { shoulder = 100, elbow = 50 }\n", "", r"m.toml:15: torque.side: (?s:.*)gear ratio"),
        ("torque_constant = 0.1", "torque_constant = -0.1", r"m.toml:17: torque.torque_constant: not"),
        ('column = "q{joint}"', "", r"m.toml:8: position: no column"),
        ("[torque]", "[torqe]", r"m.toml:12: torqe: unknown key(?s:.*)did you mean 'torque'"),
        ('column = "t"', "column = 3", r"m.toml:2: time.column: (?s:.*)string"),
        ("elbow = 50", 'elbow = "x"', r"m.toml:16: torque.gear_ratio"),
        ("[joints]", "[joints", r"m.toml:4: not valid TOML"),
        ('column = "t"', 'column = "t"\nstart = 2\nstop = 1.0', r"m.toml:4: time.stop: the log"),
        ("[torque]", "[derivatives]\nwindow = 10\n[torque]", r"m.toml:13: derivatives.window: the filter"),
        ("[torque]", '[contact.table]\nsource = "wrench"\n[torque]', r"m.toml:13: (?s:.*)wrench is not"),
    ],
)  # fmt: skip
def test_errors_name_file_line_and_key(before: str, after: str, message: str) -> None:
    assert before in GOOD
    with pytest.raises(MappingError, match=message):
        parse_mapping(GOOD.replace(before, after).encode(), "m.toml")


def test_a_hostile_mapping_is_a_mapping_error() -> None:
    with pytest.raises(MappingError, match="a key of too many parts"):
        parse_mapping(b".".join([b"a"] * 1000) + b" = 1", "m.toml")


def test_names_of_joints_are_checked_against_the_robot() -> None:
    mapping = parse_mapping(GOOD.encode(), "m.toml")
    with pytest.raises(
        MappingError, match=r"m.toml:6: joints.elbow: 'elbow' is not a joint(?s:.*)'elbow_joint'"
    ):
        mapping.columns_of("position", ("shoulder", "elbow_joint"))
    with pytest.raises(MappingError, match="joint 'wrist' has no column"):
        mapping.columns_of("position", ("shoulder", "elbow", "wrist"))
    with pytest.raises(MappingError, match=r"m.toml:16: torque.gear_ratio(?s:.*)'wrist' is missing"):
        mapping.per_joint("torque", "gear_ratio", ("shoulder", "elbow", "wrist"))
    same = GOOD.replace("q{joint}", "q")
    with pytest.raises(MappingError, match="column 'q' is given for two joints"):
        parse_mapping(same.encode(), "m.toml").columns_of("position", ("shoulder", "elbow"))


def test_a_mapping_that_is_not_there_has_a_near_name() -> None:
    with pytest.raises(MappingError, match=r"no such mapping(?s:.*)did you mean 'ur3_bag'"):
        load_mapping("ur3_bagg")


def test_units_are_factors_to_si() -> None:
    assert units.QUANTITY["velocity"]["rpm"] * 60.0 == pytest.approx(2.0 * 3.141592653589793)
    assert [units.spelled(s) for s in ("(deg)", "°/s", "N m", "Milliseconds")] == ["deg", "deg/s", "Nm", "ms"]
