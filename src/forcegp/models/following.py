"""Following forces that change at once, such as a payload that is picked up.

A memory that fades with time forgets a payload while the arm moves too little to show it, and takes time
to notice a new one. So what earlier samples say is forgotten on evidence: with D the new samples, where

    p(D | payload anew from its prior) · p(change) > p(D | payload as it was).

Both are marginal likelihoods, read off the posterior before and after the update.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.gp.bound import bound_of
from forcegp.gp.sparse import SparsePosterior
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP

CHANGE = 1e-3
"""Prior probability that a force changes between two calls."""


@dataclass(frozen=True)
class Followed:
    """The result of `follow`.

    Attributes:
        fit: the fit with the new samples.
        changed: whether the forces were learned anew.
        log_odds: of a change against none, after the new samples.
    """

    fit: StructuredFit
    changed: bool
    log_odds: float


@torch.no_grad()
def follow(
    model: StructuredGP, data: Dataset, priors: Sequence[str], *, factor: float = 1.0, change: float = CHANGE
) -> Followed:
    """Add samples to the most recent fit, and learn the forces of some priors anew where these contradict it.

    Args:
        model: fitted with sparse inference.
        data: a few new samples, such as those of 0.05 s.
        priors: names of the priors whose forces may change, such as `payload`.
        factor: correlation of these forces with what they were at the last call, for slow drift beside.
        change: prior probability of a change between two calls.

    Raises:
        ModelError: the model has not been fitted, its inference is exact, or a number is out of range.
        UnknownNameError: no such prior.
    """
    if not 0.0 < change < 1.0:
        raise ModelError("invalid probability of a change", expected="between 0 and 1", got=change)
    before = model.forget(factor, priors=priors)
    kept = model.update(data)
    model.adopt(before)
    forgotten = model.forget(0.0, priors=priors)
    anew = model.update(data)
    gain = _evidence(anew) - _evidence(forgotten) - (_evidence(kept) - _evidence(before))
    log_odds = gain + math.log(change) - math.log1p(-change)
    changed = log_odds > 0.0
    return Followed(model.adopt(anew if changed else kept), changed, log_odds)


def _evidence(fit: StructuredFit) -> float:
    """log p of the rows, up to what both hypotheses share."""
    latent = fit.posterior.latent
    assert isinstance(latent, SparsePosterior)
    return -float(bound_of(latent.moments, latent))
