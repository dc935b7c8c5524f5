"""What every regression model of the forward dynamics has in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError, NumericalError
from forcegp.forces.states import States

if TYPE_CHECKING:
    from forcegp.rollout.forward import Torque
    from forcegp.rollout.trajectory import Rollout

ForceField = Callable[[ConstrainedSystem, States], Tensor]
"""The impressed force Q̄ at states, `(n, nq)`; a batch of functions gives each its share of the n rows."""

FitProgress = Callable[[int, int, float], None]
"""Called with the evaluations made, the most that will be made, and the objective."""


@dataclass(frozen=True)
class Prediction:
    """A predicted quantity at a batch of states.

    Attributes:
        mean: `(*batch, d)`.
        covariance: `(*batch, d, d)` of the noise-free quantity, or `None` where the model gives none
            or it was not asked for.
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
        evaluations: of the objective.
        seconds: how long the fit took.
        objective: final value (mean squared error, or negative log posterior of the hyperparameters).
        log_marginal_likelihood: of the training data, `None` for models without one.
        jitter: added to the covariance's diagonal to factorise it, relative to unit noise: the noise that
            the model works with is √(1 + jitter) times the one that it was told.
        constant_inputs: inputs that do not vary in the training data and were left unscaled.
        message: why the optimiser stopped.
        history: the objective at each evaluation.
        force_correlation: mean posterior correlation of the joint force Q and the contact's force Q_z at
            training states: near −1 the data tell their sum only, near 0 they tell both. `None` for
            models that do not have both.
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


class Model(ABC):
    """A forward dynamics (q, q̇, τ) ↦ q̈ learned from a data set."""

    kind: str
    """Name of the class of models in saved files."""
    system: ConstrainedSystem
    has_function_samples: bool = False
    """Whether `force_samples` draws functions from a posterior over forces."""

    @abstractmethod
    def fit(self, data: Dataset, *, progress: FitProgress | None = None) -> FitResult:
        """Learn from a data set."""

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
    ) -> Prediction:
        """Predict a quantity at states `(*batch, nq)`; `active` `(*batch, n_contacts)` defaults to all."""

    def force_field(self) -> ForceField | None:
        """The mean impressed force Q̄ `(n, nq)` at states, or `None` for a model of accelerations alone.

        Raises:
            ModelError: the model has not been fitted.
        """
        return None

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        """Force functions drawn from the posterior, all evaluated at once.

        Args:
            samples: number S of functions.
            generator: source of the draws.

        Returns:
            A force field on `(S * k, nq)` states, of which the s-th run of k belongs to function s.

        Raises:
            ModelError: the model has no posterior over force functions, or has not been fitted.
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
            tau: motor torque over time `(samples, nq)` or `(*batch, samples, nq)`, or a law of (t, q, q̇).
            duration: simulated time [s].
            samples: number of function samples that are integrated too.
            **settings: `options`, `seed`, `active`, `system` and `progress` of `rollout_model`.
        """
        # A rollout is built on models, so that its module cannot be imported before this one.
        from forcegp.rollout.forward import rollout_model

        return rollout_model(self, q0, qd0, tau, duration, samples, **settings)

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Write the model as a folder of safetensors and versioned JSON."""


def only_qdd(model: Model, quantity: object) -> None:
    """Refuse quantities that a model of accelerations alone cannot give.

    Raises:
        ModelError: the quantity is not `qdd`.
    """
    if quantity != "qdd":
        raise ModelError(
            f"a {model.kind!r} model predicts accelerations only",
            expected="qdd",
            got=quantity,
            hint="use StructuredGP for forces and multipliers",
        )


def not_fitted(model: Model) -> ModelError:
    """The error of a model that is asked for predictions before it has data."""
    return ModelError(f"this {model.kind!r} model has not been fitted", hint="call model.fit(data) first")
