"""How a fit went."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from forcegp.gp.optimise import Learned


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
        inference: `"exact"` or `"sparse"`, for models that have both.
        samples: number of samples that the model is conditioned on.
        learned_on: number of samples that hyperparameters were learned on.
        basis_functions: size of a sparse posterior.
        determined: how many basis functions the data determine.
        missed: prior variance that the inducing points miss in all rows together, in units of the noise
            variance; what noise leaves of all rows is `determined` in the same units.
        more_points_would_help: whether `missed` is a tenth of `determined` or more.
    """

    converged: bool
    evaluations: int
    seconds: float
    objective: float
    log_marginal_likelihood: float | None = None
    jitter: float = 0.0
    constant_inputs: tuple[str, ...] = ()
    message: str = ""
    history: tuple[float, ...] = field(default=(), repr=False)
    force_correlation: float | None = None
    warnings: tuple[str, ...] = ()
    inference: str = ""
    samples: int | None = None
    learned_on: int | None = None
    basis_functions: int | None = None
    determined: float | None = None
    missed: float | None = None
    more_points_would_help: bool | None = None

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
