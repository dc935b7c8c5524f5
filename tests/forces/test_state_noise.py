"""Noise of the measured state in the likelihood, against the dense formula with numerical derivatives."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError
from forcegp.forces.measurements import Measurement
from forcegp.forces.noise import state_jacobian
from forces.cases import draw, logged, mixed_contacts, two_contacts
from forces.textbook import Textbook

Q_STD, QD_STD, STEP = 2e-3, 0.02, 1e-6
LIKELIHOOD = 1e-6
"""Relative agreement of likelihoods with closed-form and central-difference Jacobians."""


def jacobian(system: forcegp.ConstrainedSystem, m: Measurement) -> Tensor:
    """∂z/∂(q, q̇) by central differences of the equations of motion."""

    def value(q: Tensor, qd: Tensor) -> Tensor:
        eom = system.equations(q, qd, m.active)
        Q = eom.Q_K + m.tau
        return eom.acceleration(Q) if m.quantity == "qdd" else eom.multiplier(Q)

    columns = []
    for axis in torch.eye(7, dtype=torch.float64) * STEP:
        columns.append((value(m.q + axis, m.qd) - value(m.q - axis, m.qd)) / (2.0 * STEP))
    for axis in torch.eye(7, dtype=torch.float64) * STEP:
        columns.append((value(m.q, m.qd + axis) - value(m.q, m.qd - axis)) / (2.0 * STEP))
    return torch.stack(columns, -1)


@pytest.mark.parametrize("quantity", ["qdd", "multiplier"])
def test_jacobian(quantity: str) -> None:
    system, states = two_contacts(), draw(6)
    m = Measurement(quantity, *states, mixed_contacts(6), torch.zeros(6, 7 if quantity == "qdd" else 2))
    found = state_jacobian(system, m)
    assert found is not None
    torch.testing.assert_close(found, jacobian(system, m), rtol=1e-4, atol=1e-3)


def test_other_quantities_have_no_state_noise() -> None:
    m = Measurement("joint_force", *draw(2), mixed_contacts(2), torch.zeros(2, 7))
    assert state_jacobian(two_contacts(), m) is None


def model(state: object = None) -> forcegp.StructuredGP:
    noise = forcegp.Noise(0.1, state=state)  # type: ignore[arg-type]
    return forcegp.StructuredGP(two_contacts(), "analytical", [forcegp.priors.JointForcePrior()], noise)


def test_likelihood_with_state_noise_is_the_dense_one() -> None:
    fit = model((Q_STD, QD_STD)).fit(logged(two_contacts(), 8), learn=[])
    y, noise, maps = (book := Textbook(fit)).data()
    std = torch.cat([torch.full((7,), Q_STD), torch.full((7,), QD_STD)]).double()
    G = jacobian(fit.system, fit.training.measurements[0]) * std
    K = book.gram(maps) + torch.diag(noise) + torch.block_diag(*(G @ G.mT))
    L = torch.linalg.cholesky(K)
    alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
    dense = -float(0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi))
    assert fit.result.log_marginal_likelihood == pytest.approx(dense, rel=LIKELIHOOD)


def test_no_state_noise_is_the_projected_likelihood() -> None:
    data = logged(two_contacts(), 8)
    without, zero = model().fit(data, learn=[]), model((0.0, 0.0)).fit(data, learn=[])
    assert zero.result.log_marginal_likelihood == pytest.approx(
        without.result.log_marginal_likelihood, rel=1e-9
    )


@pytest.mark.slow
def test_noisy_states_are_learned_from(tmp_path: Path) -> None:
    system, generator = two_contacts(), torch.Generator().manual_seed(2)
    clean, test = logged(system, 80), logged(system, 40, seed=5)
    dq, dqd = (torch.randn(80, 7, generator=generator, dtype=torch.float64) for _ in range(2))
    noisy = clean.replace(q=clean.q + Q_STD * dq, qd=clean.qd + QD_STD * dqd)
    truth = system.equations(test.q, test.qd, mixed_contacts(40)).acceleration(test.Q + test.Q_z)
    errors = []
    for state_noise in (None, (Q_STD, QD_STD)):
        fit = model(state_noise).fit(noisy)
        read = fit.predict(test.q, test.qd, test.tau, active=mixed_contacts(40))
        errors.append(float((read.mean - truth).abs().mean()))
    assert errors[1] < 0.7 * errors[0]
    fit.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model").predict(
        test.q, test.qd, test.tau, active=mixed_contacts(40)
    )
    assert torch.equal(read.mean, again.mean)
    assert read.variance is not None and again.variance is not None
    assert torch.equal(read.variance, again.variance)


@pytest.mark.parametrize("given", [(0.1, -0.1), ((0.1, 0.2), 0.1), (math.nan, 0.0)])
def test_state_noise_that_is_not_valid(given: object) -> None:
    with pytest.raises(ModelError, match="noise of the state"):
        model(given)
