"""Jacobians of the posterior mean are those of central differences of what is predicted."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError
from forcegp.forces.priors.sets import friction_priors
from forcegp.models.base import FittedModel
from forces.cases import draw, logged, mixed_contacts, two_contacts

STEP = 1e-5
"""Of central differences: their error is about STEP² and 1e-16/STEP of the values."""
DIFFERENCES = 1e-5
"""Agreement relative to the largest entry of a Jacobian."""
STATES = 6


def central_differences(fit: FittedModel, quantity: str, state: list[Tensor], active: Tensor) -> list[Tensor]:
    """Jacobians by each of q, q̇ and τ, `(n, d, nq)`."""

    def mean(q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        return fit.predict(q, qd, tau, quantity, active=active, covariance=False).mean

    found = []
    for k in range(3):
        columns = []
        for j in range(state[k].shape[-1]):
            step = torch.zeros_like(state[k])
            step[:, j] = STEP
            ahead, behind = ([*state[:k], state[k] + sign * step, *state[k + 1 :]] for sign in (1.0, -1.0))
            columns.append((mean(*ahead) - mean(*behind)) / (2.0 * STEP))
        found.append(torch.stack(columns, dim=-1))
    return found


@pytest.mark.parametrize("kind", ["zero", "measured", "sparse", "analytical"])
def test_jacobians_are_central_differences(kind: str) -> None:
    system, active = two_contacts(), mixed_contacts(STATES)
    data = logged(system, 30)
    if kind == "analytical":
        fit = forcegp.AnalyticalModel(system).nominal()
    elif kind == "measured":
        priors = friction_priors(system)
        fit = forcegp.StructuredGP(system, "analytical", priors, 0.1).fit(data, learn=[])
    else:
        inference = "sparse" if kind == "sparse" else "exact"
        fit = forcegp.StructuredGP(system, "zero", noise=0.1, inference=inference).fit(data, learn=[])
    q, qd, tau = draw(STATES, 7)
    at = fit.linearize(q, qd, tau, active=active)
    assert torch.allclose(at.qdd, fit.predict(q, qd, tau, active=active, covariance=False).mean)
    for quantity, jacobians in (("qdd", at[1:4]), ("multiplier", at[5:8])):
        for got, expected in zip(
            jacobians, central_differences(fit, quantity, [q, qd, tau], active), strict=True
        ):
            assert float((got - expected).abs().max()) < DIFFERENCES * float(expected.abs().max())


def test_batches_keep_their_shape_and_models_without_forces_are_refused() -> None:
    system = two_contacts()
    q, qd, tau = (x.reshape(2, 3, 7) for x in draw(6, 1))
    at = forcegp.AnalyticalModel(system).nominal().linearize(q, qd, tau)
    assert at.dq.shape == (2, 3, 7, 7)
    assert at.multiplier_dtau.shape == (2, 3, 2, 7)
    network = forcegp.models.NeuralNetwork(system, hidden=[4]).fit(logged(system, 20))
    with pytest.raises(ModelError, match="no force field to linearize"):
        network.linearize(q, qd, tau)
