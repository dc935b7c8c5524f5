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
from forcegp.storage.checkpoint import Checkpoint
from forcegp.storage.folder import HEADER_FILE, TENSOR_FILE

CORPORA = Path(__file__).parent / "corpora"

START = {"a": torch.zeros(3, dtype=torch.float64)}


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
    """A model folder whose hash is repaired: a length (4 bytes), `model.json`, `model.safetensors`."""
    length = int.from_bytes(data[:4], "little")
    header, tensors = data[4 : 4 + length], data[4 + length :]
    try:
        fields = json.loads(header)
        if isinstance(fields, dict):
            fields["sha256"] = hashlib.sha256(tensors).hexdigest()
            header = json.dumps(fields).encode()
    except (ValueError, RecursionError):
        pass
    (folder / HEADER_FILE).write_bytes(header)
    (folder / TENSOR_FILE).write_bytes(tensors)
    model = forcegp.load_model(folder)
    states = torch.full((3, 2, model.system.robot.nq), 0.1, dtype=model.system.robot.dtype)
    prediction = model.predict(*states)
    assert bool(torch.isfinite(prediction.mean).all())


def _checkpoint(path: Path) -> None:
    Checkpoint(path, "key").read(START)


TARGETS: dict[str, Callable[[bytes, Path], None]] = {
    "csv": _file(".csv", Dataset.read),
    "parquet": _file(".parquet", Dataset.read),
    "scene": _file(".toml", _scene),
    "model": model_of,
    "checkpoint": _file(".ckpt", _checkpoint),
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
