"""A model in one line, and as a table for notebooks."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.models.fit_result import FitResult
from forcegp.notebook import html_table


def model_line(kind: str, system: ConstrainedSystem, result: FitResult | None) -> str:
    """Robot, contacts, and how the fit went."""
    robot = system.robot
    contacts = f", contact {', '.join(system.contact_names)}" if system.contacts else ""
    return f"<{kind} of {robot.name!r}: {robot.nq} joints{contacts}; {_outcome(result)}>"


def _outcome(result: FitResult | None) -> str:
    if result is None:
        return "not fitted"
    if not result.evaluations:
        return "conditioned, nothing learned"
    how = "converged" if result.converged else "NOT converged"
    return f"{how} after {result.evaluations} evaluations in {result.seconds:.3g} s"


def fit_table(title: str, result: FitResult | None, learned: Sequence[tuple[str, object]]) -> str:
    """How a fit went and what it learned, as HTML."""
    rows: list[tuple[object, ...]] = []
    notes: Sequence[str] = ()
    if result is not None:
        rows += [
            ("log marginal likelihood", _number(result.log_marginal_likelihood)),
            ("jitter", result.jitter),
        ]
        notes = [f"Warning: {warning}" for warning in result.warnings]
    rows += [(name, _number(value)) for name, value in learned]
    return html_table(title.strip("<>"), (), rows, notes)


def _number(value: object) -> object:
    """Tensors and long sequences as a few numbers."""
    if value is None:
        return "–"
    if isinstance(value, Tensor):
        flat = value.detach().flatten().tolist()
        return ", ".join(f"{x:.3g}" for x in flat[:8]) + (", …" if len(flat) > 8 else "")
    return value
