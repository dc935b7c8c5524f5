"""The evaluations of a long fit on disk, so that an interrupted fit is resumed to the same bits."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.files import atomic_file
from forcegp.gp.optimise import Objective
from forcegp.limits import CHECKPOINT_BYTES, CHECKPOINT_VALUE, LOGGED_VALUE

INTERVAL = 10.0
"""Least time between two writings [s]."""
NAMES = ("positions", "objectives", "gradients")


@dataclass
class Checkpoint:
    """A safetensors file with every evaluation of an objective: where, its value and its gradient.

    A resumed fit runs the optimiser again from the start and gives it the recorded values, which takes no
    time, until they end. So it ends with the same bits as a fit that was not interrupted, after warm starts
    and restarts too. Where the optimiser asks for another point than the recorded one (another machine or
    release of a library), the rest of the record is dropped and evaluated anew.

    Args:
        path: the file.
        key: what is being learned; a file that was written for something else is refused.
    """

    path: Path
    key: str
    _record: list[tuple[Tensor, Tensor, Tensor]] = field(default_factory=list, init=False)
    _next: int = field(default=0, init=False)
    _written: float = field(default=float("-inf"), init=False)

    @staticmethod
    def key_of(*values: object) -> str:
        """A short digest of settings and tensors, and of the release of this library."""
        digest = hashlib.sha256(version("forcegp").encode())
        for value in values:
            digest.update(_bytes_of(value))
        return digest.hexdigest()[:16]

    def read(self, start: Mapping[str, Tensor]) -> int:
        """Take up the evaluations in the file, if there is one.

        Args:
            start: initial tensors of what is learned.

        Returns:
            How many evaluations will not be repeated.

        Raises:
            ModelError: the file is damaged, is a folder, holds impossible values, or belongs to another fit.
        """
        if not self.path.exists():
            return 0
        tensors, key = read_keyed(self.path)
        size = sum(value.numel() for value in start.values())
        n = len(tensors["objectives"]) if tensors.get("objectives", torch.zeros(())).ndim == 1 else -1
        shapes = {"positions": (n, size), "objectives": (n,), "gradients": (n, size)}
        found = {name: tuple(value.shape) for name, value in tensors.items()}
        if key != self.key or found != shapes or any(x.dtype != torch.float64 for x in tensors.values()):
            raise belongs_elsewhere(self.path, self.key, key)
        for name, value in tensors.items():
            most = CHECKPOINT_VALUE if name == "positions" else LOGGED_VALUE
            if not bool((value.abs() <= most).all()):
                raise ModelError(
                    f"{self.path}: {name!r} holds a value that no fit reaches",
                    expected=f"finite numbers up to ±{most:g}",
                    hint="remove the checkpoint to start anew",
                )
        self._record = list(zip(*(tensors[name] for name in NAMES), strict=True))
        self._next = 0
        return n

    def recorded(self, objective: Objective) -> Objective:
        """The same objective, with its evaluations read from the record as far as it goes, then recorded."""

        def again(tensors: dict[str, Tensor]) -> Tensor:
            names = sorted(tensors)
            here = _flat([tensors[name] for name in names])
            if self._next < len(self._record) and torch.equal(self._record[self._next][0], here):
                _, value, gradient = self._record[self._next]
            else:
                del self._record[self._next :]
                value, gradient = _evaluated(objective, tensors, names)
                self._record.append((here, value, gradient))
                self._write_now_and_then()
            self._next += 1
            like = tensors[names[0]]
            given = value.to(like), gradient.to(like)
            return _Given.apply(*given, *(tensors[name] for name in names))  # pyright: ignore[reportReturnType]

        return again

    def _write_now_and_then(self) -> None:
        if time.monotonic() - self._written >= INTERVAL:
            self.write()

    def write(self) -> None:
        """Write all evaluations so far, up to the first that is not finite.

        Raises:
            DestinationError: the place cannot be written.
        """
        record = []
        for entry in self._record:
            if not all(bool((part.abs() <= LOGGED_VALUE).all()) for part in entry):
                break
            record.append(entry)
        if record:
            parts = (torch.stack(part) for part in zip(*record, strict=True))
            write_record(self.path, dict(zip(NAMES, parts, strict=True)), self.key)
        self._written = time.monotonic()


def write_record(path: Path, tensors: Mapping[str, Tensor], key: str) -> None:
    """Write a checkpoint, whole or not at all.

    Raises:
        DestinationError: the place cannot be written.
    """
    data = safetensors.torch.save({name: x.contiguous() for name, x in tensors.items()}, {"key": key})
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)


def belongs_elsewhere(path: Path, key: str, found: str | None) -> ModelError:
    """The error for a checkpoint of another fit."""
    return ModelError(
        f"{path}: the checkpoint belongs to another fit",
        expected=f"data, settings and system with key {key}",
        got=found,
        hint="remove it, or name another file",
    )


def _flat(tensors: list[Tensor]) -> Tensor:
    return torch.cat([x.detach().to("cpu", torch.float64).reshape(-1) for x in tensors])


def _evaluated(
    objective: Objective, tensors: Mapping[str, Tensor], names: list[str]
) -> tuple[Tensor, Tensor]:
    """Value and gradient of an objective, on the CPU in float64."""
    leaves = {name: value.detach().requires_grad_() for name, value in tensors.items()}
    with torch.enable_grad():
        value = objective(leaves)
        grads = torch.autograd.grad(value, [leaves[name] for name in names], allow_unused=True)
    whole = [torch.zeros_like(leaves[n]) if g is None else g for n, g in zip(names, grads, strict=True)]
    return value.detach().to("cpu", torch.float64), _flat(whole)


class _Given(torch.autograd.Function):
    """A value whose gradient is known."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, gradient: Tensor, *tensors: Tensor) -> Tensor:
        ctx.gradient, ctx.shapes = gradient, [x.shape for x in tensors]
        return value.clone()

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        parts = ctx.gradient.split([shape.numel() for shape in ctx.shapes])
        return None, None, *(outer * x.reshape(s) for x, s in zip(parts, ctx.shapes, strict=True))


def _bytes_of(value: object) -> bytes:
    """What a digest sees of a value; type and shape of a tensor tell it from another with the same bytes."""
    if not isinstance(value, Tensor):
        return repr(value).encode()
    flat = value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy()
    return f"{value.dtype}{tuple(value.shape)}".encode() + flat.tobytes()


def read_keyed(path: Path) -> tuple[dict[str, Tensor], str | None]:
    """The tensors of a checkpoint, and the key of what it was written for.

    Raises:
        ModelError: the file is damaged, too large, or is a folder.
    """
    if not path.is_file():
        raise ModelError(f"{path} is not a file", expected="the file of a checkpoint")
    try:
        with path.open("rb") as file:
            data = file.read(CHECKPOINT_BYTES + 1)
        if len(data) > CHECKPOINT_BYTES:
            raise ModelError(f"{path}: too large for a checkpoint", got=f"> {CHECKPOINT_BYTES} bytes")
        # Of one content: a library that opens the file twice may see two versions of it.
        tensors = safetensors.torch.load(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        return tensors, header.get("__metadata__", {}).get("key")
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as cause:
        if isinstance(cause, ModelError):
            raise
        raise ModelError(
            f"{path}: the checkpoint is damaged", got=str(cause), hint="remove it to start anew"
        ) from cause
