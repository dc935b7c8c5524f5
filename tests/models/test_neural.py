"""The network against its formula and its derivatives, and what it learns."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError
from forcegp.models import NeuralNetwork
from forcegp.models.minibatch import BatchOptions, train
from forcegp.models.neural import NetworkFit
from random_data import random_data, table_system

ROUNDING = 1e-12
"""Relative: the same products in the same order."""
FEW = BatchOptions(epochs=3, batch=32)

system = table_system()
data = random_data(system, 200)
test = random_data(system, 20, seed=1)


@pytest.fixture(scope="module")
def model() -> NetworkFit:
    return NeuralNetwork(system, (30, 20)).fit(data, options=FEW)


def by_hand(model: NetworkFit, x: Tensor) -> Tensor:
    """Sigmoid layers and a linear one, on standardized inputs and outputs."""
    inputs = torch.cat([data.q, data.qd, data.tau], dim=-1)
    h = (x - inputs.mean(0)) / inputs.std(0, correction=0)
    weights = list(model.network.parameters())
    for W, b in zip(weights[:-2:2], weights[1:-2:2], strict=True):
        h = 1.0 / (1.0 + torch.exp(-(h @ W.mT + b)))
    y = h @ weights[-2].mT + weights[-1]
    return y * data.qdd.std(0, correction=0) + data.qdd.mean(0)


def test_prediction_is_the_formula(model: NetworkFit) -> None:
    x = torch.cat([test.q, test.qd, test.tau], dim=-1)
    predicted = model.predict(test.q, test.qd, test.tau)
    torch.testing.assert_close(predicted.mean, by_hand(model, x), rtol=1e-10, atol=1e-10)
    assert predicted.covariance is None and predicted.mean.dtype == torch.float64
    shaped = model.predict(test.q.reshape(4, 5, 7), test.qd.reshape(4, 5, 7), test.tau.reshape(4, 5, 7))
    torch.testing.assert_close(shaped.mean.reshape(20, 7), predicted.mean, rtol=ROUNDING, atol=ROUNDING)
    assert model.predict(test.q[:0], test.qd[:0], test.tau[:0]).mean.shape == (0, 7)


def test_derivatives_of_the_network_match_differences(model: NetworkFit) -> None:
    x = torch.randn(3, 21, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(model.network, (x.requires_grad_(),))


@pytest.mark.parametrize("hidden", [(80,), (30, 20), (200, 200, 200, 200)], ids=str)
def test_the_networks_of_the_paper_learn(hidden: tuple[int, ...]) -> None:
    # Four layers of 200 units move slowly in the few steps of a test.
    options = BatchOptions(epochs=25, batch=20, learning_rate=0.005)
    fit = NeuralNetwork(system, hidden).fit(data, options=options)
    assert fit.result.evaluations == len(fit.result.history) == 25
    assert fit.result.objective == min(fit.result.history) < 0.9 * fit.result.history[0]
    widths = [layer.out_features for layer in fit.network if isinstance(layer, torch.nn.Linear)]
    assert widths == [*hidden, 7]


def test_the_seed_decides_and_nothing_else() -> None:
    def weights(seed: int) -> Tensor:
        fit = NeuralNetwork(system, seed=seed).fit(data, options=FEW)
        return next(fit.network.parameters()).detach()

    first = weights(0)
    torch.rand(5)
    assert torch.equal(first, weights(0))
    assert not torch.equal(first, weights(1))


def quadratic(tensors: object, rows: Tensor) -> Tensor:
    return ((tensors["x"] - 3.0) ** 2).sum() + 0.0 * rows.sum()  # type: ignore[index]


def test_training_stops_early_and_keeps_the_best_epoch() -> None:
    start = {"x": torch.tensor([0.0], dtype=torch.float64)}
    generator = torch.Generator().manual_seed(0)
    calls: list[tuple[int, int]] = []
    options = BatchOptions(epochs=1000, batch=50, learning_rate=0.5, patience=10)
    learned = train(
        quadratic, start, 100, options, generator, lambda done, most, _: calls.append((done, most))
    )
    assert learned.converged and learned.evaluations == len(calls) < 1000
    assert calls[-1] == (learned.evaluations, 1000)
    assert learned.value == min(learned.history)
    assert learned.value == pytest.approx(float((learned.tensors["x"] - 3.0) ** 2), abs=1e-15)
    assert len(learned.history) - 10 == 1 + learned.history.index(learned.value)


def test_held_out_samples_are_not_trained_on() -> None:
    seen: set[int] = set()

    def loss(tensors: object, rows: Tensor) -> Tensor:
        if torch.is_grad_enabled():
            seen.update(rows.tolist())
        return quadratic(tensors, rows)

    start = {"x": torch.zeros(1, dtype=torch.float64)}
    train(loss, start, 50, BatchOptions(epochs=2, batch=7, held_out=0.2), torch.Generator().manual_seed(0))
    assert len(seen) == 40


def test_wrong_use_is_refused(model: NetworkFit) -> None:
    with pytest.raises(ModelError, match="at least one unit"):
        NeuralNetwork(system, (80, 0))
    with pytest.raises(ModelError, match="predicts only accelerations"):
        model.predict(test.q, test.qd, test.tau, "joint_force")
    with pytest.raises(ModelError, match="too few samples"):
        NeuralNetwork(system).fit(data[:1])
    nan = {"x": torch.full((1,), float("inf"), dtype=torch.float64)}
    with pytest.raises(NumericalError, match="diverged in epoch 1"):
        train(quadratic, nan, 10, FEW, torch.Generator().manual_seed(0))
