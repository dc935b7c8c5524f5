"""The collapsed bound against dense formulas and the exact likelihood, and the likelihood of weights."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from forcegp.gp.features import Block
from forcegp.gp.kernels import Constant, Linear
from forcegp.gp.likelihood import negative_log_likelihood, negative_log_likelihood_of_weights
from gp.sparse_cases import PROCESSES, Named, condition_sparse, first, parameters, rows, textbook

FINITE = (
    Named(Linear(("qd",), shared=True) * Linear(("q",)) + Linear(("qd",)), "joint"),
    Named(Constant(), "contact"),
)
"""Processes that are a finite number of features."""
DIFFERENCES = 1e-6
"""Central differences with a step of 10⁻⁵ err by about 10⁻⁸ of the value's scale of a few hundred."""


def bound(params: dict[str, Tensor], blocks: list[Block], Z: list[dict[str, Tensor]]) -> float:
    """The negative bound of `PROCESSES`."""
    return -condition_sparse(PROCESSES, params, blocks, Z).log_likelihood


def test_value_is_the_textbook_bound() -> None:
    blocks, Z, params = [rows(30), rows(21, r=2, seed=1)], first(rows(12, seed=5), 12), parameters()
    dense = textbook(blocks, Z, params).negative_bound()
    assert bound(params, blocks, Z) == pytest.approx(dense, rel=1e-9)


def test_equals_the_exact_likelihood_where_inducing_points_are_the_data() -> None:
    block, params = rows(25), parameters()
    exact = float(negative_log_likelihood(PROCESSES, params, [block]))
    sparse = bound(params, [block], list(block.features))
    assert sparse == pytest.approx(exact, abs=1e-6)
    assert sparse > exact - 1e-6


def test_components_may_have_inputs_of_their_own() -> None:
    block, params = rows(15), parameters()
    generator = torch.Generator().manual_seed(4)
    own = torch.randn(15, 2, 2, generator=generator, dtype=torch.float64)
    features = ({**block.features[0], "q": own}, block.features[1])
    block = Block(features, block.operators, block.target)
    exact = negative_log_likelihood(PROCESSES, params, [block])
    assert bound(params, [block], list(block.features)) == pytest.approx(float(exact), abs=1e-6)


def test_bound_falls_as_points_are_added() -> None:
    block, params = rows(40), parameters()
    values = [bound(params, [block], first(block, m)) for m in (4, 8, 16, 32)]
    exact = negative_log_likelihood(PROCESSES, params, [block])
    assert values == sorted(values, reverse=True)
    assert values[-1] > float(exact)


def test_a_block_may_be_empty() -> None:
    block, params = rows(12), parameters()
    empty = dataclasses.replace(rows(3), target=rows(3).target[:0])
    empty = Block(
        tuple({k: x[:0] for k, x in f.items()} for f in empty.features),
        tuple(W[:0] for W in empty.operators),
        empty.target,
    )
    Z = first(block, 5)
    assert bound(params, [block, empty], Z) == pytest.approx(bound(params, [block], Z), rel=1e-12)
    params = parameters(FINITE)
    whole, own = (
        negative_log_likelihood_of_weights(FINITE, params, each) for each in ([block, empty], [block])
    )
    assert float(whole) == pytest.approx(float(own), rel=1e-12)


def test_weights_have_the_exact_likelihood_and_gradient() -> None:
    """In hyperparameters, kernel inputs, operators and targets, by two closed forms that share no formula."""
    blocks, params = [rows(20), rows(7, r=2, seed=1)], parameters(FINITE)
    leaves = {key: x.clone().requires_grad_() for key, x in params.items()}
    moved, inputs = [], list(leaves.values())
    for block in blocks:
        features = tuple({k: x.clone().requires_grad_() for k, x in f.items()} for f in block.features)
        operators = tuple(W.clone().requires_grad_() for W in block.operators)
        moved.append(Block(features, operators, block.target.clone().requires_grad_()))
        # The constant reads no input.
        inputs += [*features[0].values(), *operators, moved[-1].target]
    of_weights = negative_log_likelihood_of_weights(FINITE, leaves, moved)
    exact = negative_log_likelihood(FINITE, leaves, moved)
    assert float(of_weights.detach()) == pytest.approx(float(exact.detach()), rel=1e-12)
    pairs = zip(torch.autograd.grad(of_weights, inputs), torch.autograd.grad(exact, inputs), strict=True)
    for one, other in pairs:
        assert torch.allclose(one, other, rtol=1e-8, atol=1e-8)


def differences(value, tensors: dict, place: object, step: float = 1e-5) -> Tensor:
    """Central differences along one tensor."""
    x = tensors[place]
    result = torch.zeros_like(x)
    for i in range(x.numel()):
        ends = []
        for sign in (1.0, -1.0):
            moved = x.clone()
            moved.view(-1)[i] += sign * step
            ends.append(float(value({**tensors, place: moved})))
        result.view(-1)[i] = (ends[0] - ends[1]) / (2.0 * step)
    return result


@pytest.mark.parametrize("of", [negative_log_likelihood_of_weights, negative_log_likelihood])
def test_gradient_in_hyperparameters_is_central_differences(of) -> None:
    blocks, params = [rows(9), rows(5, r=2, seed=1)], parameters(FINITE)
    leaves = {k: v.clone().requires_grad_() for k, v in params.items()}
    gradients = torch.autograd.grad(of(FINITE, leaves, blocks), list(leaves.values()))
    for (key, _), gradient in zip(leaves.items(), gradients, strict=True):
        expected = differences(lambda p: of(FINITE, p, blocks), params, key)
        scale = max(1.0, float(expected.abs().max()))
        assert float((gradient - expected).abs().max()) < DIFFERENCES * scale, key


@pytest.mark.parametrize("of", [negative_log_likelihood_of_weights, negative_log_likelihood])
def test_gradient_in_operators_inputs_and_targets_is_central_differences(of) -> None:
    block, params = rows(2), parameters(FINITE)
    tensors = {("W", p): W for p, W in enumerate(block.operators)} | {"y": block.target}
    tensors |= {("x", 0, name): x for name, x in block.features[0].items()}

    def value(t: dict) -> Tensor:
        features = ({name: t["x", 0, name] for name in block.features[0]}, block.features[1])
        return of(FINITE, params, [Block(features, (t["W", 0], t["W", 1]), t["y"])])

    leaves = {k: v.clone().requires_grad_() for k, v in tensors.items()}
    gradients = torch.autograd.grad(value(leaves), list(leaves.values()))
    for (place, _), gradient in zip(leaves.items(), gradients, strict=True):
        expected = differences(value, tensors, place)
        scale = max(1.0, float(expected.abs().max()))
        assert float((gradient - expected).abs().max()) < DIFFERENCES * scale, place
