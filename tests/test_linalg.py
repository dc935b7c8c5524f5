"""Cholesky with counted jitter, inverses in place, and null-space bases with their derivative."""

from __future__ import annotations

import pytest
import torch

from forcegp.errors import NumericalError
from forcegp.linalg import JITTER_STEPS, cholesky, cholesky_inverse_, null_space_basis


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def spd(n: int) -> torch.Tensor:
    X = random(n, n)
    return X @ X.T + torch.eye(n, dtype=torch.float64)


@pytest.mark.parametrize("n", [0, 1, 2, 40])
def test_a_good_matrix_gets_no_jitter(n: int) -> None:
    K = spd(n)
    L, jitter = cholesky(K)
    assert jitter == 0.0
    assert torch.allclose(L @ L.T, K, rtol=1e-12, atol=1e-12)
    assert torch.equal(L, torch.tril(L))


def test_jitter_is_the_smallest_that_serves_and_is_reported() -> None:
    x = random(6, 2)
    K = x @ x.T - 1e-11 * torch.eye(6, dtype=torch.float64)
    L, jitter = cholesky(K)
    scale = float(K.diagonal().mean())
    assert jitter == pytest.approx(JITTER_STEPS[3] * scale)
    assert torch.allclose(L @ L.T, K + jitter * torch.eye(6, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize(
    ("K", "message"),
    [
        (-torch.eye(3, dtype=torch.float64), "not positive definite"),
        (
            torch.diag(torch.tensor([1.0, 1.0, -1e-3], dtype=torch.float64)),
            r"not positive[\s\S]*raise the noise",
        ),
        (torch.full((3, 3), float("nan"), dtype=torch.float64), "not finite"),
        (torch.eye(3, dtype=torch.float64) * float("inf"), "not finite"),
    ],
)
def test_what_has_no_factor_is_refused(K: torch.Tensor, message: str) -> None:
    with pytest.raises(NumericalError, match=message):
        cholesky(K)


@pytest.mark.parametrize("n", [0, 1, 5, 60])
def test_inverse_from_the_factor(n: int) -> None:
    K = spd(n)
    inverse = torch.tril(cholesky_inverse_(torch.linalg.cholesky(K)))
    assert torch.allclose(inverse, torch.tril(torch.linalg.inv(K)), rtol=1e-10, atol=1e-12)


def test_a_singular_factor_is_refused() -> None:
    with pytest.raises(NumericalError, match=r"singular[\s\S]*row 2"):
        cholesky_inverse_(torch.diag(torch.tensor([1.0, 0.0], dtype=torch.float64)))


@pytest.mark.parametrize(("m", "rank"), [(0, 0), (1, 0), (1, 1), (3, 3), (3, 2)])
def test_null_space_basis(m: int, rank: int) -> None:
    A = random(4, m, 7)
    if rank < m:
        A[:, rank:] = 0.0
    U = null_space_basis(A, rank)
    assert U.shape == (4, 7, 7 - rank)
    assert float((A @ U).abs().sum()) < 1e-12
    assert torch.allclose(U.mT @ U, torch.eye(7 - rank, dtype=torch.float64).expand(4, -1, -1), atol=1e-12)


def test_derivative_of_what_does_not_depend_on_the_basis() -> None:
    """Of uᵀ U Uᵀ v and of log|Uᵀ S U|, against central differences."""
    A, dA, u, v, S = random(2, 7), random(2, 7, seed=1), random(7, seed=2), random(7, seed=3), spd(7)

    def value(A: torch.Tensor) -> torch.Tensor:
        U = null_space_basis(A, 2)
        return u @ U @ U.mT @ v + torch.logdet(U.mT @ S @ U)

    leaf = A.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    h = 1e-6
    difference = (value(A + h * dA) - value(A - h * dA)) / (2 * h)
    assert float((gradient * dA).sum()) == pytest.approx(float(difference), rel=1e-7)
