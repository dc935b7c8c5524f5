"""What every model of the forward dynamics has in common: a specification that is fitted, and what
predicts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError, NumericalError
from forcegp.gp.optimise import Learned
from forcegp.rollout.forward import rollout_model
from forcegp.rollout.inputs import Torque
from forcegp.rollout.law import ForceField
from forcegp.rollout.trajectory import Rollout
from forcegp.storage.folder import Settings, write_model

FitProgress = Callable[[int, int, float], None]
"""Called with the number of evaluations, their maximum, and the objective."""


@dataclass(frozen=True)
class Prediction:
    """A predicted quantity at a batch of states.

    Attributes:
        mean: `(*batch, d)`.
        covariance: `(*batch, d, d)`, of the noise-free quantity unless noise was asked for; `None` where the
            model gives none or it was not asked for.
        parts: the slice of each quantity, where several were asked for.
    """

    mean: Tensor
    covariance: Tensor | None = None
    parts: dict[str, slice] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite.

        Raises:
            NumericalError: the mean or the covariance holds one.
        """
        for name, value in (("mean", self.mean), ("covariance", self.covariance)):
            if value is not None and not bool(torch.isfinite(value).all()):
                raise NumericalError(
                    f"the {name} of a prediction is not finite",
                    got=f"{int((~torch.isfinite(value)).sum())} of {value.numel()} numbers",
                    hint="states beyond what a robot can do overflow; check q, qd and tau",
                )

    @property
    def variance(self) -> Tensor | None:
        """`(*batch, d)`, the diagonal of the covariance."""
        return None if self.covariance is None else self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0)

    @property
    def std(self) -> Tensor | None:
        """`(*batch, d)` standard deviation."""
        variance = self.variance
        return None if variance is None else variance.sqrt()


@dataclass(frozen=True)
class FitResult:
    """How a fit went.

    Attributes:
        converged: whether the optimiser reached its tolerance.
        evaluations: number of evaluations of the objective.
        seconds: duration of the fit.
        objective: final value (mean squared error, or negative log posterior of the hyperparameters).
        log_marginal_likelihood: of the training data, `None` for models without one.
        jitter: added to the diagonal of the covariance to factorise it, relative to unit noise: the noise
            that the model works with is √(1 + jitter) times the stated noise.
        constant_inputs: inputs that do not vary in the training data and were left unscaled.
        message: why the optimiser stopped.
        history: the objective at each evaluation.
        force_correlation: mean posterior correlation of the joint force Q and the contact's force Q_z at
            training
            states: near −1 only their sum is identifiable, near 0 both are. `None` without priors on both.
        warnings: doubts about the fit, each with a remedy.
    """

    converged: bool
    evaluations: int
    seconds: float
    objective: float
    log_marginal_likelihood: float | None = None
    jitter: float = 0.0
    constant_inputs: tuple[str, ...] = ()
    message: str = ""
    history: tuple[float, ...] = ()
    force_correlation: float | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, learned: Learned, **more: Any) -> FitResult:
        """The result of an optimisation, with what else is known."""
        return cls(
            converged=learned.converged,
            evaluations=learned.evaluations,
            seconds=learned.seconds,
            objective=learned.value,
            message=learned.message,
            history=tuple(learned.history),
            **more,
        )


