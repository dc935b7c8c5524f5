"""One target per reader: bytes in, `None` out; a typed error is an answer, anything else is a finding."""

from __future__ import annotations

import hashlib
import json
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

import forcegp
from forcegp.data import Dataset
from forcegp.errors import ForceGPError
from forcegp.storage.model_file import HEADER, NO_HASH, SUFFIX

CORPORA = Path(__file__).parent / "corpora"


def answered(reader: Callable[[bytes, Path], None], data: bytes, folder: Path) -> str:
    """Run a reader on some bytes.

    Returns:
        `"read"`, or the name of the class of its typed error.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            reader(data, folder)
        except ForceGPError as error:
            str(error)
            return type(error).__name__
    return "read"


def _file(ending: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], None]:
    def target(data: bytes, folder: Path) -> None:
        path = folder / f"input{ending}"
        path.write_bytes(data)
        read(path)

    return target


def _scene(path: Path) -> None:
    forcegp.load_scene(path).system()


def _log(path: Path) -> None:
    """A log of another program, whose reader is chosen by its content."""
    from forcegp.logs.readers import read

    read(path)


def model_of(data: bytes, folder: Path) -> None:
    """A model under a hash that fits: a length (4 bytes), the header of the model, a safetensors file."""
    length = int.from_bytes(data[:4], "little")
    header, tensors = data[4 : 4 + length], data[4 + length :]
    start = int.from_bytes(tensors[:8], "little")
    try:
        table = json.loads(tensors[8 : 8 + start])
        table["__metadata__"] = {HEADER: f"{NO_HASH}\n" + header.decode("utf-8", "replace")}
        text = json.dumps(table, separators=(",", ":")).encode()
        content = len(text).to_bytes(8, "little") + text + tensors[8 + start :]
        digest = hashlib.sha256(content).hexdigest()
        content = content.replace(f'"{HEADER}":"{NO_HASH}'.encode(), f'"{HEADER}":"{digest}'.encode(), 1)
    except (ValueError, TypeError, RecursionError):
        content = tensors
    file = folder / f"model{SUFFIX}"
    file.write_bytes(content)
    model = forcegp.load_model(file)
    states = torch.full((3, 2, model.system.robot.nq), 0.1, dtype=model.system.robot.dtype)
    prediction = model.predict(*states)
    assert bool(torch.isfinite(prediction.mean).all())


TARGETS: dict[str, Callable[[bytes, Path], None]] = {
    "csv": _file(".csv", Dataset.read),
    "parquet": _file(".parquet", Dataset.read),
    "scene": _file(".toml", _scene),
    "model": model_of,
    "urdf": _file(".urdf", forcegp.load_robot),
    "mjcf": _file(".xml", forcegp.load_robot),
    "log-text": _file(".txt", _log),
    "log-npz": _file(".npz", _log),
    "log-matlab": _file(".mat", _log),
    "log-hdf5": _file(".h5", _log),
    "log-rosbag1": _file(".bag", _log),
    "log-rosbag2": _file(".db3", _log),
    "log-mcap": _file(".mcap", _log),
}
"""The readers, by name."""


def seeds(name: str) -> list[bytes]:
    """The kept inputs of a target: valid files, and what was once a finding."""
    return [
        path.read_bytes()
        for path in sorted((CORPORA / name).iterdir())
        if path.is_file() and path.name != ".current"
    ]


def run_one(name: str, data: bytes) -> str:
    """Run one input of one target in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        return answered(TARGETS[name], data, Path(folder))
