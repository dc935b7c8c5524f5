"""MCAP files with ROS 1 or ROS 2 messages."""

from __future__ import annotations

from pathlib import Path

from forcegp import limits
from forcegp.logs import bounds
from forcegp.logs.readers.messages import KINDS, Collector, Decode, canonical, decoder
from forcegp.logs.table import LogTable, Progress, Wanted, foreign
from forcegp.optional import optional_module

RECORD_BYTES = 256 << 20
"""Largest record, packed, that is loaded."""


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the joint states and wrenches of an MCAP file, also of one that was cut off and has no index.

    Raises:
        DataError: the file is damaged or too large, or has no message of these types.
        MissingDependencyError: `mcap` or `rosbags` is not installed.
    """
    package = optional_module("mcap.reader", "Reading MCAP files", "import")
    collector = Collector(str(path))
    decoders: dict[int, Decode | None] = {}
    topics: dict[str, str] = {}
    with foreign(str(path), "MCAP"), path.open("rb") as file:
        reader = package.SeekingReader(file, record_size_limit=RECORD_BYTES)
        summary = reader.get_summary()
        statistics = summary.statistics if summary is not None else None
        total = statistics.message_count if statistics is not None else 0
        bounds.check_count(str(path), "messages", total, limits.LOG_MESSAGES)
        for schema, channel, message in reader.iter_messages():
            if channel.id not in decoders:
                kind = canonical(schema.name) if schema is not None else ""
                topics[channel.topic] = kind or channel.message_encoding
                bounds.check_count(str(path), "topics", len(decoders), limits.LOG_STREAMS)
                known = kind in KINDS and channel.message_encoding in ("cdr", "ros1")
                decoders[channel.id] = decoder(kind, channel.message_encoding) if known else None
            decode = decoders[channel.id]
            if decode is not None:
                collector.add(channel.topic, topics[channel.topic], message.log_time, message.data, decode)
                if progress is not None and collector.rows % 1024 == 0:
                    progress(collector.rows, max(total, collector.rows))
                if rows is not None and collector.rows >= rows:
                    break
        return collector.table("mcap", topics, wanted)
