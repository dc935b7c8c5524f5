"""Reader of ROS 1 and ROS 2 bags and MCAP files that needs no ROS installation.

Joint states become the columns `position.<joint>`, `velocity.<joint>` and `effort.<joint>`. Wrenches become
the columns `force.x` to `torque.z`, and vectors of odometry and of an IMU columns with the path of the field,
such as `pose.pose.orientation.x`. All also have the columns `header`, the time stamp of the driver [s], and
`receive`, the time of recording [s]. Each is relative to the earliest one in the log, since float64 cannot
resolve nanoseconds since 1970. Message layouts are those of the ROS distributions, and definitions stored in
a bag are not compiled.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from forcegp import limits
from forcegp.errors import DataError, optional_module
from forcegp.guards import Unpacking, bounded, check_count, check_tables, foreign, starts_with, within
from forcegp.logs.table import Column, LogTable, Progress, Stream, Wanted

JOINT_STATE = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"
_TWIST, _POSE = "twist.twist", "pose.pose"
FIELDS: dict[str, dict[str, str]] = {
    WRENCH: {"wrench.force": "force", "wrench.torque": "torque"},
    "nav_msgs/msg/Odometry": {
        path: path
        for path in (f"{_POSE}.position", f"{_POSE}.orientation", f"{_TWIST}.linear", f"{_TWIST}.angular")
    },
    "sensor_msgs/msg/Imu": {
        path: path for path in ("orientation", "angular_velocity", "linear_acceleration")
    },
}
"""Vectors and quaternions that are read from a message, and the first part of their columns."""
KINDS = (JOINT_STATE, *FIELDS)
"""Types of messages that are read."""
UNITS = {"position": "rad", "velocity": "rad/s", "effort": "Nm", "force": "N", "torque": "Nm"}
"""Units in joint states (REP 103) and in wrenches."""
STAMPS = ("header", "receive")

Found = tuple[str, str, str, int, bytes, int]
"""Topic, type, encoding, recording time [ns] and content of a message, and amount of data read so far."""


def canonical(kind: str) -> str:
    """Return the ROS 2 name of a message type.

    >>> canonical("sensor_msgs/JointState")
    'sensor_msgs/msg/JointState'
    """
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}" if "/" not in name else kind


@cache
def decoder(kind: str, encoding: str) -> Callable[[bytes], Any]:
    """Return a decoder for messages with a type in `KINDS` and the encoding `ros1` or `cdr`."""
    typesys = optional_module("rosbags.typesys", "Reading ROS messages", "import")
    first = encoding == "ros1"
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if first else typesys.Stores.ROS2_HUMBLE)
    deserialize = store.deserialize_ros1 if first else store.deserialize_cdr
    return lambda raw: deserialize(raw, kind)


@dataclass
class Messages:
    """Messages of a topic with the same columns, their time stamps and their recording times [ns]."""

    topic: str
    columns: tuple[str, ...]
    rows: list[list[float]] = field(default_factory=list)
    stamps: list[tuple[int, int]] = field(default_factory=list)

    def stream(self, name: str, origin: np.ndarray, wanted: Wanted) -> Stream:
        """Return the requested columns, with times [s] relative to `origin` [ns]."""
        stamps = (np.array(self.stamps, dtype=np.int64) - origin) * 1e-9
        order = np.argsort(stamps[:, 1], kind="stable")
        header, receive = np.ascontiguousarray(stamps[order].T)
        columns: dict[str, Column] = {"header": header, "receive": receive}
        values = np.ascontiguousarray(np.array(self.rows, dtype=np.float64)[order].T)
        for column, numbers in zip(self.columns, values, strict=True):
            if not np.isnan(numbers).all() and wanted(column):
                columns[column] = numbers
        named = {c: "s" if c in STAMPS else UNITS.get(c.partition(".")[0]) for c in columns}
        return Stream(name, columns, {c: unit for c, unit in named.items() if unit is not None})


@dataclass
class Collector:
    """Collector of the messages in a bag, with one stream for each topic and set of joints."""

    unpacking: Unpacking
    _streams: dict[tuple[str, frozenset[str]], Messages] = field(default_factory=dict)
    _numbers: int = 0

    def take(
        self, messages: Iterable[Found], rows: int | None, progress: Progress | None, total: int
    ) -> None:
        """Collect messages of supported types until one stream has `rows` messages."""
        for topic, kind, encoding, receive_ns, raw, done in messages:
            if kind in KINDS and encoding in ("cdr", "ros1"):
                self._add(topic, kind, encoding, receive_ns, raw)
            if progress is not None and self.unpacking.records % 1024 == 0:
                progress(done, total)
            if rows is not None and any(len(stream.rows) >= rows for stream in self._streams.values()):
                return

    def _add(self, topic: str, kind: str, encoding: str, receive_ns: int, raw: bytes) -> None:
        """Add a message; raise `DataError` if it is too large or its arrays do not match its joint names."""
        check_count(self.unpacking.source, "bytes in one message", len(raw), limits.MESSAGE_BYTES)
        message = decoder(kind, encoding)(raw)
        if kind == JOINT_STATE:
            values = _joint_state(self.unpacking.source, topic, message)
        else:
            parts = {part: attrgetter(path)(message) for path, part in FIELDS[kind].items()}
            values = {
                f"{part}.{axis}": getattr(x, axis)
                for part, x in parts.items()
                for axis in "xyzw"
                if hasattr(x, axis)
            }
        stream = self._streams.setdefault((topic, frozenset(values)), Messages(topic, tuple(values)))
        stamp = message.header.stamp
        stream.rows.append([values[column] for column in stream.columns])
        stream.stamps.append((stamp.sec * 10**9 + stamp.nanosec, receive_ns))
        self._numbers += len(values)
        check_count(self.unpacking.source, "numbers", self._numbers, limits.LOG_VALUES)
        check_count(self.unpacking.source, "streams", len(self._streams), limits.LOG_STREAMS)

    def table(self, format_: str, topics: dict[str, str], wanted: Wanted) -> LogTable:
        """Return the log with the requested columns. `topics` maps all topics in the bag to their types."""
        source = self.unpacking.source
        if not self._streams:
            listing = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items())
            text, got = f"{source}: no messages of a supported type", listing[:600] or "no topics"
            raise DataError(text, expected=" or ".join(KINDS), got=got)
        ordered = sorted(self._streams.values(), key=lambda s: (s.topic, -len(s.rows)))
        origin = np.min([np.min(np.array(stream.stamps), axis=0) for stream in ordered], axis=0)
        streams = []
        for topic, group in groupby(ordered, key=lambda stream: stream.topic):
            for number, stream in enumerate(group, start=1):
                streams.append(stream.stream(f"{topic}#{number}" if number > 1 else topic, origin, wanted))
                stream.rows.clear()
        unread = [f"{t} ({k})" for t, k in topics.items() if canonical(k) not in KINDS]
        remarks = [f"topics of other types were not read: {', '.join(unread)[:600]}"] if unread else []
        remarks.append(f"time 0 is {origin[0] * 1e-9:.9f} s on the clock of the headers")
        return LogTable(source, format_, tuple(streams), tuple(remarks))


def _joint_state(source: str, topic: str, message: Any) -> dict[str, float]:
    """Return position, velocity and effort of each joint, keyed by column, with NaN for empty quantities."""
    names = tuple(str(name)[: limits.LOG_NAME] for name in message.name)
    if not names or len(set(names)) < len(names):
        raise DataError(f"{source}: a joint state on {topic} has no joint names, or one twice", got=names[:8])
    values: dict[str, float] = {}
    for quantity in ("position", "velocity", "effort"):
        numbers = getattr(message, quantity)
        if len(numbers) not in (0, len(names)):
            text = f"{source}: a joint state on {topic} has {len(numbers)} values of {quantity}"
            raise DataError(text, expected=f"one for each of its {len(names)} joints, or none")
        numbers = numbers if len(numbers) else [np.nan] * len(names)
        values |= {f"{quantity}.{name}": float(x) for name, x in zip(names, numbers, strict=True)}
    return values


def read_bag(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the supported messages in a ROS 1 bag, a ROS 2 bag or an MCAP file."""
    files = _files(path) if path.is_dir() else [path]
    unpacking = Unpacking(str(path), sum(file.stat().st_size for file in files))
    collector, topics = Collector(unpacking), dict[str, str]()
    if mcaps := [file for file in files if starts_with(file, b"\x89MCAP0")]:
        with foreign(str(path), "MCAP"):
            messages = (message for file in mcaps for message in _mcap_messages(file, unpacking, topics))
            collector.take(messages, rows, progress, unpacking.file)
        return collector.table("mcap", topics, wanted)
    first = path.is_file() and starts_with(path, b"#ROSBAG V2.0")
    number, encoding = (1, "ros1") if first else (2, "cdr")
    package = optional_module(f"rosbags.rosbag{number}", f"Reading ROS {number} bags", "import")
    if path.is_file() and not first and path.suffix != ".db3":
        raise DataError(f"{path}: an SQLite file without the suffix of a bag", hint="name it .db3")
    with foreign(str(path), "a bag"):
        for file in files:
            check_tables(file)
        reader = bounded(package.Reader, unpacking) if first else package.Reader
        with reader(path) as bag:
            topics |= {c.topic: c.msgtype for c in bag.connections}
            collector.take(_messages(bag, encoding, unpacking), rows, progress, bag.message_count)
    return collector.table(f"rosbag{number}", topics, wanted)


