"""Prior means of the joint force: zero, or what the analytical model knows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.quantities import States

TERMS = ("bias", "gravity", "friction", "actuation")
"""Q_C, Q_G, Q_D and Q_u: the known parts of Q."""


@dataclass(frozen=True)
class AnalyticalMean:
    """m(x; θ_A) = Q_K, the sum of some of Q_C, Q_G, Q_D and Q_u.

    Args:
        terms: which of `bias`, `gravity`, `friction`, `actuation` are known; none is the zero mean.

    Example:
        >>> AnalyticalMean(("gravity", "actuation")).terms
        ('gravity', 'actuation')

    Raises:
        UnknownNameError: a term does not exist.
        ModelError: a term is named twice.
    """

    terms: tuple[str, ...] = TERMS

    def __post_init__(self) -> None:
        for term in self.terms:
            if term not in TERMS:
                raise UnknownNameError("term of the analytical mean", term, TERMS)
            if self.terms.count(term) > 1:
                raise ModelError(f"term {term!r} of the analytical mean is named twice", got=self.terms)

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """The mean of Q at states, `(n, nq)` [N m, N]."""
        known = {"bias": at.eom.Q_C, "gravity": at.eom.Q_G, "friction": at.eom.Q_D, "actuation": at.tau}
        return sum((known[term] for term in self.terms), start=torch.zeros_like(at.q))


def mean_of(mean: str | AnalyticalMean) -> AnalyticalMean:
    """`"zero"`, `"analytical"` or a mean of one's own.

    Raises:
        UnknownNameError: a name that is neither.
    """
    if isinstance(mean, AnalyticalMean):
        return mean
    named = {"zero": AnalyticalMean(()), "analytical": AnalyticalMean()}
    if mean not in named:
        raise UnknownNameError("mean", mean, named)
    return named[mean]
