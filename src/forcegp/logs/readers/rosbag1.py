"""ROS 1 bags, without a ROS installation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from forcegp import limits
from forcegp.logs import bounds
from forcegp.logs.readers.messages import KINDS, Collector, canonical, decoder
from forcegp.logs.table import LogTable, Progress, Wanted, foreign
from forcegp.optional import optional_module


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the joint states and wrenches of a bag.

    Raises:
        DataError: the bag is damaged or too large, or has no message of these types.
        MissingDependencyError: `rosbags` is not installed.
    """
    package = optional_module("rosbags.rosbag1", "Reading ROS 1 bags", "import")
    return read_bag(path, package.Reader, "rosbag1", wanted, rows, progress)


def read_bag(
    path: Path,
    open_bag: Callable[[Path], Any],
    format_: str,
    wanted: Wanted,
    rows: int | None,
    progress: Progress | None,
) -> LogTable:
    """Read what a reader of the package `rosbags`, made by `open_bag`, finds in a bag."""
    encoding = "ros1" if format_ == "rosbag1" else "cdr"
    collector = Collector(str(path))
    with foreign(str(path), "a bag"), open_bag(path) as bag:
        bounds.check_count(str(path), "topics", len(bag.connections), limits.LOG_STREAMS)
        bounds.check_count(str(path), "messages", bag.message_count, limits.LOG_MESSAGES)
        topics = {c.topic: c.msgtype for c in bag.connections}
        used = [c for c in bag.connections if canonical(c.msgtype) in KINDS]
        decoders = {c.msgtype: decoder(canonical(c.msgtype), encoding) for c in used}
        total = sum(c.msgcount for c in used)
        for done, (connection, stamp, raw) in enumerate(bag.messages(used) if used else []):
            kind = canonical(connection.msgtype)
            collector.add(connection.topic, kind, stamp, raw, decoders[connection.msgtype])
            if progress is not None and done % 1024 == 0:
                progress(done, total)
            if rows is not None and collector.rows >= rows:
                break
        return collector.table(format_, topics, wanted)
