"""Mapping files in TOML, which assign the columns of a log to quantities and joints (see docs/import.md).

`[joints]` contains the name of each joint in the log. These names are inserted into column patterns such as
`"q_{joint}"`. No mapping file is needed for data sets, or for ROS joint states with the robot's joint names.
A draft is a proposed mapping with comments on uncertain entries.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from forcegp.constraints import ConstrainedSystem
from forcegp.data.fields import NUMBERS, lock_hint
from forcegp.errors import MappingError, did_you_mean
from forcegp.guards import is_file
from forcegp.logs import units
from forcegp.logs.readers import read
from forcegp.logs.table import left_out
from forcegp.robot.free_base import BASE_JOINTS
from forcegp.scene.document import Document, Key
from forcegp.scene.sections import Section

CHECK = "# CHECK: "
"""Prefix of a comment on an entry that the user must check."""
CURRENT = {"side": "motor", "gear_ratio": 1.0, "torque_constant": 1.0}
"""Keys that are required for a current, in addition to its unit."""


@dataclass
class Family:
    """Columns of one quantity, keyed by the text that replaces `{joint}` in their common pattern. `by_joint`
    is used if that text differs from that of the positions. `declared` is true if the log states the unit.
    """

    pattern: str
    columns: dict[str, str]
    stream: str = ""
    unit: str | None = None
    declared: bool = False
    sign: float | dict[str, float] = 1.0
    by_joint: dict[str, str] = field(default_factory=dict)
    unwrap: bool = False
    unmeasured: list[str] = field(default_factory=list)
    compensated: Compensated | None = None

    def table(self) -> dict[str, Any]:
        """Return the table for this family in the mapping file."""
        columns = {"columns": self.by_joint} if self.by_joint else {"column": self.pattern}
        sign = None if self.sign == 1.0 else self.sign
        current = CURRENT if self.unit in ("A", "mA") else {}
        more = {"unwrap": self.unwrap or None, "unmeasured": self.unmeasured or None}
        more |= {"compensated": self.compensated}
        return {**columns, "stream": self.stream or None, "unit": self.unit, "sign": sign, **more, **current}


@dataclass
class Draft:
    """A proposed mapping: tables (keys with value `None` are omitted), families of columns by quantity,
    comments placed above each table, entries that the user must check, notes of the reader, and the filter
    window for derivatives.
    """

    source: str
    time: dict[str, Any] = field(default_factory=dict)
    joints: dict[str, str] = field(default_factory=dict)
    families: dict[str, Family] = field(default_factory=dict)
    further: dict[str, dict[str, Any]] = field(default_factory=dict)
    comments: dict[str, list[str]] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    remarks: tuple[str, ...] = ()
    window: int = 11

    @property
    def left_out(self) -> str:
        """The omissions of the reader, to be appended to a sentence."""
        return left_out(self.remarks)

    @property
    def incomplete(self) -> list[str]:
        """Names of the quantities whose columns the user must fill in."""
        return [name for name, family in self.families.items() if not family.columns]

    def columns_of(self, quantity: str, joints: Sequence[str]) -> dict[str, str]:
        """Return the column of each joint for which a quantity was found."""
        family = self.families[quantity]
        named = {joint: family.columns.get(self.joints.get(joint, joint), "") for joint in joints}
        return {joint: column for joint, column in (named | family.by_joint).items() if column}

    def say(self, table: str, sentence: str, doubt: bool = False) -> None:
        """Add a comment to a table. If `doubt` is set, mark the comment CHECK and add it to `doubts`."""
        self.comments.setdefault(table, []).append((CHECK[2:] if doubt else "") + sentence)
        if doubt:
            self.doubts.append(sentence)

    def toml(self) -> str:
        """Return the text of the mapping file."""
        lines = [
            f"# Mapping of {_plain(self.source)}, proposed from its headings and values.",
            "# Check it, delete the mark CHECK of each line that is right, and import with --mapping.",
            *(f"# The reader: {_plain(remark)}" for remark in self.remarks),
            "",
        ]
        quantities = {name: self.families[name].table() for name in SYMBOLS if name in self.families}
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
    """Return text as one line without control characters, as TOML comments require."""
    return "".join(c if c.isprintable() else " " for c in text)


def quoted(name: str) -> str:
    """Return a name as a TOML key, with quotation marks if necessary."""
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{quoted(k)} = {_value(v)}" for k, v in value.items()) + " }"
    return json.dumps(value)


SYMBOLS = {"position": "q", "velocity": "qd", "acceleration": "qdd", "torque": "tau"}
"""Names of the mapped quantities in a data set."""
COMMANDS = {"servo": "command", "servo_velocity": "command_velocity", "servo_torque": "command_torque"}
"""Names of the commands of servos."""
LOGGED = {**SYMBOLS, **COMMANDS}
"""Names of the vectors that are read from a log."""
TORQUES = ("torque", "servo_torque")
"""Vectors that are torques, not motion."""
ROS_NAMES = {"position": "position", "velocity": "velocity", "torque": "effort"}
"""Names of the mapped quantities in ROS joint states."""
KNOWN_NAMES = {"t": "a data set", "header": "ROS joint states"}
"""Sources of the column names that need no mapping, by their column of time."""
ROWS = 100_000
"""Maximum number of rows from which a mapping is proposed. One message may lack joints or quantities."""
PerJoint = float | dict[str, float]
"""One number for all joints, or one number for each joint name."""
Unknown = Literal["auto"]
"""A number that is found from the log."""


Compensated = Literal["gravity", "model"]
"""What a driver subtracts from the torque: −Q_G, or M q̈ − Q_C − Q_G."""

TimeUnit = Literal["s", "ms", "us", "ns", "min", "h", "d"]
"""Units of time; a day has 86,400 s."""


class TimeSection(Section):
    """`[time]`: the clock, in one column, or in several with one unit each that are added up, such as seconds
    and nanoseconds."""

    column: str | tuple[str, ...]
    stream: str | None = None
    unit: TimeUnit | tuple[TimeUnit, ...] = "s"
    start: float = -np.inf
    stop: float = np.inf
    segment: str | None = None
    recording: str | None = None
    period: float | None = Field(default=None, gt=0.0)
    gap: float | None = Field(default=None, gt=0.0)
    missing: Literal["error", "drop"] = "error"
    held: Literal["keep", "drop"] = "keep"

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the clock."""
        return (self.column,) if isinstance(self.column, str) else self.column

    @property
    def factors(self) -> tuple[float, ...]:
        """The factors that convert the columns of the clock to seconds."""
        return tuple(units.TIME[unit] for unit in ([self.unit] if isinstance(self.unit, str) else self.unit))


