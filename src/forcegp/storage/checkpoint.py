"""The best values of a long fit on disk, so that it can be taken up again."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.files import atomic_file
from forcegp.gp.optimise import Progress
from forcegp.limits import CHECKPOINT_BYTES, CHECKPOINT_VALUE
from forcegp.storage.system import pack_system

INTERVAL = 10.0
"""Least time between two writings [s]."""


@dataclass
class Checkpoint:
    """A safetensors file that holds the best tensors seen while learning, of all restarts together.

    A fit that goes on from a checkpoint begins at these tensors, whose objective is that of the checkpoint
    bit for bit. L-BFGS begins anew there, without its memory of the curvature, so that the fit ends with
    other bits than one that was not interrupted: with an objective that is no larger than the checkpoint's,
    and within a few times `LearningOptions.tolerance` of the other's where both converge to one optimum.

    Args:
        path: the file.
        key: what is being learned; a file that was written for something else is refused.
    """

    path: Path
    key: str
    _written: float = field(default=float("-inf"), init=False)
    _best: float = field(default=float("inf"), init=False)
    _news: dict[str, Tensor] | None = field(default=None, init=False)

    @staticmethod
    def key_of(*values: object) -> str:
        """A short digest of settings, tensors and systems.

        A system counts with its robot, its contacts and their surfaces; of a surface in Python code only
        the class is known.
        """
        digest = hashlib.sha256()
        for value in values:
            if isinstance(value, ConstrainedSystem):
                record, tensors = pack_system(value)
                digest.update(json.dumps(record, sort_keys=True).encode())
                parts: list[object] = [part for pair in sorted(tensors.items()) for part in pair]
            else:
                parts = [value]
            for part in parts:
                digest.update(_bytes_of(part))
        return digest.hexdigest()[:16]

    def read(self, start: Mapping[str, Tensor]) -> dict[str, Tensor] | None:
        """The saved tensors, or `None` where there is no file.

        Raises:
            ModelError: the file is damaged, is a folder, holds impossible values, or belongs to another fit.
        """
        if not self.path.exists():
            return None
        tensors, key = self._content()
        shapes = {name: (value.shape, value.dtype) for name, value in tensors.items()}
        if key != self.key or shapes != {name: (value.shape, value.dtype) for name, value in start.items()}:
            raise ModelError(
                f"{self.path}: the checkpoint belongs to another fit",
                expected=f"data, settings and system with key {self.key}",
                got=key,
                hint="remove it, or name another file",
            )
        for name, value in tensors.items():
            if not bool((value.abs() <= CHECKPOINT_VALUE).all()):
                raise ModelError(
                    f"{self.path}: {name!r} holds a value that no fit reaches",
                    expected=f"finite numbers up to ±{CHECKPOINT_VALUE:g}",
                    hint="remove the checkpoint to start anew",
                )
        return {name: tensors[name].to(value.device) for name, value in start.items()}

    def _content(self) -> tuple[dict[str, Tensor], str | None]:
        if not self.path.is_file():
            raise ModelError(f"{self.path} is no file", expected="the file of a checkpoint")
        try:
            size = self.path.stat().st_size
            if size > CHECKPOINT_BYTES:
                raise ModelError(f"{self.path}: too large for a checkpoint", got=f"{size:,} bytes")
            with safetensors.safe_open(self.path, "pt") as file:
                key = (file.metadata() or {}).get("key")
                return {name: file.get_tensor(name) for name in file.keys()}, key  # noqa: SIM118
        except (safetensors.SafetensorError, OSError, TypeError, RuntimeError) as cause:
            raise ModelError(
                f"{self.path}: the checkpoint is damaged", got=str(cause), hint="remove it to start anew"
            ) from cause

    def noting(self, progress: Progress | None) -> Progress:
        """A progress callback that writes the best tensors now and then, and calls another."""

        def note(evaluations: int, value: float, best: dict[str, Tensor]) -> None:
            if value < self._best:
                self._best, self._news = value, best
            if self._news is not None and time.monotonic() - self._written >= INTERVAL:
                self._write(self._news)
            if progress is not None:
                progress(evaluations, value, best)

        return note

    def _write(self, best: Mapping[str, Tensor]) -> None:
        data = safetensors.torch.save(
            {name: value.detach().cpu().contiguous() for name, value in best.items()}, {"key": self.key}
        )
        with atomic_file(self.path) as temporary:
            temporary.write_bytes(data)
        self._written, self._news = time.monotonic(), None

    def remove(self) -> None:
        """Remove the file of a fit that has ended; call it after the model has been saved."""
        self.path.unlink(missing_ok=True)


def _bytes_of(value: object) -> bytes:
    """What a digest sees of a value; type and shape of a tensor tell it from another with the same bytes."""
    if not isinstance(value, Tensor):
        return repr(value).encode()
    flat = value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy()
    return f"{value.dtype}{tuple(value.shape)}".encode() + flat.tobytes()
