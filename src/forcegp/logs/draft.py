"""A mapping that is proposed to the user: its tables, and a comment on each thing that is not certain."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class Family:
    """Columns of one quantity, one for each joint.

    Attributes:
        pattern: their common name, with `{joint}` where they differ.
        columns: what stands for `{joint}` → column.
        declared: whether the log declares the unit.
        sign: +1, −1, or one of them for each joint of the robot.
        by_joint: joint of the robot → column, where `columns` does not name the joints as the positions do.
    """

    pattern: str
    columns: dict[str, str]
    stream: str = ""
    unit: str | None = None
    declared: bool = False
    sign: float | dict[str, float] = 1.0
    by_joint: dict[str, str] = field(default_factory=dict)


@dataclass
class Draft:
    """A proposed mapping.

    Attributes:
        source: the log.
        time, time_unit, segment: column and unit of time, and the column that numbers the trajectories.
        joints: joint of the robot → what the log calls it.
        families: quantity → its columns.
        wrench: columns of the force and, if any, of the moment.
        contacts: contact of the scene → lines of its table.
        comments: table → sentences above it.
        doubts: what the user must check.
    """

    source: str
    time: str = ""
    time_unit: str = "s"
    segment: str | None = None
    joints: dict[str, str] = field(default_factory=dict)
    families: dict[str, Family] = field(default_factory=dict)
    wrench: list[list[str]] = field(default_factory=list)
    wrench_stream: str = ""
    wrench_frame: str = ""
    contacts: dict[str, list[str]] = field(default_factory=dict)
    comments: dict[str, list[str]] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)

    def say(self, table: str, sentence: str, doubt: bool = False) -> None:
        """Comment on a table; a doubt is also listed at the top."""
        self.comments.setdefault(table, []).append(("CHECK: " if doubt else "") + sentence)
        if doubt:
            self.doubts.append(sentence)

    def toml(self) -> str:
        """The mapping file."""
        lines = [f"# Mapping of {_plain(self.source)}, proposed from its headings and values."]
        lines += ["# Check it, above all the lines marked CHECK, and import with --mapping.", ""]
        time = {"column": self.time, "unit": self.time_unit, "segment": self.segment}
        lines += self._table("time", time) + self._table("joints", self.joints)
        for name in ("position", "velocity", "acceleration", "torque"):
            if name in self.families:
                lines += self._table(name, _keys(name, self.families[name]))
        if self.wrench:
            columns: dict = dict(zip(("force", "torque"), self.wrench, strict=False))
            wrench = columns | {"stream": self.wrench_stream or None, "frame": self.wrench_frame}
            lines += self._table("wrench", wrench)
        for name, body in self.contacts.items():
            lines += [*self._above(f"contact {name}"), f"[contact.{json.dumps(name)}]", *body, ""]
        lines += [
            "[derivatives]",
            'method = "savitzky_golay"   # or "smoother", with error bars from a model',
        ]
        return "\n".join([*lines, "window = 11", "order = 3", "filter_torque = true", ""])

    def _above(self, table: str) -> list[str]:
        return [f"# {_plain(sentence)}" for sentence in self.comments.get(table, [])]

    def _table(self, table: str, keys: Mapping[str, object]) -> list[str]:
        body = [f"{_key(key)} = {_value(value)}" for key, value in keys.items() if value is not None]
        return [*self._above(table), f"[{table}]", *body, ""] if body else []


def _keys(name: str, family: Family) -> dict[str, object]:
    """The table of a quantity."""
    keys: dict[str, object] = {"columns": family.by_joint} if family.by_joint else {"column": family.pattern}
    keys |= {"stream": family.stream or None, "unit": family.unit}
    keys["sign"] = None if family.sign == 1.0 else family.sign
    if name == "torque" and family.unit in ("A", "mA"):
        keys |= {"side": "motor", "gear_ratio": 1.0, "torque_constant": 1.0}
    return keys


def _plain(text: str) -> str:
    """One line without control characters, as TOML's comments demand."""
    return "".join(c if c.isprintable() else " " for c in text)


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    return json.dumps(value)
