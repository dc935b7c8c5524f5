"""State of a long fit, saved to disk so that an interrupted fit resumes with a bit-identical result."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from forcegp import __version__
from forcegp.errors import ModelError
from forcegp.files import atomic_file
from forcegp.gp.optimise import Objective
from forcegp.limits import CHECKPOINT_BYTES, CHECKPOINT_VALUE, LOGGED_VALUE

INTERVAL = 10.0
"""Minimum time between periodic writes [s]."""
NAMES = ("positions", "objectives", "gradients")
SUFFIX = ".sums"
"""Suffix appended to the file name of the learning checkpoint."""


def beside(checkpoint: str | Path) -> Path:
    """Return the path of the file of sums that belongs to a learning checkpoint."""
    path = Path(checkpoint)
    return path.with_name(path.name + SUFFIX)


@dataclass
class Checkpoint:
    """A safetensors file from which a long fit resumes. `key` (see `key_of`) identifies the fit."""

    path: Path
    key: str
    _written: float = field(default=float("-inf"), init=False)

    @staticmethod
    def key_of(*values: object) -> str:
        """Return a short hash of settings, tensors and the release of this library."""
        digest = hashlib.sha256(__version__.encode())
        for value in values:
            if isinstance(value, Tensor):
                # The type and shape distinguish tensors that consist of the same bytes.
                digest.update(f"{value.dtype}{tuple(value.shape)}".encode())
                digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
            else:
                digest.update(repr(value).encode())
        return digest.hexdigest()[:16]

    def read(self, like: Mapping[str, Tensor], growing: Container[str] = ()) -> dict[str, Tensor]:
        """Return the tensors in the file, or an empty dictionary if there is no file.

        Args:
            like: tensors with the same names, types and shapes as those in the file.
            growing: names of the tensors that have variable length.

        Raises:
            ModelError: the file is damaged, contains non-finite values, or belongs to a different fit.
        """
        if not self.path.exists():
            return {}
        tensors, key = _read(self.path)
        if key != self.key or _layout(tensors, growing) != _layout(like, growing):
            text = f"{self.path}: the checkpoint belongs to a different fit"
            expected = f"data, settings and system with key {self.key}"
            raise ModelError(text, expected=expected, got=key, hint="remove it, or name another file")
        for name, value in tensors.items():
            if value.is_floating_point() and not bool((value.abs() <= LOGGED_VALUE).all()):
                text = f"{self.path}: {name!r} contains an implausible value"
                hint = "remove the checkpoint to start again"
                raise ModelError(text, expected=f"finite numbers up to ±{LOGGED_VALUE:g}", hint=hint)
        return {name: tensors[name] for name in like}

    def write_now_and_then(self, tensors: Callable[[], Mapping[str, Tensor]]) -> None:
        """Write the tensors if at least `INTERVAL` has passed since the last write."""
        if time.monotonic() - self._written >= INTERVAL:
            self.write(tensors())

    def write(self, tensors: Mapping[str, Tensor]) -> None:
        """Write tensors atomically; raise `DestinationError` if the path is not writable."""
        copies = {name: x.detach().to("cpu", copy=True).contiguous() for name, x in tensors.items()}
        with atomic_file(self.path) as temporary:
            temporary.write_bytes(safetensors.torch.save(copies, {"key": self.key}))
        self._written = time.monotonic()


@dataclass
class Evaluations:
    """Record of all evaluations of an objective (position, value and gradient) in a checkpoint.

    A resumed fit replays the optimiser on the recorded values. Its result is therefore bit-identical to that
    of an uninterrupted fit. If the optimiser requests a different point, for example on another machine or
    with another library release, the rest of the record is discarded and recomputed.

    Args:
        checkpoint: file for the record, or `None` to record nothing.
    """

    checkpoint: Checkpoint | None
    _record: list[tuple[Tensor, Tensor, Tensor]] = field(default_factory=list, init=False)
    _next: int = field(default=0, init=False)

    @classmethod
    def resumed(cls, path: str | Path | None, start: Mapping[str, Tensor], *key: object) -> Evaluations:
        """Load the evaluations in a file, if any. `key` identifies the fit that begins at `start`."""
        if path is None:
            return cls(None)
        result = cls(Checkpoint(Path(path), Checkpoint.key_of(*key)))
        result.read(start)
        return result

    def read(self, start: Mapping[str, Tensor]) -> int:
        """Load the evaluations from the file if it exists, and return their number."""
        assert self.checkpoint is not None
        rows = torch.zeros(0, sum(value.numel() for value in start.values()), dtype=torch.float64)
        record = self.checkpoint.read(dict(zip(NAMES, (rows, rows[:, 0], rows), strict=True)), NAMES)
        if not record:
            return 0
        lengths = {len(value) for value in record.values()}
        if len(lengths) > 1 or not bool((record["positions"].abs() <= CHECKPOINT_VALUE).all()):
            raise ModelError(
                f"{self.checkpoint.path}: the checkpoint is damaged: 'positions' are out of range, or "
                "their number differs from that of the objectives",
                expected=f"finite numbers up to ±{CHECKPOINT_VALUE:g}",
                hint="remove the checkpoint to start again",
            )
        self._record = list(zip(*(record[name] for name in NAMES), strict=True))
        self._next = 0
        return lengths.pop()

    def recorded(self, objective: Objective) -> Objective:
        """Wrap an objective so that it uses recorded evaluations and records new ones."""
        checkpoint = self.checkpoint
        if checkpoint is None:
            return objective

        def again(tensors: dict[str, Tensor]) -> Tensor:
            names = sorted(tensors)
            here = _flat([tensors[name] for name in names])
            if self._next < len(self._record) and torch.equal(self._record[self._next][0], here):
                _, value, gradient = self._record[self._next]
            else:
                del self._record[self._next :]
                value, gradient = _evaluated(objective, tensors, names)
                self._record.append((here, value, gradient))
                if len(self._finite()):
                    checkpoint.write_now_and_then(self._tensors)
            self._next += 1
            like = tensors[names[0]]
            pair = value.to(like), gradient.to(like)
            return _StoredGradient.apply(*pair, *(tensors[name] for name in names))  # pyright: ignore[reportReturnType]

        return again

    def write(self) -> None:
        """Write all evaluations so far, up to the first non-finite one."""
        if self.checkpoint is not None and self._finite():
            self.checkpoint.write(self._tensors())

    def _finite(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Return the evaluations before the first non-finite one."""
        limits = ([bool((x.abs() <= LOGGED_VALUE).all()) for x in entry] for entry in self._record)
        return self._record[: next((i for i, finite in enumerate(limits) if not all(finite)), None)]

    def _tensors(self) -> dict[str, Tensor]:
        columns = zip(*self._finite(), strict=True)
        return dict(zip(NAMES, (torch.stack(column) for column in columns), strict=True))


