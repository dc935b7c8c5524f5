"""The probability that contact is lost at a state, from the posterior over the multiplier."""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.models.base import Model


def contact_loss_probability(
    model: Model, q: Tensor, qd: Tensor, tau: Tensor, *, active: Tensor | None = None
) -> Tensor:
    """P(λ < 0) = Φ(−μ/σ) of the multiplier's posterior N(μ, σ²) at states, `(*batch, m)`.

    A contact that would have to pull opens, so this is the probability that it does not hold at the state.

    Args:
        model: a model with a posterior over forces.
        q, qd, tau: `(*batch, nq)` states.
        active: `(*batch, n_contacts)` bool, closed contacts; default all.

    Raises:
        ModelError: the model gives no variance of the multiplier.
    """
    found = model.predict(q, qd, tau, "multiplier", active=active, covariance=True)
    if found.std is None:
        raise ModelError(
            f"a {model.kind!r} model gives no uncertainty of the multiplier",
            hint="use StructuredGP, or compare the predicted multiplier with zero",
        )
    return torch.special.ndtr(-found.mean / found.std)