class QuantitySection(Section):
    """`[position]`, `[velocity]`, `[acceleration]`: the columns, units and signs of a joint vector."""

    column: str | None = None
    columns: dict[str, str] = Field(default_factory=dict)
    stream: str | None = None
    unit: str
    sign: PerJoint = 1.0
    offset: PerJoint = 0.0
    side: Literal["joint", "motor"] = "joint"
    gear_ratio: PerJoint | None = None


CONSTANT_STD = 0.2
"""Stated standard deviation of a torque constant with its gear. Data sheets allow 10 % for the motor, and
the efficiency of a strain wave gear varies between 65 and 85 % with load and temperature."""


class TorqueSection(QuantitySection):
    """`[torque]`: a torque, or a current and the torque constant of the motor [N m/A] with its relative
    standard deviation. Joints with neither are listed in `unmeasured`. Rows with `clipped` torques are kept,
    given large noise, or dropped. If the driver has subtracted the gravity torque or the inverse dynamics,
    `compensated` says which."""

    torque_constant: PerJoint | None = None
    torque_constant_std: float = Field(default=CONSTANT_STD, ge=0.0)
    unmeasured: tuple[str, ...] = ()
    clipped: Literal["noise", "drop", "keep"] = "noise"
    compensated: Compensated | None = None


