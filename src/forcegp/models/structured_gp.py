"""Gaussian-process priors on forces, carried to accelerations and multipliers by the known mechanics.

q̈ ~ GP(L b + H m_Q, H k_Q Hᵀ) (eq. 15), and likewise for every other quantity (eqs. 19 to 25).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.identifiability import force_correlation
from forcegp.forces.mean import AnalyticalMean, mean_of
from forcegp.forces.measurements import NoiseStd, Observation
from forcegp.forces.posterior import ForcePosterior, posterior
from forcegp.forces.priors.base import ForcePrior, check_priors
from forcegp.forces.priors.default import default_priors
from forcegp.forces.projection import Measurement
from forcegp.forces.quantities import affine_maps, stack
from forcegp.forces.samples import draw_samples
from forcegp.forces.states import States, states, states_at
from forcegp.gp.likelihood import target_of
from forcegp.gp.optimise import Learned, LearningOptions
from forcegp.models.base import FitProgress, FitResult, ForceField, Model, Prediction, not_fitted
from forcegp.models.structured_problem import (
    Problem,
    analytical_parameters,
    beginning,
    kernel_parameters,
)
from forcegp.models.structured_settings import save_structured
from forcegp.models.structured_training import Training, training_of
from forcegp.storage.checkpoint import Checkpoint

WITH_PARAMETERS = LearningOptions(tolerance=1e-9)
"""Default options where θ_A is learned too: L-BFGS then pauses on its way for a step or two."""
CORRELATION_STATES = 50
"""Training states at which the correlation of Q and Q_z is looked at after a fit."""


class StructuredGP(Model):
    """A structured Gaussian process (S-GP): priors on the unknown forces of a constrained system.

    Args:
        system: robot and contacts.
        mean: `"zero"`, `"analytical"`, or an `AnalyticalMean` with some terms left out.
        force_priors: priors on the unknown forces; by default `default_priors`: a `JointForcePrior`, and
            in contact its `NormalForcePrior`, which changes no acceleration and keeps multipliers honest.
        noise_std: standard deviation of measured accelerations [rad/s², m/s²], one or one a joint.
        learn_noise: whether the noise is a hyperparameter too, starting from `noise_std`.
        analytical_parameters: a module whose `forward()` gives the robot with its analytical
            parameters θ_A as learned tensors; `None` keeps the robot as it is.

    Raises:
        ModelError, UnknownNameError: the priors do not fit the system.
    """

    kind = "structured_gp"
    has_function_samples = True

    def __init__(
        self,
        system: ConstrainedSystem,
        mean: str | AnalyticalMean = "zero",
        force_priors: Sequence[ForcePrior] | None = None,
        noise_std: NoiseStd = 0.1,
        learn_noise: bool = False,
        analytical_parameters: nn.Module | None = None,
    ) -> None:
        self.system = system
        self.mean = mean_of(mean)
        self.force_priors = default_priors(system, self.mean) if force_priors is None else tuple(force_priors)
        self.noise_std = noise_std
        self.learn_noise = learn_noise
        self.analytical_parameters = analytical_parameters
        self.hyperparameters: dict[str, Tensor] = {}
        self.training: Training | None = None
        self._posterior: ForcePosterior | None = None
        check_priors(self.force_priors, system)

    # -- learning ---------------------------------------------------------------------------------

    def fit(
        self,
        data: Dataset | Sequence[Observation],
        *,
        options: LearningOptions | None = None,
        learn: Iterable[str] | None = None,
        begin: Mapping[str, Tensor] | None = None,
        progress: FitProgress | None = None,
        checkpoint: str | Path | None = None,
    ) -> FitResult:
        """Learn hyperparameters (and analytical parameters) by maximum a posteriori, then condition.

        Args:
            data: measured accelerations, or any mixture of measurements.
            options: optimiser and its limits; L-BFGS by default, to a tolerance of 1e-9 where θ_A is learned.
            learn: names of the priors whose hyperparameters are learned; the others keep the values and
                input scales of an earlier fit (two-stage training). Default all; with none, and no noise
                or analytical parameter to learn, the model is only conditioned.
            begin: `hyperparameters` of a model of the same kind, such as one fitted to less data, that
                learning starts from; by default it starts from fewer samples (`options.warm_start`).
            progress: called after each evaluation.
            checkpoint: file that keeps the best values of a long fit; a fit that finds it goes on from
                there, and removes it at its end.

        Raises:
            ModelError, DataError, UnknownNameError: the data, or the checkpoint, do not fit the model.
            NumericalError: the likelihood cannot be computed.
        """
        options = options or (LearningOptions() if self.analytical_parameters is None else WITH_PARAMETERS)
        learn = self._learned_priors(learn)
        problem = self._problem(self._training(data, learn))
        start = problem.initial(self.learn_noise)
        held = {
            key: self.hyperparameters.get(key, value)
            for key, value in kernel_parameters(start).items()
            if not key.startswith(tuple(name + "." for name in learn))
        }
        start = {key: value for key, value in start.items() if key not in held}
        if not start:
            self._adopt(problem, held)
            return self._result(
                Learned({}, -self.log_marginal_likelihood(), True, 0, 0.0, "nothing to learn")
            )

        def report(evaluations: int, value: float, _: dict[str, Tensor]) -> None:
            if progress is not None:
                progress(evaluations, options.max_evaluations, value)

        saved = None
        if checkpoint is not None:
            saved = Checkpoint(Path(checkpoint), problem.key(options, list(start)))
        first = None if begin is None else beginning(begin, start)
        learned = problem.solve(start, held, options, report, saved, first)
        self._adopt(problem, {**held, **learned.tensors})
        if saved is not None:
            saved.remove()
        return self._result(learned)

    def condition(self, data: Dataset | Sequence[Observation]) -> None:
        """Replace the data conditioned on, keeping hyperparameters and input scales.

        Raises:
            ModelError: the model has not been fitted, or the data do not fit it.
        """
        if self.training is None:
            raise not_fitted(self)
        training = self._training(data, learn=())
        old, new = ([m.quantity for m in t.measurements] for t in (self.training, training))
        if self.learn_noise and new != old:
            raise ModelError(
                "the learned noise belongs to other measurements",
                expected=", ".join(old),
                got=", ".join(new),
                hint="call fit(data, learn=[]), which learns the noise alone",
            )
        self._adopt(self._problem(training), self.hyperparameters)

    def log_marginal_likelihood(self) -> float:
        """log p(y | X, θ) of the training data.

        Raises:
            ModelError: the model has not been fitted.
        """
        if self.training is None:
            raise not_fitted(self)
        rows = self._problem(self.training).rows(self.hyperparameters)
        fit, y = self.posterior.conditioned, target_of(rows.blocks)
        half = 0.5 * (y @ fit.alpha) + fit.L.diagonal().log().sum() + 0.5 * len(y) * math.log(2.0 * math.pi)
        return -float(half + rows.constant)

    def _learned_priors(self, learn: Iterable[str] | None) -> tuple[str, ...]:
        names = tuple(prior.name for prior in self.force_priors)
        chosen = names if learn is None else tuple(learn)
        for name in chosen:
            if name not in names:
                raise UnknownNameError("force prior to learn", name, names)
        return chosen

    def _training(self, data: Dataset | Sequence[Observation], learn: Sequence[str]) -> Training:
        return training_of(data, self.system, self.force_priors, self.noise_std, self.training, learn)

    def _states(self, m: Measurement) -> States:
        return states(self.system, m.q, m.qd, m.tau, m.active)

    def _problem(self, training: Training) -> Problem:
        return Problem(self.system, self.force_priors, self.mean, training, self.analytical_parameters)

    def _adopt(self, problem: Problem, tensors: dict[str, Tensor]) -> None:
        """Keep learned values and condition on the training data."""
        self.hyperparameters, self.training = tensors, problem.training
        if self.analytical_parameters is not None:
            self.analytical_parameters.load_state_dict(analytical_parameters(tensors), strict=False)
            with torch.no_grad():
                self.system = self.system.with_robot(self.analytical_parameters())
        with torch.no_grad():
            blocks = problem.rows(tensors).blocks
            scales, params = problem.training.scales, kernel_parameters(tensors)
            self._posterior = posterior(self.force_priors, scales, params, blocks, self.mean)

    @torch.no_grad()
    def restore(self, training: Training, hyperparameters: dict[str, Tensor], alpha: Tensor) -> None:
        """Take over the state of a saved model; the factorisation waits until a covariance is asked for.

        Raises:
            ValueError: the weights `alpha` do not fit the training data.
        """
        self.training, self.hyperparameters = training, hyperparameters
        blocks = self._problem(training).rows(hyperparameters).blocks
        rows = sum(block.rows for block in blocks)
        if alpha.shape != (rows,) or not bool(torch.isfinite(alpha).all()):
            raise ValueError(f"weights of shape {tuple(alpha.shape)} for {rows} rows")
        params = kernel_parameters(hyperparameters)
        self._posterior = ForcePosterior(self.force_priors, training.scales, params, blocks, self.mean, alpha)

    def _result(self, learned: Learned) -> FitResult:
        training, fitted = self.training, self.posterior
        assert training is not None
        constant = [
            f"{prior.name}.{name}"
            for prior, scale in zip(self.force_priors, training.scales, strict=True)
            for name in scale.constant
        ]
        return FitResult(
            converged=learned.converged,
            evaluations=learned.evaluations,
            seconds=learned.seconds,
            objective=learned.value,
            log_marginal_likelihood=self.log_marginal_likelihood(),
            jitter=fitted.conditioned.jitter,
            constant_inputs=tuple(constant),
            message=learned.message,
            history=tuple(learned.history),
            force_correlation=self._mean_correlation(training),
        )

    @torch.no_grad()
    def _mean_correlation(self, training: Training) -> float | None:
        """Mean correlation of Q and Q_z over some of the training states, where both are unknown."""
        if len({prior.in_contact_only for prior in self.force_priors if prior.measurable}) < 2:
            return None
        m = training.thinned(CORRELATION_STATES).measurements[0]
        return float(force_correlation(self.posterior, self.system, self._states(m)).mean())

    # -- prediction -------------------------------------------------------------------------------

    @property
    def posterior(self) -> ForcePosterior:
        """The posterior over latent forces.

        Raises:
            ModelError: the model has not been fitted.
        """
        if self._posterior is None:
            raise not_fitted(self)
        return self._posterior

    @torch.no_grad()
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str | Sequence[str] = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
    ) -> Prediction:
        """Posterior mean and covariance of a quantity (eqs. 22 to 25).

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: a name of `QUANTITIES`, or several for their joint distribution.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            covariance: whether to compute the covariance, which costs more than the mean.
            system: read the forces on another system, such as another surface or none at all.

        Returns:
            Mean `(*batch, d)` and covariance `(*batch, d, d)`, without measurement noise.

        Raises:
            ModelError: the model has not been fitted.
            UnknownNameError: no such quantity.
            ShapeError: a state or `active` does not fit the system.
        """
        fitted = self.posterior
        system = system or self.system
        batch, at = states_at(system, q, qd, tau, active)
        z, parts = stack(affine_maps(system, at, quantity))
        mean = fitted.read_mean(system, at, z)
        spread = fitted.read_covariance(system, at, z) if covariance else None
        return Prediction(
            mean.reshape(*batch, z.o.shape[-1]),
            None if spread is None else spread.reshape(*batch, *spread.shape[-2:]),
            parts,
        )

    def force_field(self) -> ForceField:
        return self.posterior.total_force

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        return draw_samples(self.posterior, samples, generator).total_force

    def save(self, path: str | Path) -> None:
        """Write the model as a folder; `forcegp.load_model` reads it back exactly."""
        save_structured(self, path)
