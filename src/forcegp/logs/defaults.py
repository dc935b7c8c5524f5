"""The mapping of a log that says itself what its columns are: a data set's names, or a ROS joint state."""

from __future__ import annotations

import json
from pathlib import Path

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import MappingError
from forcegp.logs.mapping import Mapping, load_mapping, parse_mapping
from forcegp.logs.readers import read
from forcegp.logs.table import LogTable


def default_mapping(path: str | Path, system: ConstrainedSystem) -> Mapping:
    """The mapping of a log whose names leave no doubt.

    Raises:
        MappingError: they do; the hint says how to write a mapping.
    """
    table, robot = read(path, rows=1), system.robot
    names = set(table.names)
    if (
        all(f"{symbol}.{joint}" in names for symbol in ("q", "tau") for joint in robot.joint_names)
        and "t" in names
    ):
        return parse_mapping(_data_set(table, system).encode(), "columns named as in a data set")
    joint_states = all(
        f"position.{joint}" in names and f"effort.{joint}" in names for joint in robot.joint_names
    )
    if joint_states and "header" in names:
        return load_mapping("ros_joint_states")
    shown = ", ".join(table.names[:12]) + (", …" if len(table.names) > 12 else "")
    raise MappingError(
        f"{path}: the names of the columns do not say what they are",
        expected=f"t, q.{robot.joint_names[0]}, tau.{robot.joint_names[0]}, …, or a mapping",
        got=shown,
        hint="write a mapping by --guess mapping.toml, check it, and pass it by --mapping",
    )


def _data_set(table: LogTable, system: ConstrainedSystem) -> str:
    names = set(table.names)
    lines = ["[time]", 'column = "t"', *(['segment = "segment"'] if "segment" in names else [])]
    units = {"position": ("q", "rad"), "velocity": ("qd", "rad/s"), "acceleration": ("qdd", "rad/s2")}
    for quantity, (symbol, unit) in (units | {"torque": ("tau", "Nm")}).items():
        if all(f"{symbol}.{joint}" in names for joint in system.robot.joint_names):
            lines += [f"[{quantity}]", f'column = "{symbol}.{{joint}}"', f'unit = "{unit}"']
    for name in system.contact_names:
        if f"contact.{name}" in names:
            lines += [
                f"[contact.{json.dumps(name)}]",
                'source = "column"',
                f"column = {json.dumps('contact.' + name)}",
            ]
    return "\n".join(lines) + "\n"
