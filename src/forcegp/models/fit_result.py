"""Result of a fit, and display of models as a line of text or as a table in notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pydantic import NonNegativeFloat, NonNegativeInt
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.notebook import html_table

COVERED = 0.8
"""Held-out ±2σ coverage below which a fit issues a warning. It corresponds to a σ that is 36 % too small."""


@dataclass(frozen=True)
class Compared:
    """Score of a set of force priors in the comparison on held-out blocks of the training log.

    Attributes:
        name: name of the set.
        log_density: mean log predictive density of held-out samples [nats per sample], or `None` if it was
            not computed on both halves of the log. Densities on different samples are not comparable.
        behind: deficit relative to the best set on the same samples [nats per sample].
        standard_error: standard error of this deficit.
        chosen: whether this set was selected.
        note: reason why the set was not tested, or was not tested on both halves of the log.
        coverage: fraction of held-out values within ±2σ, which is 0.95 for correct error bars.
    """

    name: str
    log_density: float | None = None
    behind: float | None = None
    standard_error: float | None = None
    chosen: bool = False
    note: str = ""
    coverage: float | None = None

    @property
    def doubt(self) -> str:
        """Warning if the held-out coverage is far too low, otherwise an empty string."""
        if self.coverage is None or self.coverage >= COVERED:
            return ""
        return (
            f"the model predicts held-out blocks of this log poorly: ±2σ coverage is {self.coverage:.0%} "
            "instead of 95%; check the log and the robot file (`forcegp check`)"
        )

    def __str__(self) -> str:
        name = f"{self.name} (chosen)" if self.chosen else self.name
        if self.behind is None:
            return f"{name}: {self.note}"
        behind = f"{self.behind:.2f} ± {self.standard_error:.2f} behind"
        score = behind if self.log_density is None else f"{self.log_density:.2f} ({behind})"
        return f"{name}: {score}, {self.note}" if self.note else f"{name}: {score}"


@dataclass(frozen=True)
class FitResult:
    """Result of a fit. Saved files contain all fields except the history.

    Attributes:
        converged: whether the optimiser reached its tolerance.
        evaluations: number of evaluations of the objective.
        seconds: duration of the fit.
        objective: final mean squared error, or negative log posterior of the hyperparameters.
        log_marginal_likelihood: log marginal likelihood of the training data, or `None` if undefined.
        jitter: jitter added to the diagonal of the covariance, in units of the noise variance. The effective
            noise is √(1 + jitter) times the given noise.
        constant_inputs: inputs that are constant in the training data and therefore are not scaled.
        message: reason why the optimiser stopped.
        history: the objective at each evaluation.
        force_correlation: mean posterior correlation between the joint force Q and the contact force Q_z at
            training states. If it is near −1, only the sum of the forces is identifiable. If it is near 0,
            both are. It is `None` unless both forces have priors.
        warnings: warnings about the fit, each with a suggested remedy.
        inference: `"exact"` or `"sparse"` for models that support both.
        samples: number of samples on which the model is conditioned.
        learned_on: number of samples used to learn the hyperparameters.
        basis_functions: number of basis functions of a sparse posterior.
        determined: effective number of basis functions that the data determine.
        missed: total residual prior variance of all rows, given the inducing points, in units of the noise
            variance. In the same units, `determined` is the total posterior variance.
        more_points_would_help: whether `missed` is at least a tenth of `determined`.
        comparison: scores of the compared sets of force priors. It is empty if the priors were specified.
        never_closed: contacts that are never closed in the training data. Their forces are undetermined.
    """

    converged: bool
    evaluations: NonNegativeInt
    seconds: NonNegativeFloat
    objective: float
    log_marginal_likelihood: float | None = None
    jitter: NonNegativeFloat = 0.0
    constant_inputs: tuple[str, ...] = ()
    message: str = ""
    history: tuple[float, ...] = field(default=(), repr=False)
    force_correlation: float | None = None
    warnings: tuple[str, ...] = ()
    inference: str = ""
    samples: NonNegativeInt | None = None
    learned_on: NonNegativeInt | None = None
    basis_functions: NonNegativeInt | None = None
    determined: float | None = None
    missed: float | None = None
    more_points_would_help: bool | None = None
    comparison: tuple[Compared, ...] = ()
    never_closed: tuple[str, ...] = ()


def model_line(kind: str, system: ConstrainedSystem, result: FitResult | None) -> str:
    """Return a line of text that describes the robot, the contacts and the result of the fit, if any."""
    robot = system.robot
    contacts = f", contact {', '.join(system.contact_names)}" if system.contacts else ""
    outcome = "" if result is None else f"; {_outcome(result)}"
    return f"<{kind} of {robot.name!r}: {robot.nq} joints{contacts}{outcome}>"


def _outcome(result: FitResult) -> str:
    if not result.evaluations:
        return "conditioned, nothing learned"
    how = "converged" if result.converged else "NOT converged"
    return f"{how} after {result.evaluations} evaluations in {result.seconds:.3g} s"


def fit_table(title: str, result: FitResult | None, learned: Sequence[tuple[str, object]]) -> str:
    """Return the result of a fit as HTML."""
    rows: list[tuple[object, ...]] = []
    notes: Sequence[str] = ()
    if result is not None:
        rows.append(("log marginal likelihood", _number(result.log_marginal_likelihood)))
        rows.append(("jitter", result.jitter))
        notes = [f"Warning: {warning}" for warning in result.warnings]
    rows += [(name, _number(value)) for name, value in learned]
    return html_table(title.strip("<>"), (), rows, notes)


def _number(value: object) -> object:
    """Format tensors and long sequences as a few numbers."""
    if value is None:
        return "–"
    if isinstance(value, Tensor):
        flat = value.detach().flatten().tolist()
        return ", ".join(f"{x:.3g}" for x in flat[:8]) + (", …" if len(flat) > 8 else "")
    return value
