"""Sums over the samples of a long log on disk, so that an interrupted pass goes on where it stopped."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.files import atomic_file
from forcegp.storage.checkpoint import INTERVAL, read_keyed

SUFFIX = ".sums"
"""What the name of the file adds to that of the checkpoint of learning."""


def beside(checkpoint: str | Path) -> Path:
    """The file of sums that belongs to the checkpoint of learning."""
    path = Path(checkpoint)
    return path.with_name(path.name + SUFFIX)


@dataclass
class SumsCheckpoint:
    """A safetensors file with the tensors of a pass over a log.

    Args:
        path: the file.
        key: what is summed over, and with what; a file that was written for something else is refused.
    """

    path: Path
    key: str
    _written: float = field(default=float("-inf"), init=False)

    def read(self) -> dict[str, Tensor]:
        """The tensors in the file, none where there is not a file.

        Raises:
            ModelError: the file is damaged, or belongs to another fit.
        """
        if not self.path.exists():
            return {}
        tensors, key = read_keyed(self.path)
        if key != self.key:
            raise ModelError(
                f"{self.path}: the checkpoint belongs to another fit",
                expected=f"log, settings and hyperparameters with key {self.key}",
                got=key,
                hint="remove it, or name another file",
            )
        if not all(bool(torch.isfinite(x).all()) for x in tensors.values() if x.is_floating_point()):
            raise ModelError(f"{self.path}: a sum is not finite", hint="remove the checkpoint to start anew")
        return tensors

    def write_now_and_then(self, tensors: Mapping[str, Tensor]) -> None:
        """Write the tensors, unless the last writing is a short time ago."""
        if time.monotonic() - self._written >= INTERVAL:
            own = {name: x.detach().to("cpu", copy=True).contiguous() for name, x in tensors.items()}
            with atomic_file(self.path) as temporary:
                temporary.write_bytes(safetensors.torch.save(own, {"key": self.key}))
            self._written = time.monotonic()
