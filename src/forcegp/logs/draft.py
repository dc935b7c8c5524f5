"""A mapping that is proposed to the user: its tables, and a comment on each thing that is not certain."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

CHECK = "# CHECK: "
"""Start of a comment on what the user must check."""
CURRENT = {"side": "motor", "gear_ratio": 1.0, "torque_constant": 1.0}
"""What a current needs beside its unit."""


@dataclass
class Family:
    """Columns of one quantity, one for each joint; `declared`, if the log says their unit.

    `columns` has what stands for `{joint}` in the common pattern → column; `by_joint` joint of the robot →
    column, where that does not name the joints as the positions do.
    """

    pattern: str
    columns: dict[str, str]
    stream: str = ""
    unit: str | None = None
    declared: bool = False
    sign: float | dict[str, float] = 1.0
    by_joint: dict[str, str] = field(default_factory=dict)

    def table(self) -> dict[str, Any]:
        """Keys of the mapping."""
        columns = {"columns": self.by_joint} if self.by_joint else {"column": self.pattern}
        sign = None if self.sign == 1.0 else self.sign
        current = CURRENT if self.unit in ("A", "mA") else {}
        return {**columns, "stream": self.stream or None, "unit": self.unit, "sign": sign, **current}


@dataclass
class Draft:
    """A proposed mapping: tables, in which a key that is `None` is left out, families of columns by quantity,
    comments above each table, what the user must check, and the window of the derivatives."""

    source: str
    time: dict[str, Any] = field(default_factory=dict)
    joints: dict[str, str] = field(default_factory=dict)
    families: dict[str, Family] = field(default_factory=dict)
    further: dict[str, dict[str, Any]] = field(default_factory=dict)
    comments: dict[str, list[str]] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    window: int = 11

    def say(self, table: str, sentence: str, doubt: bool = False) -> None:
        """Comment on a table; a doubt is also listed at the top."""
        self.comments.setdefault(table, []).append((CHECK[2:] if doubt else "") + sentence)
        if doubt:
            self.doubts.append(sentence)

    def toml(self) -> str:
        """The mapping file."""
        lines = [f"# Mapping of {_plain(self.source)}, proposed from its headings and values."]
        lines += ["# Check it, above all the lines marked CHECK, and import with --mapping.", ""]
        quantities = {name: family.table() for name, family in self.families.items()}
        tables = {"time": self.time, "joints": self.joints, **quantities, **self.further}
        for name, table in tables.items():
            body = [f"{quoted(k)} = {_value(value)}" for k, value in table.items() if value is not None]
            above = [f"# {_plain(sentence)}" for sentence in self.comments.get(name, [])]
            lines += [*above, f"[{name}]", *body, ""] if body else []
        lines += [
            *(f"# {_plain(sentence)}" for sentence in self.comments.get("derivatives", [])),
            "[derivatives]",
            'method = "savitzky_golay"   # or "smoother", with error bars from a model',
        ]
        return "\n".join([*lines, f"window = {self.window}", "order = 3", "filter_torque = true", ""])


def _plain(text: str) -> str:
    """One line without control characters, as TOML's comments demand."""
    return "".join(c if c.isprintable() else " " for c in text)


def quoted(name: str) -> str:
    """A name as a key of TOML."""
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{quoted(k)} = {_value(v)}" for k, v in value.items()) + " }"
    return json.dumps(value)
