"""Result of a fit, and display of models as a line of text or as a table in notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pydantic import NonNegativeFloat, NonNegativeInt
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.notebook import html_table


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
        worth: log evidence of the columns of each prior and joint over their absence [nats].
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
    worth: dict[str, float] = field(default_factory=dict)
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
