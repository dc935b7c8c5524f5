"""Everything in the library that writes to disk: versions to write, and how to read which one is there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import forcegp
from forcegp import native
from forcegp.data import Dataset
from forcegp.files import write_text, written_folder
from forcegp.models.base import FittedModel
from logs import random_log
from random_data import table_system

Write = Callable[[Path, int], None]
Read = Callable[[Path], int]

LOGS = {version: random_log(seed=version) for version in (1, 2)}
SYSTEM = table_system()


@dataclass(frozen=True)
class Writer:
    """Writes version 1 or 2 to a path, and reads which one is there; reading a mixture is an error.

    Attributes:
        also: what else may be there while version 2 is written: the first evaluation, no kernel yet.
    """

    name: str
    ending: str
    write: Write
    read: Read
    also: int = 2


def write_text_file(path: Path, version: int) -> None:
    write_text(path, str(version))


def read_text_file(path: Path) -> int:
    return int(path.read_text())


def write_folder(path: Path, version: int) -> None:
    with written_folder(path) as temporary:
        (temporary / "a").write_text(str(version))
        (temporary / "b").write_text(str(version))


def read_folder(path: Path) -> int:
    a, b = (path / "a").read_text(), (path / "b").read_text()
    assert a == b, "files of two versions"
    return int(b)


def read_log(path: Path) -> int:
    seed = Dataset.read(path).header.seed
    assert seed is not None
    return seed


def model(version: int) -> FittedModel:
    """The analytical model of a robot file."""
    robot = SYSTEM.robot.replace(mass=SYSTEM.robot.mass * version)
    return forcegp.AnalyticalModel(SYSTEM.with_robot(robot)).nominal()


def read_model(path: Path) -> int:
    mass = forcegp.load_model(path).system.robot.mass
    return int((mass / SYSTEM.robot.mass).mean().round())


def write_kernel(path: Path, version: int) -> None:
    native.store(native.private_folder(path), f"key{version}", b"library" * version)


def read_kernel(path: Path) -> int:
    found = [version for version in (1, 2) if native.find(native.private_folder(path), f"key{version}")]
    return max(found, default=0)


WRITERS = (
    Writer("text", ".txt", write_text_file, read_text_file),
    Writer("folder", "", write_folder, read_folder),
    Writer("log", ".parquet", lambda path, version: LOGS[version].write(path), read_log),
    Writer("model", ".safetensors", lambda path, version: model(version).save(path), read_model),
    Writer("kernels", "", write_kernel, read_kernel, also=0),
)