def _messages(bag: Any, encoding: str, unpacking: Unpacking) -> Iterator[Found]:
    """Yield the messages of supported types in a ROS 1 or ROS 2 bag."""
    check_count(unpacking.source, "topics", len(bag.connections), limits.LOG_STREAMS)
    check_count(unpacking.source, "messages", bag.message_count, limits.LOG_MESSAGES)
    used = [c for c in bag.connections if canonical(c.msgtype) in KINDS]
    for done, (connection, stamp, raw) in enumerate(bag.messages(used) if used else []):
        unpacking.read(len(raw))
        unpacking.record()
        yield connection.topic, canonical(connection.msgtype), encoding, stamp, raw, done


def _files(path: Path) -> list[Path]:
    """Return the files in a bag folder except its description; raise `DataError` if they are compressed."""
    description = path / "metadata.yaml"
    files = within(path, sorted(file for file in path.iterdir() if file.is_file()))
    check_count(str(description), "bytes", description.stat().st_size, limits.LISTING_BYTES)
    text = description.read_text(encoding="utf-8", errors="replace")
    if compression := re.search(r"compression_mode:\s*[\"']?(file|message)", text, re.IGNORECASE):
        text = f"{path}: the bag is compressed by {compression[1].lower()}"
        expected = "a bag without compression, or MCAP with compressed chunks"
        raise DataError(text, expected=expected, hint="unpack it with `ros2 bag convert`")
    return [file for file in files if file != description]