class Predictor(ABC):
    """A forward dynamics (q, q̇, τ) ↦ q̈ that predicts."""

    kind: str
    """Name of the class of models in saved files."""
    has_function_samples: bool = False
    """Whether `force_samples` draws functions from a posterior over forces."""

    system: ConstrainedSystem
    """Robot and contacts that predictions refer to."""

    @abstractmethod
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
    ) -> Prediction:
        """Predict a quantity at states `(*batch, nq)`.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: what to predict.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            covariance: whether to compute the covariance.
            system: another system to predict on, for models of forces.
        """

    def force_field(self) -> ForceField | None:
        """The mean impressed force Q̄ `(n, nq)` at states, or `None` for a model of accelerations alone."""
        return None

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        """Force functions drawn from the posterior, all evaluated at once.

        Args:
            samples: number S of functions.
            generator: source of the draws.

        Returns:
            A force field on `(S * k, nq)` states, of which the s-th run of k belongs to function s.

        Raises:
            ModelError: the model has no posterior over force functions.
        """
        raise ModelError(
            f"a {self.kind!r} model has no function samples", hint="use StructuredGP, or samples=0"
        )

    def rollout(
        self,
        q0: Tensor,
        qd0: Tensor,
        tau: Torque,
        duration: float = 10.0,
        samples: int = 0,
        **settings: Any,
    ) -> Rollout:
        """Predict trajectories from initial states (section 4); see `forcegp.rollout.rollout_model`.

        Args:
            q0, qd0: `(*batch, nq)` initial states.
            tau: motor torque over time: a log, or an array `(samples, nq)` or `(*batch, samples, nq)` with
                its period in `options`; or a law of (t, q, q̇).
            duration: simulated time [s].
            samples: number of function samples to integrate besides the mean.
            **settings: `options`, `seed`, `active`, `system` and `progress` of `rollout_model`.
        """
        return rollout_model(self, q0, qd0, tau, duration, samples, **settings)

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Write the model as a folder; `forcegp.load_model` reads it back exactly.

        Raises:
            ModelError: the model has not been fitted, or a part of it is Python code.
            OSError: the place cannot be written.
        """


class FittedModel(Predictor):
    """A model with learned parameters; immutable."""

    result: FitResult

    @abstractmethod
    def record(self) -> tuple[Settings, dict[str, Tensor]]:
        """Settings and tensors that the model can be restored from."""

    def save(self, path: str | Path) -> None:
        write_model(path, self.kind, self.system, *self.record())

    @property
    def converged(self) -> bool:
        """Whether the optimiser reached its tolerance."""
        return self.result.converged

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the objective."""
        return self.result.evaluations

    @property
    def seconds(self) -> float:
        """Duration of the fit."""
        return self.result.seconds

    @property
    def objective(self) -> float:
        """Final value of the objective."""
        return self.result.objective

    @property
    def log_marginal_likelihood(self) -> float | None:
        """log p(y | X, θ) of the training data, `None` for models without one."""
        return self.result.log_marginal_likelihood

    @property
    def jitter(self) -> float:
        """Added to the diagonal of the covariance to factorise it, relative to unit noise."""
        return self.result.jitter

    @property
    def constant_inputs(self) -> tuple[str, ...]:
        """Inputs that do not vary in the training data."""
        return self.result.constant_inputs

    @property
    def message(self) -> str:
        """Why the optimiser stopped."""
        return self.result.message

    @property
    def history(self) -> tuple[float, ...]:
        """The objective at each evaluation."""
        return self.result.history

    @property
    def force_correlation(self) -> float | None:
        """Mean posterior correlation of Q and Q_z at training states."""
        return self.result.force_correlation


F = TypeVar("F", bound=FittedModel)


class Model(Predictor, Generic[F]):
    """A specification that is fitted to data. It predicts with its most recent fit, for convenience."""

    specified: ConstrainedSystem
    """Robot and contacts as given."""
    _fitted: F | None = None

    @abstractmethod
    def fit(
        self,
        data: Dataset,
        *,
        progress: FitProgress | None = None,
        checkpoint: str | Path | None = None,
        keep_checkpoint: bool = False,
    ) -> F:
        """Learn from a data set.

        Args:
            data: states and measurements.
            progress: called now and then.
            checkpoint: file that records a long fit; a fit that finds it resumes there, to the same bits, and
                removes it at its end.
            keep_checkpoint: leave the file, to be removed once the model is saved.

        Returns:
            The fitted model, which is also kept as `fitted`.
        """

    @property
    def fitted(self) -> F:
        """The most recent fit.

        Raises:
            ModelError: the model has not been fitted.
        """
        if self._fitted is None:
            raise ModelError(
                f"this {self.kind!r} model has not been fitted", hint="call model.fit(data) first"
            )
        return self._fitted

    @property
    def system(self) -> ConstrainedSystem:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Robot and contacts that predictions refer to: the learned ones after a fit."""
        return self.specified if self._fitted is None else self._fitted.system

    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: Any = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
        **settings: Any,
    ) -> Prediction:
        """Predict with the most recent fit; see the `predict` of the fitted model."""
        return self.fitted.predict(
            q, qd, tau, quantity, active=active, covariance=covariance, system=system, **settings
        )

    def force_field(self) -> ForceField | None:
        return self.fitted.force_field()

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        return self.fitted.force_samples(samples, generator)

    def save(self, path: str | Path) -> None:
        self.fitted.save(path)


def check_acceleration_only(predictor: Predictor, quantity: object, system: ConstrainedSystem | None) -> None:
    """Refuse what a model of accelerations alone cannot give.

    Raises:
        ModelError: the quantity is not `qdd`, or another system is given.
    """
    if quantity != "qdd":
        raise ModelError(
            f"a {predictor.kind!r} model predicts accelerations only",
            expected="qdd",
            got=quantity,
            hint="use StructuredGP for forces and multipliers",
        )
    if system is not None and system is not predictor.system:
        raise ModelError(
            f"a {predictor.kind!r} model knows no forces, so it cannot predict on another system",
            hint="use StructuredGP, or leave out `system`",
        )