class ServoSection(QuantitySection):
    """`[servo]`: commanded positions in place of torques, and the nominal stiffness and damping of each servo
    [N m/rad, N m s/rad], with the relative standard deviation of the stiffness; `"auto"` finds it from the
    motion and the masses in the robot file. Rows in which a torque
    exceeds `limit` [N m] are dropped. The `delay` of commands [s] is found from the motion unless given.
    Commanded velocities and torques are in `[servo_velocity]` and `[servo_torque]`."""

    stiffness: float | Unknown | dict[str, float | Unknown]
    damping: PerJoint = 0.0
    limit: PerJoint | None = None
    delay: Annotated[float, Field(ge=0.0)] | Literal["auto"] = "auto"
    stiffness_std: float = Field(default=0.3, ge=0.0)


class PositionSection(QuantitySection):
    """`[position]`: for each joint without a column, `from_contact` names the contact that determines it. If
    `unwrap` is set, angles that jump by one turn are made continuous."""

    unwrap: bool = False
    from_contact: dict[str, str] = Field(default_factory=dict)


GROUND = "ground"
"""Frame of a sensor that is fixed to the world."""


class WrenchSection(Section):
    """`[wrench]`: a force-torque sensor, or a load cell with one column that measures along `axis`.

    For a sensor on the ground, `position` [m] and `rpy` [rad] are given in the world.
    """

    force: tuple[str, ...] = Field(min_length=1, max_length=3)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque: tuple[str, str, str] | None = None
    stream: str | None = None
    frame: str
    axes: Literal["frame", "world"] = "frame"
    force_unit: Literal["N", "kN", "mN", "kgf"] = "N"
    torque_unit: Literal["Nm", "mNm", "Ncm", "kNm"] = "Nm"
    acts_on: Literal["robot", "environment"] = "robot"
    offset: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    tool_mass: float = Field(default=0.0, ge=0.0)
    tool_com: tuple[float, float, float] = (0.0, 0.0, 0.0)


Triple = tuple[str, str, str]
"""Columns of x, y and z, or of roll, pitch and yaw."""


class BaseSection(Section):
    """`[base]`: the columns of the motion of a floating base, in SI units but for `angle_unit` and
    `acceleration_unit`. `rpy` are roll, pitch and yaw with R = R_z R_y R_x, as the joints of a free base.

    `imu_position` [m] and `imu_rpy` [rad] place the sensor in `imu_frame`. With `gravity`, an accelerometer
    at rest reads +g along the upward axis. Without `position`, feet at rest determine it: `feet` names the
    column of each frame that is 1 while this foot does not move.
    """

    position: Triple | None = None
    quaternion: tuple[str, str, str, str] | None = None
    quaternion_order: Literal["wxyz", "xyzw"] | None = None
    rpy: Triple | None = None
    orientation_of: Literal["base", "imu"] = "base"
    linear_velocity: Triple | None = None
    linear_axes: Literal["world", "body"] | None = None
    angular_velocity: Triple | None = None
    angular_axes: Literal["world", "body"] | None = None
    stream: str | None = None
    imu_frame: str | None = None
    imu_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro: Triple | None = None
    accelerometer: Triple | None = None
    gravity: bool | None = None
    imu_stream: str | None = None
    feet: dict[str, str] = Field(default_factory=dict)
    angle_unit: Literal["rad", "deg"] = "rad"
    acceleration_unit: Literal["m/s2", "g"] = "m/s2"


class ContactStateSection(Section):
    """`[contact.<name>]`: the source of the state of a contact in the scene."""

    source: Literal["column", "wrench", "multiplier", "distance", "always", "never"]
    column: str | None = None
    stream: str | None = None
    threshold: float | None = Field(default=None, gt=0.0)
    release: float | None = Field(default=None, gt=0.0)
    shortest: float = Field(default=0.05, ge=0.0)
    stick_speed: Annotated[float, Field(gt=0.0)] | Literal["auto", "never"] = "auto"
    sticks: str | None = None


