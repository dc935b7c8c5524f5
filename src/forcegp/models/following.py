"""Tracking of forces that change abruptly, such as the force due to a payload that is picked up.

Exponential forgetting discards the payload estimate while the arm is at rest, and it is slow to detect a new
payload. Earlier samples are therefore forgotten only if new samples D satisfy

    p(D | payload drawn again from its prior) · p(change) > p(D | payload unchanged).

Both densities are marginal likelihoods, computed from the posterior before and after the update.

The force caused by a payload is accurate to first order around the known payload in its prior. After a
change, the prior is linearized around the current estimate, as in an extended Kalman filter.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.models.structured_fit import StructuredFit

CHANGE = 1e-3
"""Prior probability that a force changes between two calls."""


@dataclass(frozen=True)
class Followed:
    """Result of `follow`.

    Attributes:
        fit: the fit that includes the new samples.
        changed: whether a change was detected and the forces were relearned.
        log_odds: log odds of a change, given the new samples.
    """

    fit: StructuredFit
    changed: bool
    log_odds: float


@torch.no_grad()
def follow(
    fit: StructuredFit, data: Dataset, priors: Sequence[str], *, factor: float = 1.0, change: float = CHANGE
) -> Followed:
    """Add samples to a fit, and relearn the forces of the given priors if the samples contradict them.

    Args:
        fit: a fit with sparse inference.
        data: a few new samples, for example over 0.05 s.
        priors: names of the priors whose forces may change, such as `payload`.
        factor: correlation of these forces with those at the previous call. A factor below 1 allows for
            drift.
        change: prior probability of a change between two calls.

    Raises:
        ModelError: inference is exact, or a number is out of range.
        UnknownNameError: a prior does not exist.
    """
    if not 0.0 < change < 1.0:
        raise ModelError("invalid probability of a change", expected="between 0 and 1", got=change)
    aged = fit.forget(factor, priors=priors)
    continued = aged.update(data)
    forgotten = aged.forget(0.0, priors=priors)
    restarted = forgotten.update(data)
    # log p of the rows, up to terms common to both hypotheses
    evidence = [fit.posterior.latent.log_likelihood for fit in (restarted, forgotten, continued, aged)]
    gain = evidence[0] - evidence[1] - (evidence[2] - evidence[3])
    log_odds = gain + math.log(change) - math.log1p(-change)
    changed = log_odds > 0.0
    if changed:
        # The first estimate assumes accelerations without the new payload, so it is repeated.
        restarted = _knowing(forgotten, restarted, priors).update(data)
    result = restarted if changed else continued
    return Followed(_knowing(result, result, priors, begin=changed), changed, log_odds)


def _knowing(
    fit: StructuredFit, estimate: StructuredFit, priors: Sequence[str], begin: bool = True
) -> StructuredFit:
    """Linearize payload priors of a fit around an estimate, if they have a known payload or if `begin`."""
    one = {"one": torch.zeros(1, 1, dtype=torch.float64)}
    updated_priors = tuple(
        prior.around(estimate.posterior.latent.latent_mean(p, one)[0])
        if isinstance(prior, PayloadPrior) and prior.name in priors and (begin or prior.known)
        else prior
        for p, prior in enumerate(fit.posterior.priors)
    )
    process = dataclasses.replace(fit.posterior.process, priors=updated_priors)
    return dataclasses.replace(
        fit,
        specification=dataclasses.replace(fit.specification, priors=updated_priors),
        problem=dataclasses.replace(fit.problem, priors=updated_priors),
        posterior=dataclasses.replace(fit.posterior, process=process),
    )
