"""Independent GPs against the textbook formula, written down here for one output at a time."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from forcegp import Noise
from forcegp.errors import DataError, ModelError, ShapeError
from forcegp.gp.likelihood import negative_log_likelihood
from forcegp.gp.optimise import LearningOptions
from forcegp.models import IndependentGP
from forcegp.models.independent_gp import IndependentFit
from random_data import NOISE_STD, random_data, table_system

ROUNDING = 1e-9
"""Relative: two ways through a well-conditioned factorisation of some 60 rows."""
GRADIENT = 1e-7
"""Relative: closed form against autograd through the factorisation."""
FEW = LearningOptions(max_evaluations=15)

system = table_system()
data = random_data(system, 60)
test = random_data(system, 25, seed=1)


@pytest.fixture(scope="module")
def model() -> IndependentFit:
    return IndependentGP(system, noise=NOISE_STD).fit(data, options=FEW)


def standardized(x: Tensor) -> Tensor:
    inputs = torch.cat([data.q, data.qd, data.tau], dim=-1)
    return (x - inputs.mean(0)) / inputs.std(0, correction=0)


def textbook_kernel(x1: Tensor, x2: Tensor, log_lengthscale: Tensor, log_std: Tensor) -> Tensor:
    difference = (x1[:, None] - x2[None]) / log_lengthscale.exp()
    return torch.exp(2.0 * log_std) * torch.exp(-0.5 * (difference**2).sum(-1))


def textbook(model: IndependentFit, joint: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, variance and negative log likelihood by dense solves."""
    X = standardized(torch.cat([data.q, data.qd, data.tau], dim=-1))
    X_test = standardized(torch.cat([test.q, test.qd, test.tau], dim=-1))
    lengthscale = model.hyperparameters[f"qdd_{joint}.log_lengthscale"][0]
    std = model.hyperparameters[f"qdd_{joint}.log_std"][0]
    K = textbook_kernel(X, X, lengthscale, std) + NOISE_STD**2 * torch.eye(len(data), dtype=torch.float64)
    k = textbook_kernel(X_test, X, lengthscale, std)
    y = data.qdd[:, joint]
    mean = k @ torch.linalg.solve(K, y)
    variance = torch.exp(2.0 * std) - (k * torch.linalg.solve(K, k.mT).mT).sum(-1)
    nll = 0.5 * (y @ torch.linalg.solve(K, y) + torch.logdet(K) + len(y) * math.log(2.0 * math.pi))
    return mean, variance, nll


def test_posterior_is_the_textbook_one(model: IndependentFit) -> None:
    predicted = model.predict(test.q, test.qd, test.tau)
    assert predicted.covariance is not None and predicted.variance is not None
    for joint in range(7):
        mean, variance, _ = textbook(model, joint)
        torch.testing.assert_close(predicted.mean[:, joint], mean, rtol=ROUNDING, atol=ROUNDING)
        torch.testing.assert_close(predicted.variance[:, joint], variance, rtol=ROUNDING, atol=ROUNDING)
    off_diagonal = predicted.covariance - torch.diag_embed(predicted.variance)
    assert float(off_diagonal.abs().max()) == 0.0


def test_likelihood_is_the_textbook_one(model: IndependentFit) -> None:
    expected = -sum(float(textbook(model, joint)[2]) for joint in range(7))
    assert model.result.log_marginal_likelihood == pytest.approx(expected, rel=ROUNDING)


def test_gradient_is_that_of_the_textbook_formula(model: IndependentFit) -> None:
    X = standardized(torch.cat([data.q, data.qd, data.tau], dim=-1))
    names = ("log_lengthscale", "log_std")
    leaves = {n: model.hyperparameters[f"qdd_2.{n}"].clone().requires_grad_() for n in names}
    K = textbook_kernel(X, X, leaves["log_lengthscale"][0], leaves["log_std"][0])
    K = K + NOISE_STD**2 * torch.eye(len(data), dtype=torch.float64)
    y = data.qdd[:, 2]
    dense = 0.5 * (y @ torch.linalg.solve(K, y) + torch.logdet(K))
    expected = torch.autograd.grad(dense, list(leaves.values()))

    own = {f"qdd_2.{n}": leaves[n] for n in names}
    prior, block, _ = model.training.processes()[2]
    value = negative_log_likelihood([prior], own, [block])
    for got, wanted in zip(torch.autograd.grad(value, list(leaves.values())), expected, strict=True):
        torch.testing.assert_close(got, wanted, rtol=GRADIENT, atol=GRADIENT * float(wanted.abs().max()))


def test_it_has_154_hyperparameters_and_learning_raises_the_likelihood(model: IndependentFit) -> None:
    assert sum(value.numel() for value in model.hyperparameters.values()) == 154
    start = IndependentGP(system, noise=NOISE_STD).fit(data, options=LearningOptions(max_evaluations=1))
    assert model.result.log_marginal_likelihood > start.result.log_marginal_likelihood + 10.0


def test_the_fit_reports_all_joints() -> None:
    calls: list[tuple[int, int]] = []
    result = IndependentGP(system).fit(
        data,
        options=LearningOptions(max_evaluations=2),
        progress=lambda done, most, _: calls.append((done, most)),
    )
    assert calls[-1][0] == result.result.evaluations == len(result.result.history) == len(calls)
    assert calls[-1][1] == 7 * 2
    assert not result.result.converged
    assert result.result.jitter == 0.0


def test_batches_of_any_shape_and_chunks_agree(
    model: IndependentFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = model.predict(test.q, test.qd, test.tau)
    shaped = model.predict(test.q.reshape(5, 5, 7), test.qd.reshape(5, 5, 7), test.tau.reshape(5, 5, 7))
    assert shaped.covariance is not None and whole.covariance is not None
    torch.testing.assert_close(shaped.mean.reshape(25, 7), whole.mean, rtol=ROUNDING, atol=ROUNDING)
    monkeypatch.setattr("forcegp.models.prediction.CHUNK", 4)
    parts = model.predict(test.q, test.qd, test.tau)
    assert parts.covariance is not None
    torch.testing.assert_close(parts.mean, whole.mean, rtol=ROUNDING, atol=ROUNDING)
    torch.testing.assert_close(parts.covariance, whole.covariance, rtol=ROUNDING, atol=ROUNDING)
    assert model.predict(test.q[0], test.qd[0], test.tau[0], covariance=False).mean.shape == (7,)
    assert model.predict(test.q[:0], test.qd[:0], test.tau[:0]).mean.shape == (0, 7)


def test_wrong_use_is_refused(model: IndependentFit) -> None:
    with pytest.raises(ModelError, match="only white acceleration noise"):
        IndependentGP(system, noise=Noise(0.1, torque="learn"))
    with pytest.raises(ModelError, match="predicts only accelerations"):
        model.predict(test.q, test.qd, test.tau, "multiplier")
    with pytest.raises(ShapeError, match="qd has the wrong shape"):
        model.predict(test.q, test.qd[:, :6], test.tau)
    with pytest.raises(ModelError, match="must be positive"):
        IndependentGP(system, noise=0.0).fit(data)
    with pytest.raises(DataError, match="joint"):
        IndependentGP(system).fit(data.select(tuple(reversed(data.joint_names))))