class DerivativesSection(Section):
    """`[derivatives]`: settings for computing missing velocities and accelerations."""

    method: Literal["savitzky_golay", "smoother"] = "savitzky_golay"
    source: Literal["position", "velocity"] | None = None
    window: int = Field(default=11, ge=3, le=10001)
    order: int = Field(default=3, ge=2, le=9)
    filter_torque: bool = True
    impact_margin: float | None = Field(default=None, ge=0.0)


class MappingSections(Section):
    """All tables of a mapping file."""

    time: TimeSection
    joints: dict[str, str] = Field(default_factory=dict)
    position: PositionSection
    velocity: QuantitySection | None = None
    acceleration: QuantitySection | None = None
    torque: TorqueSection | None = None
    servo: ServoSection | None = None
    servo_velocity: QuantitySection | None = None
    servo_torque: QuantitySection | None = None
    wrench: WrenchSection | None = None
    base: BaseSection | None = None
    contact: dict[str, ContactStateSection] = Field(default_factory=dict)
    derivatives: DerivativesSection = DerivativesSection()


BUNDLED = ("double_pendulum_csv", "iiwa14_txt", "ros_joint_states", "ur3_bag", "ur3_mat")
"""Mappings included in the library for published logs, and for ROS topics with the robot's joint names."""


@dataclass(frozen=True)
class Mapping:
    """A validated mapping file: its tables, the document for error messages, and the CHECK comments."""

    sections: MappingSections
    document: Document
    doubts: tuple[str, ...] = ()

    def quantity(self, name: str) -> QuantitySection | None:
        """Return the table of a joint vector, whose names are those in `LOGGED`."""
        return getattr(self.sections, name)

    @property
    def torque(self) -> TorqueSection:
        """The table of the torque, with defaults for the log of servos."""
        return self.sections.torque or TorqueSection(unit="Nm", clipped="keep")

    @property
    def base(self) -> tuple[str, ...]:
        """The joints of the free base, if `[base]` contains its motion."""
        return BASE_JOINTS if self.sections.base is not None else ()

    def measured(self, name: str, joints: Sequence[str]) -> list[str]:
        """Return the joints with a column of a quantity. Joints with an `unmeasured` torque, with motion
        derived from a contact, or of the free base in `[base]` are excluded."""
        name, key = ("torque", "unmeasured") if name == "torque" else ("position", "from_contact")
        lacking = getattr(self.quantity(name), key)
        self._check_joints((name, key), lacking, joints)
        return [joint for joint in joints if joint not in lacking and joint not in self.base]

    def columns_of(self, name: str, joints: Sequence[str]) -> list[str]:
        """Return the column of a quantity for each joint for which the quantity is logged."""
        section = self.quantity(name)
        assert section is not None
        self._check_joints(("joints",), self.sections.joints, joints)
        self._check_joints((name, "columns"), section.columns, joints)
        called = self.sections.joints or dict(zip(joints, joints, strict=True))
        pattern = section.column
        named = {} if pattern is None else {j: pattern.replace("{joint}", n) for j, n in called.items()}
        named |= section.columns
        measured = self.measured(name, joints)
        lacking = [joint for joint in measured if not named.get(joint)]
        if lacking:
            text = f"joint {lacking[0]!r} has no column"
            expected = f'{quoted(lacking[0])} = "…" under columns'
            unmeasured = f"if it has no torque sensor, unmeasured = {json.dumps(lacking)} under [torque]"
            hint = unmeasured if name == "torque" else lock_hint(lacking)
            if lacking[0] in BASE_JOINTS:
                hint = "a table [base] maps the pose and the velocities of a floating base"
            raise self.error((name,), text, expected, hint=hint)
        columns = [named[joint] for joint in measured]
        if len(set(columns)) < len(columns):
            twice = next(c for c in columns if columns.count(c) > 1)
            raise self.error((name,), f"column {twice!r} is given for two joints", expected="'{joint}' in it")
        return columns

    def per_joint(self, name: str, key: str, joints: Sequence[str]) -> NDArray[np.float64]:
        """Return the values (nq,) of a key that has either one value for all joints or one per joint. They
        are NaN for `"auto"`."""
        value = getattr(self.quantity(name), key)
        if not isinstance(value, dict):
            return np.full(len(joints), _number(value))
        self._check_joints((name, key), value, joints)
        for joint in joints:
            if joint not in value:
                raise self.error((name, key), f"joint {joint!r} is missing", expected=", ".join(joints))
        return np.array([_number(value[joint]) for joint in joints])

    def error(
        self, key: Key, message: str, expected: object = None, got: object = None, hint: str | None = None
    ) -> MappingError:
        """Return an error that refers to a key in the mapping file."""
        return MappingError(f"{self.document.place(key)}: {message}", expected=expected, got=got, hint=hint)

    def _check_joints(self, key: Key, named: Iterable[str], joints: Sequence[str]) -> None:
        for joint in named:
            if joint not in joints:
                text, hint = f"{joint!r} is not a joint of the robot", did_you_mean(joint, joints)
                raise self.error((*key, joint), text, expected=", ".join(joints), hint=hint)


