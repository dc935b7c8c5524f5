"""The learning problem of force priors: the rows at given parameters, the objective, and its solution."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.coulomb import CoulombFriction, below_jamming, coulomb_of, initial_coulomb
from forcegp.forces.measurements import Training
from forcegp.forces.priors.base import ANALYTICAL, NOISE, ForcePrior
from forcegp.forces.projection import ForceMean, ForceNoise, WhitenedRows, combine, whiten
from forcegp.forces.start import (
    OWN,
    bounds_of,
    given_start,
    initial_hyperparameters,
    negative_log_prior,
    random_starts,
    warm_start_sizes,
)
from forcegp.forces.torque_noise import TORQUE_NOISE, initial_torque_noise, stick_variance
from forcegp.gp.bound import negative_bound
from forcegp.gp.features import Features
from forcegp.gp.likelihood import negative_log_likelihood
from forcegp.gp.optimise import Learned, LearningOptions, Objective, Progress, minimise
from forcegp.gp.structured_covariance import Block

Tensors = dict[str, Tensor]
START_SAMPLES = 5000
"""Evenly spaced samples that the start of learning is computed from, where there are more."""


def kernel_parameters(tensors: Mapping[str, Tensor]) -> Tensors:
    """The hyperparameters of the priors among learned tensors."""
    return {key: value for key, value in tensors.items() if not key.startswith(OWN)}


def analytical_parameters(tensors: Mapping[str, Tensor]) -> Tensors:
    """The analytical parameters θ_A among learned tensors, by their name in the module."""
    prefix = ANALYTICAL + "."
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def noise_key(measurement: int) -> str:
    """Name of the learned noise of a measurement."""
    return f"{NOISE}.{measurement}.log_noise_std"


@dataclass(frozen=True)
class Problem:
    """What the likelihood of force priors is made of.

    Attributes:
        system: robot and contacts, with the robot as it is where θ_A is not learned.
        priors: the force priors.
        mean: prior mean of Q.
        training: measurements, noise and input scales.
        parameters: module whose `forward()` gives the robot at θ_A, or `None`.
        torque_std: standard deviation of the white noise of the motor torque, `(nq,)`, unless it is learned.
        power: κ, which the likelihood is raised to; below 1 where samples are correlated.
        correlation_time: how long the noise of the torque is correlated [s]; 0 where that is not known.
        offsets: prior means of latent forces, by prior.
        pinned: priors whose force has mean zero from here on, since the robot contains it; the others are
            conditioned on that, and only the uncertainty of the pinned ones remains.
        inducing: inducing inputs of each prior, for sparse inference; `None` for exact inference.
        state_std: standard deviation of the noise of q and q̇, `(2 nq,)`, or `None` for none.
    """

    system: ConstrainedSystem
    priors: tuple[ForcePrior, ...]
    mean: ForceMean
    training: Training
    parameters: nn.Module | None = None
    torque_std: Tensor | None = None
    power: float = 1.0
    correlation_time: float = 0.0
    offsets: Mapping[str, Tensor] = field(default_factory=dict)
    inducing: tuple[Features, ...] | None = None
    pinned: tuple[str, ...] = ()
    state_std: Tensor | None = None

    def system_at(self, tensors: Mapping[str, Tensor]) -> ConstrainedSystem:
        """The system with the robot at the analytical parameters among the tensors."""
        own = analytical_parameters(tensors)
        if self.parameters is None or not own:
            return self.system
        return self.system.with_robot(torch.func.functional_call(self.parameters, own, ()))

    def noise_at(self, tensors: Mapping[str, Tensor], measurement: int) -> Tensor:
        """Noise of a measurement, `(d,)` or `(n, d)`; a learned one scales what varies by sample."""
        std = self.training.noise_std[measurement]
        learned = tensors.get(noise_key(measurement))
        if learned is None:
            return std
        return learned.exp() if std.ndim == 1 else std * (learned.exp() / _typical(std))

    def coulomb(self, tensors: Mapping[str, Tensor]) -> tuple[CoulombFriction, ...]:
        """Coulomb friction of contacts, at its start where it is not among the tensors."""
        return coulomb_of(self.priors, tensors, self.system.robot.mass)

    def force_noise(self, tensors: Mapping[str, Tensor]) -> ForceNoise | None:
        """Variance of the white noise on the joint force, or `None` for none."""
        learned = tensors.get(TORQUE_NOISE)
        std = self.torque_std if learned is None else learned.exp()
        return None if std is None else lambda at: std**2 + stick_variance(tensors, at)

    def rows(self, tensors: Mapping[str, Tensor]) -> WhitenedRows:
        """Whitened rows at the noise and analytical parameters among the tensors."""
        system, force_noise = self.system_at(tensors), self.force_noise(tensors)
        friction = self.coulomb(tensors)
        return combine(
            [
                whiten(
                    system,
                    self.priors,
                    self.training.scales,
                    self.mean,
                    m,
                    self.noise_at(tensors, i),
                    force_noise,
                    self.offsets,
                    friction,
                    self.state_std,
                )
                for i, m in enumerate(self.training.measurements)
            ]
        ).tempered(self.power)

    def of_means(self) -> Problem:
        """The problem that posterior means are read from, in which pinned forces are known to be zero."""
        return dataclasses.replace(self, offsets={}, pinned=())

    def silenced(self, blocks: Sequence[Block]) -> list[Block]:
        """Rows that pinned forces do not act on."""
        keep = [prior.name not in self.pinned for prior in self.priors]
        return [
            Block(
                b.features,
                tuple(W if k else torch.zeros_like(W) for W, k in zip(b.operators, keep, strict=True)),
                b.target,
            )
            for b in blocks
        ]

    @cached_property
    def fixed_rows(self) -> WhitenedRows:
        """The rows at the noise and robot as given."""
        return self.rows({})

    def initial(self, learn_noise: bool, learn_torque_noise: bool = False) -> Tensors:
        """Default start of everything that can be learned."""
        few = self
        if self.training.samples > START_SAMPLES:
            few = dataclasses.replace(self, training=self.training.evenly(START_SAMPLES))
        start = initial_hyperparameters(self.priors, few.fixed_rows.blocks)
        start |= initial_coulomb(self.priors, self.system.robot.mass)
        if learn_torque_noise:
            start |= initial_torque_noise(few.torque_residual())
        if learn_noise:
            noise = self.training.noise_std
            start |= {noise_key(i): _typical(std).double().log() for i, std in enumerate(noise)}
        if self.parameters is not None:
            named = self.parameters.named_parameters()
            start |= {f"{ANALYTICAL}.{name}": value.detach().clone() for name, value in named}
        return start

    @torch.no_grad()
    def torque_residual(self) -> Tensor:
        """Root mean square of M times the residual of accelerations, `(nq,)` [N m, N]."""
        total, count = torch.zeros_like(self.system.robot.mass), 0
        for m in self.training.measurements:
            if m.quantity == "qdd":
                at = m.at(self.system)
                residual = m.values - at.eom.acceleration(self.mean(self.system, at))
                force = (at.eom.M @ residual[..., None])[..., 0]
                total, count = total + (force**2).sum(0), count + len(force)
        return (total / max(count, 1)).sqrt()

    def negative_log_likelihood(self, params: Tensors, rows: WhitenedRows) -> Tensor:
        """Of the rows, exact or as the collapsed bound, with their constant."""
        if self.inducing is not None:
            return negative_bound(self.priors, params, rows.blocks, self.inducing) + rows.constant
        return negative_log_likelihood(self.priors, params, rows.blocks) + rows.constant

    def objective(self, tensors: Tensors, held: Tensors, center: Tensors) -> Tensor:
        """Negative log posterior: the likelihood of the rows, and weak priors around `center`."""
        moving = any(key.startswith(OWN) for key in tensors)
        rows = self.rows({**held, **tensors}) if moving else self._held_rows(held)
        value = self.negative_log_likelihood(kernel_parameters({**held, **tensors}), rows)
        hyper = {key: v for key, v in tensors.items() if not key.startswith(ANALYTICAL + ".")}
        return value + negative_log_prior(hyper, center)

    def _held_rows(self, held: Tensors) -> WhitenedRows:
        """The rows where neither noise nor robot is learned; computed once for those as given."""
        return self.rows(held) if any(key.startswith(OWN) for key in held) else self.fixed_rows


def _typical(std: Tensor) -> Tensor:
    """One standard deviation per component, `(d,)`."""
    return std if std.ndim == 1 else std.square().mean(0).sqrt()


@dataclass(frozen=True)
class Search:
    """How hyperparameters are searched.

    Attributes:
        start: default initial values of what is learned, and centre of the weak priors.
        held: values that are not learned.
        options: optimiser and its limits.
        recorded: wraps the objective, such as `Checkpoint.recorded`.
    """

    start: Tensors
    held: Tensors
    options: LearningOptions
    recorded: Callable[[Objective], Objective] = lambda objective: objective

    def solve(
        self,
        problem: Problem,
        progress: Progress | None = None,
        begin: Mapping[str, Tensor] | None = None,
    ) -> Learned:
        """Learn; on a part of the data first where there is much, and from several starts on request.

        Args:
            problem: whose objective is minimised.
            progress: called after each evaluation on all data.
            begin: where to begin on all data, instead of warm starts and restarts.

        Raises:
            ModelError: `begin` does not fit what is learned.
            NumericalError: the likelihood cannot be computed.
        """
        if begin is not None:
            return self._minimise(problem, given_start(begin, self.start), progress)
        found = (
            self._minimise(problem, self._warmed(problem, cold), progress)
            for cold in random_starts(self.start, self.options.restarts, self.options.seed)
        )
        return min(found, key=lambda learned: learned.value)

    def _warmed(self, problem: Problem, cold: Tensors) -> Tensors:
        """Where to begin on all data: what fewer samples taught, unless the cold start is better."""
        first = cold
        for samples in warm_start_sizes(problem.training.samples, self.options.warm_start):
            small = dataclasses.replace(problem, training=problem.training.thinned(samples))
            first = self._minimise(small, self._better(small, (first, cold)), None).tensors
        return self._better(problem, (first, cold))

    @torch.no_grad()
    def _better(self, problem: Problem, starts: Iterable[Tensors]) -> Tensors:
        one, two = starts
        if one is two:
            return one
        return min((one, two), key=lambda tensors: float(problem.objective(tensors, self.held, self.start)))

    def _minimise(self, problem: Problem, begin: Tensors, progress: Progress | None) -> Learned:
        # The tolerance is relative to the objective, so the part that no hyperparameter changes is left out.
        constant = float(problem.fixed_rows.constant)
        analytical = frozenset(key for key in begin if key.startswith(ANALYTICAL + "."))
        bounds = bounds_of({key: value for key, value in begin.items() if key not in analytical})
        bounds = below_jamming(problem.system, problem.training.measurements, problem.priors, bounds)

        def objective(tensors: Tensors) -> Tensor:
            return problem.objective(tensors, self.held, self.start) - constant

        def whole(evaluations: int, value: float, best: Tensors) -> None:
            if progress is not None:
                progress(evaluations, value + constant, best)

        learned = minimise(self.recorded(objective), begin, self.options, analytical, bounds, whole)
        history = [value + constant for value in learned.history]
        return dataclasses.replace(learned, value=learned.value + constant, history=history)
