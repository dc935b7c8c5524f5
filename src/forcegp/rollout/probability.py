"""The probability that contact is lost at a state, from the posterior over the multiplier."""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.rollout.law import ForwardModel


def contact_loss_probability(
    model: ForwardModel, q: Tensor, qd: Tensor, tau: Tensor, *, active: Tensor | None = None
) -> Tensor:
    """Probability that a contact would have to pull at a state, and therefore opens.

    P(λ < 0) = Φ(−μ/σ) of the multiplier's posterior N(μ, σ²). A contact that is open is lost already: its
    probability is 1.

    Args:
        model: a model with a posterior over forces.
        q, qd, tau: `(*batch, nq)` states.
        active: `(*batch, n_contacts)` bool, closed contacts; default all.

    Returns:
        `(*batch, m)`, between 0 and 1.

    Raises:
        ModelError: the model gives no variance of the multiplier.
    """
    found = model.predict(q, qd, tau, "multiplier", active=active, covariance=True)
    if found.std is None:
        raise ModelError(
            f"a {model.kind!r} model gives no uncertainty of the multiplier",
            hint="use StructuredGP, or compare the predicted multiplier with zero",
        )
    certain = found.std == 0.0
    probability = torch.special.ndtr(-found.mean / torch.where(certain, 1.0, found.std))
    probability = torch.where(certain, (found.mean < 0.0).to(probability.dtype), probability)
    closed = model.system.active_rows(active, found.mean.shape[:-1])
    return torch.where(closed, probability, 1.0)
