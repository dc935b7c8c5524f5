"""The best values of a long fit on disk, so that it can be taken up again."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.files import atomic_file
from forcegp.gp.optimise import Progress

INTERVAL = 10.0
"""Least time between two writings [s]."""


@dataclass
class Checkpoint:
    """A safetensors file that holds the best tensors seen while learning.

    L-BFGS begins anew from them: its memory of the curvature is not kept.

    Args:
        path: the file.
        key: what is being learned; a file that was written for something else is refused.
    """

    path: Path
    key: str
    _written: float = field(default=float("-inf"), init=False)

    @staticmethod
    def key_of(*values: object) -> str:
        """A short digest of settings and tensors."""
        digest = hashlib.sha256()
        for value in values:
            if isinstance(value, Tensor):
                digest.update(value.detach().cpu().contiguous().view(torch.uint8).numpy().tobytes())
            else:
                digest.update(repr(value).encode())
        return digest.hexdigest()[:16]

    def read(self, start: Mapping[str, Tensor]) -> dict[str, Tensor] | None:
        """The saved tensors, or `None` where there is no file.

        Raises:
            ModelError: the file is damaged, or belongs to another fit.
        """
        if not self.path.is_file():
            return None
        try:
            with safetensors.safe_open(self.path, "pt") as file:
                key = (file.metadata() or {}).get("key")
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (safetensors.SafetensorError, ValueError) as cause:
            raise ModelError(
                f"{self.path}: the checkpoint is damaged", hint="remove it to start anew"
            ) from cause
        shapes = {name: value.shape for name, value in tensors.items()}
        if key != self.key or shapes != {name: value.shape for name, value in start.items()}:
            raise ModelError(
                f"{self.path}: the checkpoint belongs to another fit",
                expected=f"data and settings with key {self.key}",
                got=key,
                hint="remove it, or name another file",
            )
        return {name: tensors[name].to(value) for name, value in start.items()}

    def noting(self, progress: Progress | None) -> Progress:
        """A progress callback that writes the best tensors now and then, and calls another."""

        def note(evaluations: int, value: float, best: dict[str, Tensor]) -> None:
            if time.monotonic() - self._written >= INTERVAL:
                self._write(best)
            if progress is not None:
                progress(evaluations, value, best)

        return note

    def _write(self, best: Mapping[str, Tensor]) -> None:
        data = safetensors.torch.save(
            {name: value.detach().cpu().contiguous() for name, value in best.items()}, {"key": self.key}
        )
        with atomic_file(self.path) as temporary:
            temporary.write_bytes(data)
        self._written = time.monotonic()

    def remove(self) -> None:
        """Remove the file of a fit that has ended."""
        self.path.unlink(missing_ok=True)
