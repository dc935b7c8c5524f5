"""The state of a training by epochs on disk, so that an interrupted one is resumed to the same bits."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.limits import LOGGED_VALUE
from forcegp.storage import checkpoint

HISTORY = "history"
"""Name of the tensor with one entry per epoch, the only one whose length changes."""


@dataclass
class EpochCheckpoint:
    """A safetensors file with the last state of a training: weights, moments, generator, history.

    Args:
        path: the file.
        key: what is trained; a file that was written for something else is refused.
    """

    path: Path
    key: str
    _written: float = field(default=float("-inf"), init=False)

    def read(self, like: Mapping[str, Tensor]) -> dict[str, Tensor] | None:
        """The state in the file, `None` if there is not a file.

        Args:
            like: a state at the start, whose names, shapes and types the file has too.

        Raises:
            ModelError: the file is damaged, is a folder, holds impossible values, or belongs to another fit.
        """
        if not self.path.exists():
            return None
        tensors, key = checkpoint.read_keyed(self.path)
        expected = {name: (value.dtype, value.shape) for name, value in like.items() if name != HISTORY}
        found = {name: (value.dtype, value.shape) for name, value in tensors.items() if name != HISTORY}
        history = tensors.get(HISTORY, torch.zeros(()))
        if key != self.key or found != expected or (history.dtype, history.ndim) != (torch.float64, 1):
            raise checkpoint.belongs_elsewhere(self.path, self.key, key)
        for name, value in tensors.items():
            if not bool((value.abs() <= LOGGED_VALUE).all()):
                raise ModelError(
                    f"{self.path}: {name!r} holds a value that no training reaches",
                    expected=f"finite numbers up to ±{LOGGED_VALUE:g}",
                    hint="remove the checkpoint to start anew",
                )
        return tensors

    def write_now_and_then(self, state: Callable[[], Mapping[str, Tensor]]) -> None:
        """Write a state if the last writing is long ago."""
        if time.monotonic() - self._written >= checkpoint.INTERVAL:
            self.write(state())

    def write(self, state: Mapping[str, Tensor]) -> None:
        """Write a state.

        Raises:
            DestinationError: the place cannot be written.
        """
        checkpoint.write_record(self.path, state, self.key)
        self._written = time.monotonic()
