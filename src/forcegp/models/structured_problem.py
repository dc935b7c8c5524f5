"""The learning problem of a structured Gaussian process: its rows, its objective, where it starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.projection import ForceMean, WhitenedRows, combine, whiten
from forcegp.forces.start import bounds_of, initial_hyperparameters, negative_log_prior
from forcegp.gp.likelihood import negative_log_likelihood
from forcegp.gp.optimise import Learned, LearningOptions, Progress, minimise
from forcegp.models.structured_training import Training
from forcegp.storage.checkpoint import Checkpoint

NOISE = "noise."
ANALYTICAL = "analytical."
OWN = (NOISE, ANALYTICAL)
"""Prefixes of what is learned beside the hyperparameters of the priors."""


def kernel_parameters(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The hyperparameters of the priors among learned tensors."""
    return {key: value for key, value in tensors.items() if not key.startswith(OWN)}


def analytical_parameters(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The analytical parameters θ_A among learned tensors, by their name in the module."""
    return {k.removeprefix(ANALYTICAL): v for k, v in tensors.items() if k.startswith(ANALYTICAL)}


def beginning(begin: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Where learning begins: at given values of what is learned.

    Raises:
        ModelError: a value is missing, or of another shape.
    """
    for key, value in start.items():
        got = begin[key].shape if key in begin else None
        if got != value.shape:
            raise ModelError(
                f"the hyperparameters to begin with do not fit: {key}",
                expected=tuple(value.shape),
                got="none" if got is None else tuple(got),
                hint="take those of a model with the same priors",
            )
    return {key: begin[key].detach().to(value) for key, value in start.items()}


@dataclass(frozen=True)
class Problem:
    """What the likelihood of a structured Gaussian process is made of.

    Attributes:
        system: robot and contacts, with the robot as it is where θ_A is not learned.
        priors: the force priors.
        mean: prior mean of Q.
        training: measurements, noise and input scales.
        parameters: module whose `forward()` gives the robot at θ_A, or `None`.
    """

    system: ConstrainedSystem
    priors: tuple[ForcePrior, ...]
    mean: ForceMean
    training: Training
    parameters: nn.Module | None = None

    def system_at(self, tensors: dict[str, Tensor]) -> ConstrainedSystem:
        """The system with the robot at the analytical parameters among the tensors."""
        own = analytical_parameters(tensors)
        if self.parameters is None or not own:
            return self.system
        return self.system.with_robot(torch.func.functional_call(self.parameters, own, ()))

    def rows(self, tensors: dict[str, Tensor]) -> WhitenedRows:
        """Whitened rows at the noise and analytical parameters among the tensors."""
        system, training = self.system_at(tensors), self.training
        rows = []
        for i, (m, std) in enumerate(zip(training.measurements, training.noise_std, strict=True)):
            key = f"{NOISE}{i}.log_noise_std"
            noise = tensors[key].exp() if key in tensors else std
            rows.append(whiten(system, self.priors, training.scales, self.mean, m, noise))
        return combine(rows)

    @cached_property
    def fixed_rows(self) -> WhitenedRows:
        """The rows at the noise and robot as given."""
        return self.rows({})

    def initial(self, learn_noise: bool) -> dict[str, Tensor]:
        """Where learning starts from, everything included."""
        start = initial_hyperparameters(self.priors, self.fixed_rows.blocks)
        if learn_noise:
            noise = self.training.noise_std
            start |= {f"{NOISE}{i}.log_noise_std": std.log() for i, std in enumerate(noise)}
        if self.parameters is not None:
            named = self.parameters.named_parameters()
            start |= {ANALYTICAL + name: value.detach().clone() for name, value in named}
        return start

    def key(self, options: LearningOptions, names: list[str]) -> str:
        """What tells the learning of some tensors on these data, with these options, from any other."""
        data = [value for m in self.training.measurements for value in m.tensors]
        priors = [(type(prior).__name__, prior.name, prior.kernel) for prior in self.priors]
        noise = self.training.noise_std
        return Checkpoint.key_of(self.system, self.mean, priors, options, names, *data, *noise)

    def objective(
        self, tensors: dict[str, Tensor], held: dict[str, Tensor], center: dict[str, Tensor]
    ) -> Tensor:
        """Negative log posterior: the likelihood of the rows, and weak priors around `center`."""
        moving = any(key.startswith(OWN) for key in tensors)
        rows = self.rows(tensors) if moving else self.fixed_rows
        value, _ = negative_log_likelihood(self.priors, {**held, **kernel_parameters(tensors)}, rows.blocks)
        hyper = {key: v for key, v in tensors.items() if not key.startswith(ANALYTICAL)}
        return value + rows.constant + negative_log_prior(hyper, center)

    def solve(
        self,
        start: dict[str, Tensor],
        held: dict[str, Tensor],
        options: LearningOptions,
        progress: Progress | None = None,
        checkpoint: Checkpoint | None = None,
        begin: dict[str, Tensor] | None = None,
    ) -> Learned:
        """Learn: on a part of the data first where there is much, from several starts where asked for.

        Args:
            start: initial values of what is learned.
            held: hyperparameters that keep their values.
            options: how to learn.
            progress: called after each evaluation on all data.
            checkpoint: where the best values are kept, and taken from if they are there.
            begin: where to begin on all data; `start` stays the centre of the weak priors.
        """
        analytical = frozenset(key for key in start if key.startswith(ANALYTICAL))
        bounds = bounds_of({key: value for key, value in start.items() if key not in analytical})

        def run(problem: Problem, begin: dict[str, Tensor], note: Progress | None) -> Learned:
            # The tolerance is relative to the objective: what no hyperparameter changes is left out of it.
            constant = float(problem.fixed_rows.constant)

            def objective(tensors: dict[str, Tensor]) -> Tensor:
                return problem.objective(tensors, held, start) - constant

            def whole(evaluations: int, value: float, best: dict[str, Tensor]) -> None:
                if note is not None:
                    note(evaluations, value + constant, best)

            learned = minimise(objective, begin, options, analytical, bounds, whole)
            history = [value + constant for value in learned.history]
            return dataclasses.replace(learned, value=learned.value + constant, history=history)

        saved = checkpoint.read(start) if checkpoint is not None else None
        note = checkpoint.noting(progress) if checkpoint is not None else progress
        begin = saved if saved is not None else begin
        begins = self._begins(start, options) if begin is None else [begin]
        best: Learned | None = None
        for cold in begins:
            first = cold
            for samples in self._fewer(options.warm_start) if begin is None else []:
                small = dataclasses.replace(self, training=self.training.thinned(samples))
                first = run(small, small._better(first, cold, held, start), None).tensors
            learned = run(self, self._better(first, cold, held, start), note)
            best = learned if best is None or learned.value < best.value else best
        assert best is not None
        return best

    @torch.no_grad()
    def _better(
        self,
        warm: dict[str, Tensor],
        cold: dict[str, Tensor],
        held: dict[str, Tensor],
        center: dict[str, Tensor],
    ) -> dict[str, Tensor]:
        """Where to begin: what fewer samples taught may be far off where they were too few to tell."""
        if warm is cold:
            return cold
        return min((warm, cold), key=lambda tensors: float(self.objective(tensors, held, center)))

    def _fewer(self, first: int | None) -> list[int]:
        """Numbers of samples to learn on first, each twice the one before, up to half of all."""
        sizes: list[int] = []
        size = first
        while size is not None and self.training.samples > 2 * size:
            sizes.append(size)
            size *= 2
        return sizes

    def _begins(self, start: dict[str, Tensor], options: LearningOptions) -> Sequence[dict[str, Tensor]]:
        """The start, and as many random ones around its hyperparameters as there are restarts."""
        generator = torch.Generator().manual_seed(options.seed)
        begins = [start]
        for _ in range(options.restarts):
            begins.append(
                {
                    key: value
                    if key.startswith(OWN)
                    else value + torch.randn(value.shape, dtype=torch.float64, generator=generator).to(value)
                    for key, value in start.items()
                }
            )
        return begins
