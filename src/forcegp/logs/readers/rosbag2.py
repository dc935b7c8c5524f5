"""ROS 2 bags: a folder with its metadata, or a bare `.db3` file."""

from __future__ import annotations

import re
from pathlib import Path

from forcegp.errors import DataError
from forcegp.logs import bounds
from forcegp.logs.readers.rosbag1 import read_bag
from forcegp.logs.table import LogTable, Progress, Wanted
from forcegp.optional import optional_module


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the joint states and wrenches of a bag.

    Raises:
        DataError: the bag is damaged, compressed or too large, or has no message of these types.
        MissingDependencyError: `rosbags` is not installed.
    """
    package = optional_module("rosbags.rosbag2", "Reading ROS 2 bags", "import")
    if path.is_dir():
        _check_metadata(path)
    elif path.suffix != ".db3":
        raise DataError(f"{path}: an SQLite file that is not named as a bag", hint="name it .db3")
    return read_bag(path, package.Reader, "rosbag2", wanted, rows, progress)


def _check_metadata(path: Path) -> None:
    """Refuse a bag whose unpacked size nobody knows."""
    file = path / "metadata.yaml"
    bounds.check_count(str(file), "bytes", file.stat().st_size, 8 << 20)
    text = file.read_text(encoding="utf-8", errors="replace")
    found = re.search(r"compression_mode:\s*[\"']?(file|message)", text, re.IGNORECASE)
    if found:
        raise DataError(
            f"{path}: the bag is compressed by {found[1].lower()}",
            expected="a bag without compression, or MCAP with compressed chunks",
            hint="unpack it with `ros2 bag convert`",
        )
