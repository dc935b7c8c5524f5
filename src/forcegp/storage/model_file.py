"""Saved models, each in one safetensors file with a versioned header and a hash of the whole file.

The hash is the SHA-256 of the file with 64 zeros in place of the hash, so that any changed bit in the header
or the tensors is detected. The file is replaced by a single `os.replace`, so that a reader sees either the
old model or the new one. Tensors are checked once, when the file is read.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.files import Header, M, Record, atomic_file, validated
from forcegp.limits import HEADER_BYTES, MODEL_BYTES, TENSORS
from forcegp.resources import announce_memory
from forcegp.storage.system import MAY_BE_INFINITE, pack_system

TYPES = (torch.float64, torch.float32, torch.int64, torch.bool)
"""Data types allowed for the tensors of a model."""

_MAY_BE_INFINITE = re.compile(rf"(system|start)\.({'|'.join(MAY_BE_INFINITE)})")
_POSITIVE = re.compile(r"(data\.\d+|training)\.noise_std|std\.[^.]+|scale\..+\.std\.[^.]+")
"""Names of tensors that must be positive, which are standard deviations of the noise and of scaled inputs."""


def check_tensors(tensors: Mapping[str, Tensor], source: str) -> None:
    """Check the number, types and values of tensors, for example that standard deviations are positive."""
    if len(tensors) > TENSORS:
        raise ModelError(f"{source}: too many tensors", expected=f"at most {TENSORS}", got=len(tensors))
    for name, value in tensors.items():
        if value.dtype not in TYPES:
            text = f"{source}: tensor {name!r} has an unsupported type"
            raise ModelError(text, expected=", ".join(str(dtype) for dtype in TYPES), got=value.dtype)
        infinite = _MAY_BE_INFINITE.fullmatch(name) is not None
        if bool(value.isnan().any()) or not (infinite or bool(torch.isfinite(value).all())):
            raise ModelError(f"{source}: tensor {name!r} contains values that are not finite")
        if _POSITIVE.fullmatch(name) and not bool((value > 0.0).all()):
            text = f"{source}: tensor {name!r} contains a standard deviation that is not positive"
            raise ModelError(text, got=value.min().item())


SUFFIX = ".safetensors"
HEADER = "forcegp"
"""Metadata key for the hash and the JSON header."""
NO_HASH = "0" * 64
COPIES = 3
"""Copies of a model in memory during reading: the file content, and tensors before and after alignment."""


class ModelHeader(Header):
    """Header of a saved model: its `Model.kind`, settings, and system as returned by `pack_system`."""

    FORMAT: ClassVar[str] = "forcegp-model"
    VERSION: ClassVar[int] = 5

    kind: str
    settings: dict[str, Any]
    system: dict[str, Any]

    def settings_as(self, kind: type[M], source: str) -> M:
        """Validate the settings of a saved model; raise a `ModelError` that names the file and the field."""
        return validated(kind, self.settings, source, ModelError, ("settings",))


def model_path(path: str | Path) -> Path:
    """Return the path of a model, with the suffix `.safetensors` appended if it is missing."""
    path = Path(path)
    if path.name in ("", ".."):
        raise ModelError("the path of a model has no name", expected="a file", got=repr(str(path)))
    return path if path.suffix == SUFFIX else path.with_name(path.name + SUFFIX)


def model_bytes(
    kind: str, system: ConstrainedSystem, settings: Record, tensors: Mapping[str, Tensor]
) -> bytes:
    """Return the content of a model file. Tensor names must not begin with `system.`."""
    record, robot = pack_system(system)
    copies = {name: value.detach().to("cpu", copy=True).contiguous() for name, value in tensors.items()}
    header = ModelHeader(kind=kind, settings=settings.model_dump(mode="json"), system=record)
    data = safetensors.torch.save(copies | robot, {HEADER: f"{NO_HASH}\n{header.to_json()}"})
    return data.replace(_entry(NO_HASH), _entry(hashlib.sha256(data).hexdigest()), 1)


def write_model(
    path: str | Path, kind: str, system: ConstrainedSystem, settings: Record, tensors: Mapping[str, Tensor]
) -> None:
    """Write a model file atomically; raise `DestinationError` if the path is not writable."""
    data = model_bytes(kind, system, settings, tensors)
    with atomic_file(model_path(path)) as temporary:
        temporary.write_bytes(data)


def read_model(path: str | Path) -> tuple[ModelHeader, dict[str, Tensor]]:
    """Return the header and tensors of a saved model; raise `ModelError` if it is damaged or missing."""
    file = model_path(path)
    try:
        if not file.is_file():
            hint = None
            if Path(path).is_dir():
                hint = "models were folders before version 3: fit the model again with this release"
            raise ModelError(f"{file} is not a saved model", expected="a file written by `save`", hint=hint)
        size = file.stat().st_size
        if size > MODEL_BYTES:
            raise ModelError(f"{file}: too large", expected=f"at most {MODEL_BYTES:,} bytes", got=f"{size:,}")
        announce_memory(COPIES * size, f"reading {file}")
        data = file.read_bytes()
    except OSError as cause:
        raise ModelError(f"{file}: cannot be read", got=cause.strerror or str(cause)) from cause
    return parse_model(data, str(file))


def parse_model(data: bytes, source: str) -> tuple[ModelHeader, dict[str, Tensor]]:
    """Return the header and tensors in the content of a model file; raise `ModelError` if it is invalid."""
    stated, _, text = _metadata(data, source).partition("\n")
    digest = _digest(data, stated)
    if digest != stated:
        text, hint = f"{source}: the file is damaged or truncated", "copy the file again from its source"
        raise ModelError(text, expected=f"SHA-256 {stated[:12]!a}…", got=f"{digest[:12]}…", hint=hint)
    header = ModelHeader.from_json(text, source, ModelError)
    try:
        tensors = safetensors.torch.load(data)
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError, RuntimeError) as cause:
        raise ModelError(f"{source}: not a safetensors file", got=str(cause)) from cause
    check_tensors(tensors, source)
    # Copies, since vectorised kernels may round differently on memory that is not aligned as their own.
    return header, {name: value.clone() for name, value in tensors.items()}


def _metadata(data: bytes, source: str) -> str:
    """Return the hash and the header of a model from the metadata of a safetensors file."""
    size = int.from_bytes(data[:8], "little")
    try:
        if not 0 < size <= min(len(data) - 8, HEADER_BYTES):
            raise ValueError(f"header of {size} bytes in a file of {len(data)}")
        text = json.loads(data[8 : 8 + size])["__metadata__"][HEADER]
        if not isinstance(text, str):
            raise ValueError("the metadata are not text")
    except (ValueError, KeyError, TypeError, RecursionError) as cause:
        text = f"{source}: not a model of forcegp, or damaged"
        raise ModelError(text, expected="a safetensors file", got=str(cause)) from cause
    return text


def _digest(data: bytes, stated: str) -> str:
    """Return the SHA-256 of the file with zeros in place of the stored hash."""
    is_hash = len(stated) == len(NO_HASH) and stated.isascii()
    start = data.find(_entry(stated), 0, 8 + int.from_bytes(data[:8], "little")) if is_hash else -1
    if start < 0:
        return hashlib.sha256(data).hexdigest()
    digest = hashlib.sha256(memoryview(data)[:start])
    digest.update(_entry(NO_HASH))
    digest.update(memoryview(data)[start + len(_entry(stated)) :])
    return digest.hexdigest()


def _entry(digest: str) -> bytes:
    """Return the hash entry of the header, which is unique because quotes in other entries are escaped."""
    return f'"{HEADER}":"{digest}'.encode()