def _number(value: float | Unknown) -> float:
    return np.nan if value == "auto" else float(value)


def load_mapping(source: str | Path) -> Mapping:
    """Read a mapping file, or a bundled mapping by name.

    Raises:
        MappingError: the mapping does not exist or is invalid. The message names the file, line and key.

    >>> load_mapping("ros_joint_states").sections.torque.unit
    'Nm'
    """
    bundled = str(source) in BUNDLED
    path = Path(str(files("forcegp.logs") / "bundled" / f"{source}.toml")) if bundled else Path(source)
    if not is_file(path):
        hint = did_you_mean(source, BUNDLED) or "write one with --guess"
        expected = f"a TOML file, or one of {', '.join(BUNDLED)}"
        raise MappingError(f"{path}: no such mapping", expected=expected, hint=hint)
    return parse_mapping(path.read_bytes(), str(path))


def parse_mapping(content: bytes, source: str) -> Mapping:
    """Parse the bytes of a mapping file; raise a `MappingError` that names the line and key if invalid."""
    document = Document(content, source, MappingError)
    doubts = tuple(line[len(CHECK) :] for line in content.decode().splitlines() if line.startswith(CHECK))
    mapping = Mapping(document.validated(MappingSections), document, doubts)
    _check(mapping)
    return mapping


