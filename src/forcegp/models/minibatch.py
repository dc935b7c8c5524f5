"""Minimisation of a mean loss, either over all samples at once or by ADAM on batches with early stopping."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError
from forcegp.gp.optimise import FitProgress, Learned, LearningOptions, minimise, reported

Loss = Callable[[Mapping[str, Tensor], Tensor], Tensor]
"""A function that maps tensors and row numbers `(k,)` to the mean squared error over these rows."""


@dataclass(frozen=True)
class BatchOptions:
    """Options for training on batches.

    Args:
        epochs: maximum number of passes over the data. The learning rate decays to 0 along a half cosine.
        batch: number of samples per step.
        learning_rate: initial learning rate of ADAM.
        held_out: fraction of the samples held out for early stopping.
        patience: number of epochs without improvement in the held-out loss after which training stops.

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
    options: BatchOptions | LearningOptions,
    generator: torch.Generator,
    progress: FitProgress | None = None,
) -> Learned:
    """Minimise a mean loss over samples.

    Args:
        loss: the mean squared error over rows, which is differentiable with respect to the tensors.
        start: initial tensors, keyed by name.
        samples: number of rows.
        options: options for training on batches or on all samples at once. Training on batches returns the
            tensors of the epoch with the smallest held-out loss.
        generator: random generator that selects the held-out samples and the order of the rows.
        progress: a function called after each epoch or evaluation with its number, the maximum and the loss.

    Returns:
        The tensors, their loss, and a history with one entry per epoch or evaluation.

    Raises:
        ModelError: there are too few samples to hold any out.
        NumericalError: the loss is not finite.
    """
    if isinstance(options, BatchOptions):
        return _on_batches(loss, start, samples, options, generator, progress)
    rows = torch.arange(samples, device=next(iter(start.values())).device)
    report = reported(progress, options.max_evaluations)
    return minimise(lambda tensors: loss(tensors, rows), start, options, progress=report)


def _on_batches(
    loss: Loss,
    start: Mapping[str, Tensor],
    samples: int,
    options: BatchOptions,
    generator: torch.Generator,
    progress: FitProgress | None,
) -> Learned:
    began = time.perf_counter()
    held, rows = _split(samples, options.held_out, generator, next(iter(start.values())).device)
    state = _State.at(start, options.learning_rate)
    while len(state.history) < options.epochs and state.since < options.patience:
        epoch = len(state.history)
        for group in state.optimizer.param_groups:
            group["lr"] = 0.5 * options.learning_rate * (1.0 + math.cos(math.pi * epoch / options.epochs))
        for batch in rows[torch.randperm(len(rows), generator=generator)].split(options.batch):
            state.optimizer.zero_grad()
            loss(state.weights, batch).backward()
            state.optimizer.step()
        with torch.no_grad():
            state.note(float(loss(state.weights, held)))
        if progress is not None:
            progress(epoch + 1, options.epochs, state.history[-1])
    history, since = state.history, state.since
    converged = since >= options.patience or _flat(history)
    message = f"{len(history)} epochs, the best on the held-out samples was {len(history) - since}"
    seconds = time.perf_counter() - began
    return Learned(state.best, state.value, converged, len(history), seconds, message, history)


@dataclass
class _State:
    """State of training on batches."""

    weights: dict[str, Tensor]
    optimizer: torch.optim.Adam
    best: dict[str, Tensor]
    history: list[float]

    @classmethod
    def at(cls, start: Mapping[str, Tensor], learning_rate: float) -> _State:
        """Return the state before the first epoch."""
        weights = {name: value.detach().clone().requires_grad_() for name, value in start.items()}
        optimizer = torch.optim.Adam(weights.values(), lr=learning_rate)
        return cls(weights, optimizer, {k: x.detach().clone() for k, x in start.items()}, [])

    @property
    def value(self) -> float:
        """Smallest held-out loss so far."""
        return min(self.history, default=math.inf)

    @property
    def since(self) -> int:
        """Number of epochs since the smallest held-out loss."""
        return len(self.history) - 1 - self.history.index(self.value) if self.history else 0

    def note(self, held_out: float) -> None:
        """Record the held-out loss at the end of an epoch."""
        if not math.isfinite(held_out):
            raise NumericalError(
                f"training diverged in epoch {len(self.history) + 1}",
                hint="lower the learning rate in the options",
            )
        if held_out < self.value:
            self.best = {name: x.detach().clone() for name, x in self.weights.items()}
        self.history.append(held_out)


FLAT = 0.05
"""Relative decrease in held-out loss over the last tenth of the epochs that indicates convergence."""


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
