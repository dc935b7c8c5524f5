"""Gaussian-process priors on forces, carried to accelerations and multipliers by the known mechanics.

q̈ ~ GP(L b + H m_Q, H k_Q Hᵀ) (eq. 15), and likewise for every other quantity (eqs. 19 to 25).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError, UnknownNameError
from forcegp.gp.affine import affine_map
from forcegp.gp.exact import negative_log_likelihood
from forcegp.gp.hyperprior import bounds_of, initial_hyperparameters, negative_log_prior
from forcegp.gp.learning import Learned, LearningOptions, minimise
from forcegp.gp.mean import AnalyticalMean, mean_of
from forcegp.gp.pathwise import draw_samples
from forcegp.gp.posterior import ForcePosterior, posterior
from forcegp.gp.priors import (
    ForcePrior,
    JointForcePrior,
    Standardization,
    States,
    check_priors,
    states,
    states_at,
)
from forcegp.gp.whitening import Measurement, WhitenedRows, combine, whiten
from forcegp.models.base import FitProgress, FitResult, ForceField, Model, Prediction, not_fitted
from forcegp.models.observation import NoiseStd, Observation, measurement_of
from forcegp.models.structured_settings import save_structured

NOISE = "noise"
ANALYTICAL = "analytical."
OWN = (f"{NOISE}.", ANALYTICAL)
"""Prefixes of what is learned beside the hyperparameters of the priors."""


@dataclass(frozen=True)
class Training:
    """What a fitted model keeps of its training data.

    Attributes:
        measurements: the values conditioned on.
        noise_std: of each measurement, as given `(d,)`.
        scales: standardization of each prior's inputs.
    """

    measurements: tuple[Measurement, ...]
    noise_std: tuple[Tensor, ...]
    scales: tuple[Standardization, ...]


class StructuredGP(Model):
    """A structured Gaussian process (S-GP): priors on the unknown forces of a constrained system.

    Args:
        system: robot and contacts.
        mean: `"zero"`, `"analytical"`, or an `AnalyticalMean` with some terms left out.
        force_priors: priors on the unknown forces; one `JointForcePrior` by default.
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
        self.force_priors = tuple(force_priors) if force_priors is not None else (JointForcePrior(),)
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
        progress: FitProgress | None = None,
    ) -> FitResult:
        """Learn hyperparameters (and analytical parameters) by maximum a posteriori, then condition.

        Args:
            data: measured accelerations, or any mixture of measurements.
            options: optimiser and its limits.
            learn: names of the priors whose hyperparameters are learned; the others keep the values and
                input scales of an earlier fit (two-stage training). Default all; with none, and no noise
                or analytical parameter to learn, the model is only conditioned.
            progress: called after each evaluation.

        Raises:
            ModelError, DataError, UnknownNameError: the data do not fit the model.
            NumericalError: the likelihood cannot be computed.
        """
        options = options or LearningOptions()
        learn = self._learned_priors(learn)
        training = self._training(data, learn)
        start, held = self._start(training, learn)
        if not start:
            self._adopt(held, training)
            return self._result(
                Learned({}, -self.log_marginal_likelihood(), True, 0, 0.0, "nothing to learn")
            )
        fixed_rows = None if self._moving() else self._rows(training, {})

        def objective(tensors: dict[str, Tensor]) -> Tensor:
            rows = fixed_rows or self._rows(training, tensors)
            params = {**held, **{k: v for k, v in tensors.items() if not k.startswith(OWN)}}
            value, _ = negative_log_likelihood(self.force_priors, params, rows.blocks)
            hyper = {key: v for key, v in tensors.items() if not key.startswith(ANALYTICAL)}
            return value + rows.constant + negative_log_prior(hyper, start)

        analytical = frozenset(key for key in start if key.startswith(ANALYTICAL))
        bounds = bounds_of({key: value for key, value in start.items() if key not in analytical})

        def report(evaluations: int, value: float, _: dict[str, Tensor]) -> None:
            if progress is not None:
                progress(evaluations, options.max_evaluations, value)

        learned = minimise(objective, start, options, analytical, bounds, report)
        self._adopt({**held, **learned.tensors}, training)
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
        self._adopt(self.hyperparameters, training)

    def log_marginal_likelihood(self) -> float:
        """log p(y | X, θ) of the training data.

        Raises:
            ModelError: the model has not been fitted.
        """
        if self.training is None:
            raise not_fitted(self)
        rows = self._rows(self.training, self.hyperparameters)
        value, _ = negative_log_likelihood(self.force_priors, self._kernel_parameters(), rows.blocks)
        return -float(value + rows.constant)

    def _learned_priors(self, learn: Iterable[str] | None) -> tuple[str, ...]:
        names = tuple(prior.name for prior in self.force_priors)
        chosen = names if learn is None else tuple(learn)
        for name in chosen:
            if name not in names:
                raise UnknownNameError("force prior to learn", name, names)
        return chosen

    def _training(self, data: Dataset | Sequence[Observation], learn: Sequence[str]) -> Training:
        observations = [Observation(data)] if isinstance(data, Dataset) else list(data)
        if not observations:
            raise ModelError(
                "there is nothing to learn from", expected="at least one observation", got="none"
            )
        pairs = [measurement_of(o, self.system, self.noise_std) for o in observations]
        at = [self._states(m) for m, _ in pairs]
        scales = []
        for p, prior in enumerate(self.force_priors):
            if prior.name not in learn and self.training is not None:
                scales.append(self.training.scales[p])
                continue
            features = [prior.features(self.system, a) for a in at]
            scales.append(Standardization.of({k: torch.cat([f[k] for f in features]) for k in features[0]}))
        return Training(tuple(m for m, _ in pairs), tuple(std for _, std in pairs), tuple(scales))

    def _states(self, m: Measurement) -> States:
        return states(self.system, m.q, m.qd, m.tau, m.active)

    def _moving(self) -> bool:
        """Whether the rows change while learning."""
        return self.learn_noise or self.analytical_parameters is not None

    def _start(self, training: Training, learn: Sequence[str]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Initial values of what is learned, and the hyperparameters that are held."""
        initial = initial_hyperparameters(self.force_priors, self._rows(training, {}).blocks)
        held = {
            key: self.hyperparameters.get(key, value)
            for key, value in initial.items()
            if not key.startswith(tuple(name + "." for name in learn))
        }
        start = {key: value for key, value in initial.items() if key not in held}
        if self.learn_noise:
            start |= {f"{NOISE}.{i}.log_noise_std": std.log() for i, std in enumerate(training.noise_std)}
        if self.analytical_parameters is not None:
            named = self.analytical_parameters.named_parameters()
            start |= {ANALYTICAL + name: value.detach().clone() for name, value in named}
        return start, held

    def _rows(self, training: Training, tensors: dict[str, Tensor]) -> WhitenedRows:
        """Whitened rows at given noise and analytical parameters."""
        system = self._system_at(tensors)
        rows = []
        for i, (m, std) in enumerate(zip(training.measurements, training.noise_std, strict=True)):
            key = f"{NOISE}.{i}.log_noise_std"
            noise = tensors[key].exp() if key in tensors else std
            rows.append(whiten(system, self.force_priors, training.scales, self.mean, m, noise))
        return combine(rows)

    def _system_at(self, tensors: dict[str, Tensor]) -> ConstrainedSystem:
        own = {k.removeprefix(ANALYTICAL): v for k, v in tensors.items() if k.startswith(ANALYTICAL)}
        if self.analytical_parameters is None or not own:
            return self.system
        return self.system.with_robot(torch.func.functional_call(self.analytical_parameters, own, ()))

    def _kernel_parameters(self) -> dict[str, Tensor]:
        return {k: v for k, v in self.hyperparameters.items() if not k.startswith(OWN)}

    def _adopt(self, tensors: dict[str, Tensor], training: Training) -> None:
        """Keep learned values and condition on the training data."""
        self.hyperparameters, self.training = tensors, training
        if self.analytical_parameters is not None:
            own = {k.removeprefix(ANALYTICAL): v for k, v in tensors.items() if k.startswith(ANALYTICAL)}
            self.analytical_parameters.load_state_dict(own, strict=False)
            with torch.no_grad():
                self.system = self.system.with_robot(self.analytical_parameters())
        with torch.no_grad():
            rows = self._rows(training, tensors)
            self._posterior = posterior(
                self.force_priors, training.scales, self._kernel_parameters(), rows.blocks, self.mean
            )

    @torch.no_grad()
    def restore(self, training: Training, hyperparameters: dict[str, Tensor], alpha: Tensor) -> None:
        """Take over the state of a saved model; the factorisation waits until a covariance is asked for.

        Raises:
            ValueError: the weights `alpha` do not fit the training data.
        """
        self.training, self.hyperparameters = training, hyperparameters
        blocks = self._rows(training, hyperparameters).blocks
        rows = sum(block.rows for block in blocks)
        if alpha.shape != (rows,) or not bool(torch.isfinite(alpha).all()):
            raise ValueError(f"weights of shape {tuple(alpha.shape)} for {rows} rows")
        params = self._kernel_parameters()
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
        )

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
        z = affine_map(system, at, quantity)
        mean = fitted.read_mean(system, at, z)
        spread = fitted.read_covariance(system, at, z) if covariance else None
        return Prediction(
            mean.reshape(*batch, z.o.shape[-1]),
            None if spread is None else spread.reshape(*batch, *spread.shape[-2:]),
            _parts(system, at, quantity),
        )

    def force_field(self) -> ForceField:
        return self.posterior.total_force

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        return draw_samples(self.posterior, samples, generator).total_force

    def save(self, path: str | Path) -> None:
        """Write the model as a folder; `forcegp.load_model` reads it back exactly."""
        save_structured(self, path)


def _parts(system: ConstrainedSystem, at: States, quantity: str | Sequence[str]) -> dict[str, slice]:
    names = [quantity] if isinstance(quantity, str) else list(quantity)
    parts, first = {}, 0
    for name in names:
        last = first + affine_map(system, at, name).o.shape[-1]
        parts[name], first = slice(first, last), last
    return parts