def _check(mapping: Mapping) -> None:
    """Check the units, and the keys that depend on each other."""
    sections = mapping.sections
    for name in LOGGED:
        if (section := mapping.quantity(name)) is not None:
            _check_quantity(mapping, name, section)
    if (sections.torque is None) == (sections.servo is None):
        raise mapping.error(
            (),
            "torques or commands of servos are needed, and not both",
            expected="[torque], or [servo] with the nominal stiffness of each servo",
            hint='the masses in the robot file fix the scale: stiffness = "auto" finds it where links resist',
        )
    for name in COMMANDS:
        if sections.servo is None and mapping.quantity(name) is not None:
            expected = "[servo] with commanded positions and the nominal stiffness"
            raise mapping.error((name,), "these commands need those of positions", expected)
        gains = [] if sections.servo is None else sections.servo.stiffness
        unknown = "auto" in (gains.values() if isinstance(gains, dict) else [gains])
        if name != "servo" and unknown and mapping.quantity(name) is not None:
            text = "commands of velocities and torques need a nominal stiffness"
            raise mapping.error(("servo", "stiffness"), text, "a number for each joint", "auto")
    torque = mapping.torque
    if (torque.unit in units.CURRENT) != (torque.torque_constant is not None):
        text, got = "a current needs a torque constant, and nothing else has one", repr(torque.unit)
        expected = 'unit = "A" with torque_constant = … [N m/A], or a unit of torque without it'
        raise mapping.error(("torque", "unit"), text, expected, got)
    for name, contact in sections.contact.items():
        key = ("contact", name, "source")
        if contact.source == "column" and contact.column is None:
            raise mapping.error(key, "key 'column' is missing", expected="column = …")
        if contact.source == "wrench" and sections.wrench is None:
            raise mapping.error(key, "the log's wrench is not mapped", "a table [wrench]")
    wrench = sections.wrench
    if wrench is not None and (len(wrench.force) == 2 or (len(wrench.force) == 1 and wrench.torque)):
        got = f"{len(wrench.force)} columns{', and those of a torque' if wrench.torque else ''}"
        raise mapping.error(("wrench", "force"), "not a force", "one column, or three, of x, y and z", got)
    if sections.base is not None:
        _check_base(mapping, sections.base)
    time, derivatives = sections.time, sections.derivatives
    if len(time.columns) != len(time.factors) or not time.columns:
        text, got = "the columns of the clock need one unit each", f"{len(time.factors)} units"
        raise mapping.error(("time", "unit"), text, f"{len(time.columns)} units", got)
    if time.start >= time.stop:
        raise mapping.error(("time", "stop"), "the log would be empty", f"more than {time.start}", time.stop)
    if derivatives.window % 2 == 0 or derivatives.order >= derivatives.window:
        key, got = ("derivatives", "window"), f"window {derivatives.window}, order {derivatives.order}"
        raise mapping.error(key, "the filter is not defined", "an odd window > order", got)
    if derivatives.source == "velocity" and sections.velocity is None:
        raise mapping.error(("derivatives", "source"), "the velocity is not mapped", "a table [velocity]")


def _check_base(mapping: Mapping, base: BaseSection) -> None:
    """Check which columns of a floating base are given, and that their axes are."""
    if (base.quaternion is None) == (base.rpy is None):
        raise mapping.error(("base",), "one orientation is needed", "quaternion = […], or rpy = […]")
    if (base.position is None) == (not base.feet):
        expected = "position = […], or feet = {…} if no position is logged"
        raise mapping.error(("base",), "one source of the position is needed", expected)
    if base.angular_velocity is not None and base.gyro is not None:
        expected = "angular_velocity = […], or gyro = […] with imu_frame"
        raise mapping.error(("base", "gyro"), "one angular velocity is needed", expected)
    if base.orientation_of == "imu" and base.imu_frame is None:
        raise mapping.error(("base", "orientation_of"), "key 'imu_frame' is missing", "a frame of the robot")
    for key, needed, choice in (
        ("quaternion", "quaternion_order", '"wxyz" or "xyzw"'),
        ("linear_velocity", "linear_axes", '"world" or "body"'),
        ("angular_velocity", "angular_axes", '"world" or "body"'),
        ("gyro", "imu_frame", "a frame of the robot"),
        ("accelerometer", "imu_frame", "a frame of the robot"),
        ("accelerometer", "gravity", "true (proper acceleration), or false if gravity is removed"),
    ):
        if getattr(base, key) is not None and getattr(base, needed) is None:
            raise mapping.error(("base", key), f"key {needed!r} is missing", f"{needed} = {choice}")
    for got, unsupported in (
        ("[servo]", mapping.sections.servo is not None),
        ("from_contact under [position]", bool(mapping.sections.position.from_contact)),
    ):
        if unsupported:
            expected = "logged torques, and a column for each joint beside the base"
            raise mapping.error(("base",), f"{got} is not available with a floating base", expected)


