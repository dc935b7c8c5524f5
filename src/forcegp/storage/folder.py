"""The folder of a saved model: `model.json`, a versioned header, and `model.safetensors`, its tensors."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import safetensors
import safetensors.torch
from pydantic import BaseModel, ConfigDict, ValidationError
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.destination import check_destination
from forcegp.errors import ModelError
from forcegp.exchange import recover
from forcegp.files import Header, atomic_directory
from forcegp.limits import HEADER_BYTES, MODEL_BYTES
from forcegp.resources import announce_memory
from forcegp.storage.system import PREFIX, pack_system
from forcegp.storage.validate import check_tensors

HEADER_FILE = "model.json"
TENSOR_FILE = "model.safetensors"
OWN_FILES = (HEADER_FILE, TENSOR_FILE)
COPIES = 3
"""A model is in memory as the bytes of its file, and as tensors before and after they are aligned."""


class ModelHeader(Header):
    """What a saved model says of itself.

    Attributes:
        kind: class of models, `Model.kind`.
        settings: what the kind needs beside its tensors.
        system: the system, as written by `pack_system`.
        sha256: of the file of tensors, so that a damaged one is noticed.
    """

    FORMAT: ClassVar[str] = "forcegp-model"
    VERSION: ClassVar[int] = 3

    kind: str
    settings: dict[str, Any]
    system: dict[str, Any]
    sha256: str


class Settings(BaseModel):
    """Base of what a kind of models keeps in `ModelHeader.settings`: frozen, no unknown field."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


SettingsT = TypeVar("SettingsT", bound=Settings)


def write_model(
    path: str | Path,
    kind: str,
    system: ConstrainedSystem,
    settings: Settings,
    tensors: Mapping[str, Tensor],
) -> None:
    """Write the folder of a model, whole or not at all.

    Args:
        path: the folder; one that exists is replaced if it holds a model and nothing else, or nothing.
        kind: `Model.kind`.
        system: written beside the model.
        settings: of the kind.
        tensors: of the model, by names that do not begin with `system.`.

    Raises:
        ModelError: the folder holds something else than a model.
        OSError: the place cannot be written.
    """
    folder = Path(path)
    foreign = sorted({x.name for x in folder.iterdir()} - set(OWN_FILES)) if folder.is_dir() else []
    if foreign:
        raise ModelError(
            f"{folder} holds other files than a model, which would be lost",
            got=", ".join(foreign[:5]),
            hint="name a folder that is new, empty or a model",
        )
    json, robot = pack_system(system)
    own = {name: value.detach().to("cpu", copy=True).contiguous() for name, value in tensors.items()}
    data = safetensors.torch.save(own | robot)
    header = ModelHeader(
        kind=kind,
        settings=settings.model_dump(mode="json"),
        system=json,
        sha256=hashlib.sha256(data).hexdigest(),
    )
    with atomic_directory(folder) as temporary:
        (temporary / TENSOR_FILE).write_bytes(data)
        (temporary / HEADER_FILE).write_text(header.to_json() + "\n", encoding="utf-8")


def read_model(path: str | Path) -> tuple[ModelHeader, dict[str, Tensor]]:
    """Header and tensors of a saved model, those of its system among them.

    Raises:
        ModelError: no model is there, or a file of it is damaged; names the file.
    """
    folder = Path(path)
    recover(folder)
    for name in (HEADER_FILE, TENSOR_FILE):
        if not (folder / name).is_file():
            raise ModelError(
                f"{folder} holds no saved model", expected=f"a folder with {HEADER_FILE} and {TENSOR_FILE}"
            )
    source = folder / HEADER_FILE
    header = ModelHeader.from_json(_content(source, HEADER_BYTES), str(source), ModelError)
    data = _content(folder / TENSOR_FILE, MODEL_BYTES)
    digest = hashlib.sha256(data).hexdigest()
    if digest != header.sha256:
        raise ModelError(
            f"{folder / TENSOR_FILE}: the file is damaged, truncated or of another model",
            expected=f"the SHA-256 in {HEADER_FILE}, {header.sha256[:12]}…",
            got=f"{digest[:12]}…",
            hint="copy the folder again from where it was written",
        )
    try:
        tensors = safetensors.torch.load(data)
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError, RuntimeError) as cause:
        raise ModelError(f"{folder / TENSOR_FILE}: not a safetensors file", got=str(cause)) from cause
    check_tensors(tensors, str(folder / TENSOR_FILE))
    # Copies, since vectorised kernels may round differently on memory that is not aligned as their own.
    return header, {name: value.clone() for name, value in tensors.items()}


def _content(file: Path, most: int) -> bytes:
    """The bytes of a file of bounded size."""
    try:
        size = file.stat().st_size
        if size > most:
            raise ModelError(f"{file}: too large", expected=f"at most {most:,} bytes", got=f"{size:,}")
        announce_memory(COPIES * size, f"reading {file}")
        return file.read_bytes()
    except OSError as cause:
        raise ModelError(f"{file}: cannot be read", got=cause.strerror or str(cause)) from cause


def check_model_destination(path: str | Path, needed_bytes: int = 0) -> None:
    """Check, before a long fit, that `write_model` will be able to write a model.

    Args:
        path: the folder.
        needed_bytes: room that the model takes, where it is known [bytes].

    Raises:
        DestinationError: the folder holds other files than a model, or the place cannot be written.
    """
    check_destination(path, folder=True, own_files=OWN_FILES, needed_bytes=needed_bytes)


def own_tensors(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of the model itself, without its system's."""
    return {name: value for name, value in tensors.items() if not name.startswith(PREFIX)}


def settings_of(header: ModelHeader, kind: type[SettingsT], source: str) -> SettingsT:
    """The settings of a saved model, checked.

    Raises:
        ModelError: a field is missing, unknown or not valid; names file and field.
    """
    try:
        return kind.model_validate(header.settings)
    except ValidationError as cause:
        first = cause.errors()[0]
        place = ".".join(str(part) for part in ("settings", *first["loc"]))
        raise ModelError(
            f"{source}: field {place!r} is not valid", expected=first["msg"], got=first["input"]
        ) from cause
