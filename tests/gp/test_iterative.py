"""Matrix-free products and solves against dense matrices."""

from __future__ import annotations

import pytest
import torch

from forcegp.errors import ModelError, NumericalError
from forcegp.gp import iterative
from forcegp.gp.basis import latent_basis
from forcegp.gp.structured_covariance import cross_gram
from gp.sparse_cases import COMPONENTS, PROCESSES, first, parameters, rows

BLOCKS = [rows(60), rows(31, r=2, seed=1)]
PARAMS = parameters()
BASIS = latent_basis(PROCESSES, PARAMS, first(BLOCKS[0], 30), COMPONENTS)


def dense() -> torch.Tensor:
    """K + I."""
    K = cross_gram(PROCESSES, PARAMS, BLOCKS, BLOCKS)
    return K + torch.eye(len(K), dtype=K.dtype)


def test_product_is_that_of_the_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(iterative, "CHUNK_SAMPLES", 13)
    x = torch.randn(242, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.allclose(
        iterative.product(PROCESSES, PARAMS, BLOCKS, x), dense() @ x, rtol=1e-10, atol=1e-10
    )


def test_solution_is_that_of_a_factorisation() -> None:
    y = torch.cat([block.target.reshape(-1) for block in BLOCKS])
    solution = iterative.solve(PROCESSES, PARAMS, BLOCKS, BASIS, tolerance=1e-11)
    expected = torch.linalg.solve(dense(), y)
    assert torch.allclose(solution.x[:, 0], expected, rtol=0, atol=1e-9)
    plain = latent_basis(PROCESSES, PARAMS, first(BLOCKS[0], 0), COMPONENTS)
    without = iterative.solve(PROCESSES, PARAMS, BLOCKS, plain, tolerance=1e-11)
    assert solution.iterations < 0.7 * without.iterations, "the sparse model preconditions"


def test_prediction_is_the_exact_posterior_and_an_early_stop_says_its_error() -> None:
    test = rows(4, seed=2)
    cross = cross_gram(PROCESSES, PARAMS, BLOCKS, [test])
    y = torch.cat([block.target.reshape(-1) for block in BLOCKS])
    mean = (cross.mT @ torch.linalg.solve(dense(), y)).reshape(4, 3)
    full = cross_gram(PROCESSES, PARAMS, [test], [test]) - cross.mT @ torch.linalg.solve(dense(), cross)
    variance = full.diagonal().reshape(4, 3)
    fine = iterative.predict(PROCESSES, PARAMS, BLOCKS, BASIS, test, tolerance=1e-11)
    assert torch.allclose(fine.mean, mean, rtol=0, atol=1e-8)
    assert torch.allclose(fine.covariance.diagonal(dim1=1, dim2=2), variance, rtol=0, atol=1e-8)
    coarse = iterative.predict(PROCESSES, PARAMS, BLOCKS, BASIS, test, tolerance=3e-2)
    excess = coarse.covariance.diagonal(dim1=1, dim2=2) - variance
    assert float(excess.max()) > 1e-6, "the stop was early"
    assert bool((excess > -1e-10).all()) and bool((excess <= coarse.excess + 1e-10).all())


def test_what_does_not_converge_is_an_error() -> None:
    with pytest.raises(NumericalError, match="more inducing points"):
        iterative.solve(PROCESSES, PARAMS, BLOCKS, BASIS, tolerance=1e-12, limit=2)
    with pytest.raises(ModelError, match="does not fit"):
        iterative.solve(PROCESSES, PARAMS, BLOCKS, BASIS, right=torch.ones(5, 1, dtype=torch.float64))
