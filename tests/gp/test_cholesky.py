"""Cholesky with counted jitter, and inverses in place."""

from __future__ import annotations

import pytest
import torch

from forcegp.errors import NumericalError
from forcegp.gp.factor import JITTER_STEPS, cholesky
from forcegp.gp.likelihood import cholesky_inverse_


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