def _check_quantity(mapping: Mapping, name: str, section: QuantitySection) -> None:
    allowed = units.QUANTITY[name]
    if section.unit not in allowed:
        near, listing = units.spelled(section.unit), f"one of {', '.join(allowed)}"
        hint = f"did you mean {near!r}?" if near in allowed else None
        raise mapping.error((name, "unit"), "unknown unit", listing, repr(section.unit), hint)
    if section.column is None and not section.columns:
        raise mapping.error((name,), "no column", expected='column = "…{joint}…", or columns = {…}')
    if getattr(section, "unwrap", False) and section.unit in ("m", "mm"):
        raise mapping.error((name, "unwrap"), "a distance does not wrap", "a unit of angle", section.unit)
    if section.side == "motor" and section.gear_ratio is None:
        raise mapping.error((name, "side"), "the motor's side needs a gear ratio", expected="gear_ratio = …")
    valid: dict[str, tuple[str, Callable[[float], bool]]] = {
        "sign": ("1 or -1", lambda n: abs(n) == 1.0),
        "gear_ratio": ("a number that is not 0", lambda n: n != 0.0),
        "torque_constant": ("> 0", lambda n: n > 0.0),
        "stiffness": ("> 0 [N m/rad]", lambda n: n > 0.0),
        "damping": (">= 0 [N m s/rad]", lambda n: n >= 0.0),
        "limit": ("> 0 [N m]", lambda n: n > 0.0),
    }
    for key, (what, right) in valid.items():
        value = getattr(section, key, None)
        numbers = value.values() if isinstance(value, dict) else [] if value is None else [value]
        wrong = [number for number in numbers if number != "auto" and not right(number)]
        if wrong:
            raise mapping.error((name, key), f"not a valid {key.replace('_', ' ')}", what, wrong[0])


def scale_std(mapping: Mapping) -> float | None:
    """Return the stated relative deviation of torques that follow from currents or commands, if not 0."""
    torque, servo = mapping.sections.torque, mapping.sections.servo
    if servo is not None:
        return servo.stiffness_std or None
    return torque.torque_constant_std or None if torque is not None and torque.torque_constant else None


def torque_constants(mapping: Mapping, joints: Sequence[str]) -> tuple[float, ...]:
    """Return the nominal torque of each joint per current [N m/A, N/A]; empty if currents are not logged."""
    torque = mapping.sections.torque
    measured = () if torque is None else mapping.measured("torque", joints)
    if torque is None or torque.torque_constant is None or len(measured) < len(joints):
        return ()
    constants = mapping.per_joint("torque", "torque_constant", measured)
    gears = mapping.per_joint("torque", "gear_ratio", measured) if torque.side == "motor" else 1.0
    return tuple((constants * gears).tolist())


def default_mapping(path: str | Path, system: ConstrainedSystem) -> Mapping:
    """Return the mapping for a log with unambiguous column names; raise `MappingError` otherwise."""
    table, robot = read(path, rows=ROWS), system.robot
    names, joints = set(table.names), robot.joint_names
    for time, words in (("t", SYMBOLS), ("header", ROS_NAMES)):
        logged = {n: word for n, word in words.items() if names >= {f"{word}.{joint}" for joint in joints}}
        if not {"position", "torque"} <= set(logged) or time not in names:
            continue
        # On a topic of joint states, messages of other nodes lack joints or efforts.
        more = {"missing": "drop"} if time == "header" else {}
        draft = Draft(
            str(path), {"column": time, **{name: name for name in NUMBERS if name in names}, **more}
        )
        for name, word in logged.items():
            draft.families[name] = Family(f"{word}.{{joint}}", {}, unit=units.SI[name])
        draft.families["position"].unwrap = True
        for contact in system.contact_names:
            if (column := f"contact.{contact}") in names:
                draft.further[f"contact.{quoted(contact)}"] = {"source": "column", "column": column}
        return parse_mapping(draft.toml().encode(), f"columns named as in {KNOWN_NAMES[time]}")
    raise MappingError(
        f"{path}: the quantities of the columns are unclear",
        expected=f"t, q.{joints[0]}, tau.{joints[0]}, …, or a mapping",
        got=", ".join(table.names[:12]) + (", …" if len(table.names) > 12 else ""),
        hint="write a mapping by --guess mapping.toml, check it, and pass it by --mapping",
    )