def _layout(tensors: Mapping[str, Tensor], growing: Container[str]) -> dict[str, tuple[object, ...]]:
    """Return the type and shape of each tensor by name, omitting the lengths of tensors in `growing`."""
    return {name: (x.dtype, x.ndim, *x.shape[1 if name in growing else 0 :]) for name, x in tensors.items()}


def _flat(tensors: Sequence[Tensor]) -> Tensor:
    return torch.cat([x.detach().to("cpu", torch.float64).reshape(-1) for x in tensors])


def _evaluated(
    objective: Objective, tensors: Mapping[str, Tensor], names: list[str]
) -> tuple[Tensor, Tensor]:
    """Return the value and gradient of an objective, on the CPU in float64."""
    leaves = {name: value.detach().requires_grad_() for name, value in tensors.items()}
    with torch.enable_grad():
        value = objective(leaves)
        inputs = [leaves[name] for name in names]
        grads = torch.autograd.grad(value, inputs, allow_unused=True, materialize_grads=True)
    return value.detach().to("cpu", torch.float64), _flat(grads)


class _StoredGradient(torch.autograd.Function):
    """A value with a known gradient."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, gradient: Tensor, *tensors: Tensor) -> Tensor:
        ctx.gradient, ctx.shapes = gradient, [x.shape for x in tensors]
        return value.clone()

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        parts = ctx.gradient.split([shape.numel() for shape in ctx.shapes])
        return None, None, *(outer * x.reshape(s) for x, s in zip(parts, ctx.shapes, strict=True))


def _read(path: Path) -> tuple[dict[str, Tensor], str | None]:
    """Return the tensors of a checkpoint and the key of its fit."""
    if not path.is_file():
        raise ModelError(f"{path} is not a file", expected="the file of a checkpoint")
    try:
        with path.open("rb") as file:
            data = file.read(CHECKPOINT_BYTES + 1)
        if len(data) > CHECKPOINT_BYTES:
            raise ModelError(f"{path}: too large for a checkpoint", got=f"> {CHECKPOINT_BYTES} bytes")
        # Read once: a library that opens the file twice may see two different versions of it.
        tensors = safetensors.torch.load(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        return tensors, header.get("__metadata__", {}).get("key")
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as cause:
        if isinstance(cause, ModelError):
            raise
        text = f"{path}: the checkpoint is damaged"
        raise ModelError(text, got=str(cause), hint="remove it to start again") from cause
