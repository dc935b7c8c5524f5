"""ADAM on batches of samples, with a held-out part that says when to stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError
from forcegp.gp.optimise import Learned
from forcegp.models.base import FitProgress

Loss = Callable[[Mapping[str, Tensor], Tensor], Tensor]
"""Maps tensors and row numbers `(k,)` to the mean squared error of these rows."""


@dataclass(frozen=True)
class BatchOptions:
    """How to train on batches.

    Args:
        epochs: passes over the data at most; the learning rate falls to 0 along a half cosine over them.
        batch: samples a step.
        learning_rate: of ADAM, at the start.
        held_out: share of the samples that is not trained on but watched.
        patience: epochs without improvement on the held-out samples after which training stops.

    Raises:
        ModelError: a value is out of range.
    """

    epochs: int = 400
    batch: int = 256
    learning_rate: float = 0.03
    held_out: float = 0.1
    patience: int = 60

    def __post_init__(self) -> None:
        for name in ("epochs", "batch", "patience"):
            if getattr(self, name) < 1:
                raise ModelError(f"{name} of training must be at least 1", got=getattr(self, name))
        if not (self.learning_rate > 0.0 and 0.0 < self.held_out < 1.0):
            raise ModelError(
                "training is not possible with these options",
                expected="a positive learning rate, and a held-out share between 0 and 1",
                got=f"learning_rate {self.learning_rate}, held_out {self.held_out}",
            )


def train(
    loss: Loss,
    start: Mapping[str, Tensor],
    samples: int,
    options: BatchOptions,
    generator: torch.Generator,
    progress: FitProgress | None = None,
) -> Learned:
    """Minimise a mean over samples; the result is the best epoch on the held-out samples.

    Args:
        loss: mean squared error over rows, differentiable in the tensors.
        start: initial tensors by name.
        samples: how many rows there are.
        options: how to train.
        generator: of the held-out part and the order of rows.
        progress: called after each epoch with its number, the most there will be, and the held-out loss.

    Returns:
        The tensors, the held-out loss, and one entry an epoch as history.

    Raises:
        ModelError: there are too few samples to hold any out.
        NumericalError: the loss is not finite.
    """
    began = time.perf_counter()
    held, rows = _split(samples, options.held_out, generator, next(iter(start.values())).device)
    tensors = {name: value.detach().clone().requires_grad_() for name, value in start.items()}
    optimizer = torch.optim.Adam(tensors.values(), lr=options.learning_rate)
    best, value, since, history = dict(start), math.inf, 0, []
    for epoch in range(options.epochs):
        for group in optimizer.param_groups:
            group["lr"] = 0.5 * options.learning_rate * (1.0 + math.cos(math.pi * epoch / options.epochs))
        for batch in rows[torch.randperm(len(rows), generator=generator)].split(options.batch):
            optimizer.zero_grad()
            loss(tensors, batch).backward()
            optimizer.step()
        with torch.no_grad():
            history.append(float(loss(tensors, held)))
        if not math.isfinite(history[-1]):
            raise NumericalError(
                f"training diverged in epoch {epoch + 1}", hint="lower the learning rate in the options"
            )
        since += 1
        if history[-1] < value:
            best, value, since = {k: x.detach().clone() for k, x in tensors.items()}, history[-1], 0
        if progress is not None:
            progress(epoch + 1, options.epochs, history[-1])
        if since >= options.patience:
            break
    converged = since >= options.patience or _flat(history)
    message = f"{len(history)} epochs, the best on the held-out samples was {len(history) - since}"
    return Learned(best, value, converged, len(history), time.perf_counter() - began, message, history)


FLAT = 0.05
"""Relative change of the held-out loss over the last tenth of the epochs that counts as none."""


def _flat(history: list[float]) -> bool:
    tail = max(1, len(history) // 10)
    return len(history) > tail and history[-1 - tail] - min(history[-tail:]) < FLAT * history[-1 - tail]


def _split(
    samples: int, share: float, generator: torch.Generator, device: torch.device
) -> tuple[Tensor, Tensor]:
    held = max(1, round(share * samples))
    if samples - held < 1:
        raise ModelError("there are too few samples to hold any out", expected="at least 2", got=samples)
    order = torch.randperm(samples, generator=generator).to(device)
    return order[:held], order[held:]
