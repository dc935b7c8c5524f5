"""The collapsed bound against dense formulas, the exact likelihood and finite differences."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from forcegp.gp.basis import latent_basis
from forcegp.gp.features import Block
from forcegp.gp.likelihood import negative_bound, negative_log_likelihood
from gp.sparse_cases import PROCESSES, first, parameters, rows, textbook

DIFFERENCES = 1e-6
"""Central differences with a step of 10⁻⁵ err by about 10⁻⁸ of the value's scale of a few hundred."""


def test_value_is_the_textbook_bound() -> None:
    blocks, Z, params = [rows(30), rows(21, r=2, seed=1)], first(rows(12, seed=5), 12), parameters()
    dense = textbook(blocks, Z, params).negative_bound()
    assert float(negative_bound(PROCESSES, params, blocks, Z)) == pytest.approx(dense, rel=1e-9)


def test_equals_the_exact_likelihood_where_inducing_points_are_the_data() -> None:
    block, params = rows(25), parameters()
    exact = negative_log_likelihood(PROCESSES, params, [block])
    leaves = {k: v.clone().requires_grad_() for k, v in params.items()}
    sparse = negative_bound(PROCESSES, leaves, [block], list(block.features))
    assert float(sparse.detach()) == pytest.approx(float(exact), abs=1e-6)
    assert float(sparse.detach()) > float(exact) - 1e-6


def test_gradient_equals_the_exact_one_where_inducing_points_are_the_data() -> None:
    """In hyperparameters, operators and targets, by two closed forms that share no formula."""
    block, params = rows(20), parameters()
    leaves = [x.clone().requires_grad_() for x in (*params.values(), *block.operators, block.target)]
    moved = Block(block.features, tuple(leaves[-3:-1]), leaves[-1])
    named = dict(zip(params, leaves, strict=False))
    sparse = negative_bound(PROCESSES, named, [moved], list(block.features))
    exact = negative_log_likelihood(PROCESSES, named, [moved])
    pairs = zip(torch.autograd.grad(sparse, leaves), torch.autograd.grad(exact, leaves), strict=True)
    for one, other in pairs:
        assert torch.allclose(one, other, rtol=1e-8, atol=1e-8)


def test_components_may_have_inputs_of_their_own() -> None:
    block, params = rows(15), parameters()
    generator = torch.Generator().manual_seed(4)
    own = torch.randn(15, 2, 2, generator=generator, dtype=torch.float64)
    features = ({**block.features[0], "q": own}, block.features[1])
    block = Block(features, block.operators, block.target)
    exact = negative_log_likelihood(PROCESSES, params, [block])
    sparse = negative_bound(PROCESSES, params, [block], list(block.features))
    assert float(sparse) == pytest.approx(float(exact), abs=1e-6)


def test_bound_falls_as_points_are_added() -> None:
    block, params = rows(40), parameters()
    values = [float(negative_bound(PROCESSES, params, [block], first(block, m))) for m in (4, 8, 16, 32)]
    exact = negative_log_likelihood(PROCESSES, params, [block])
    assert values == sorted(values, reverse=True)
    assert values[-1] > float(exact)


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


def test_gradient_in_hyperparameters_is_central_differences() -> None:
    blocks, Z, params = [rows(9), rows(5, r=2, seed=1)], first(rows(6, seed=5), 6), parameters()
    leaves = {k: v.clone().requires_grad_() for k, v in params.items()}
    value = negative_bound(PROCESSES, leaves, blocks, Z)
    gradients = torch.autograd.grad(value, list(leaves.values()))
    for (key, _), gradient in zip(leaves.items(), gradients, strict=True):
        expected = differences(lambda p: negative_bound(PROCESSES, p, blocks, Z), params, key)
        scale = max(1.0, float(expected.abs().max()))
        assert float((gradient - expected).abs().max()) < DIFFERENCES * scale, key


def test_gradient_in_operators_inputs_and_targets_is_central_differences() -> None:
    block, Z, params = rows(2), first(rows(4, seed=5), 4), parameters()
    tensors = {("W", p): W for p, W in enumerate(block.operators)} | {"y": block.target}
    tensors |= {("x", p, name): x for p, f in enumerate(block.features) for name, x in f.items()}

    def value(t: dict) -> Tensor:
        features = tuple({name: t["x", p, name] for name in f} for p, f in enumerate(block.features))
        moved = Block(features, (t["W", 0], t["W", 1]), t["y"])
        return negative_bound(PROCESSES, params, [moved], Z)

    leaves = {k: v.clone().requires_grad_() for k, v in tensors.items()}
    gradients = torch.autograd.grad(value(leaves), list(leaves.values()))
    for (place, _), gradient in zip(leaves.items(), gradients, strict=True):
        expected = differences(value, tensors, place)
        scale = max(1.0, float(expected.abs().max()))
        assert float((gradient - expected).abs().max()) < DIFFERENCES * scale, place


def test_gradient_through_dropped_directions_is_exact() -> None:
    """Two pairs of inducing points nearly coincide, so that directions fall below the truncation."""
    block, params = rows(12), parameters()
    Z = [{k: torch.cat([x[:6], x[:2] + 1e-7]) for k, x in f.items()} for f in first(rows(8, seed=5), 8)]
    basis = latent_basis(PROCESSES, params, Z, (2, 1))
    assert any(s.dropped for part in basis.parts for s in part.spectra)
    leaves = {k: v.clone().requires_grad_() for k, v in params.items()}
    value = negative_bound(PROCESSES, leaves, [block], Z)
    gradients = torch.autograd.grad(value, list(leaves.values()))
    for (key, _), gradient in zip(leaves.items(), gradients, strict=True):
        expected = differences(lambda p: negative_bound(PROCESSES, p, [block], Z), params, key, 1e-5)
        scale = max(1.0, float(expected.abs().max()))
        assert float((gradient - expected).abs().max()) < 1e-5 * scale, key


def test_a_block_may_be_empty() -> None:
    block, params = rows(12), parameters()
    empty = dataclasses.replace(rows(3), target=rows(3).target[:0])
    empty = Block(
        tuple({k: x[:0] for k, x in f.items()} for f in empty.features),
        tuple(W[:0] for W in empty.operators),
        empty.target,
    )
    Z = first(block, 5)
    whole = negative_bound(PROCESSES, params, [block, empty], Z)
    assert float(whole) == pytest.approx(float(negative_bound(PROCESSES, params, [block], Z)), rel=1e-12)