def _mcap_messages(path: Path, unpacking: Unpacking, topics: dict[str, str]) -> Iterator[Found]:
    """Yield the messages in an MCAP file in file order, and add their topics and types to `topics`."""
    records = optional_module("mcap.records", "Reading MCAP files", "import")
    schemas, channels = {}, {}
    with path.open("rb") as file:
        for record in _mcap_records(file, unpacking):
            if isinstance(record, records.Schema):
                schemas[record.id] = canonical(record.name)
            elif isinstance(record, records.Channel):
                kind = schemas[record.schema_id] if record.schema_id else record.message_encoding
                topics[record.topic], channels[record.id] = kind, record
                check_count(unpacking.source, "topics", len(channels), limits.LOG_STREAMS)
            elif isinstance(record, records.Message):
                channel = channels[record.channel_id]
                kind, encoding = topics[channel.topic], channel.message_encoding
                yield channel.topic, kind, encoding, record.log_time, record.data, file.tell()


def _mcap_records(file: io.BufferedReader, unpacking: Unpacking) -> Iterator[Any]:
    """Yield the records in an MCAP file in file order, unpacking one chunk at a time."""
    records = optional_module("mcap.records", "Reading MCAP files", "import")
    streams = optional_module("mcap.stream_reader", "Reading MCAP files", "import")
    reader = streams.StreamReader(file, emit_chunks=True, record_size_limit=limits.RECORD_BYTES)
    for record in reader.records:
        if not isinstance(record, records.Chunk):
            yield record
            continue
        content = unpacking.unpack(record.data, record.compression)
        part = streams.ReadDataStream(io.BytesIO(content))
        kinds = {streams.Opcode.SCHEMA: records.Schema, streams.Opcode.CHANNEL: records.Channel}
        while part.count < len(content):
            opcode, size = part.read1(), part.read8()
            unpacking.record()
            if opcode == streams.Opcode.MESSAGE:
                yield records.Message.read(part, size)
            elif opcode in kinds:
                yield kinds[opcode].read(part)
            else:
                part.read(size)
