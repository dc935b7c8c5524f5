"""Null-space bases and what derivatives they have."""

from __future__ import annotations

import pytest
import torch

from forcegp.forces.projection import null_space_basis


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def spd(n: int) -> torch.Tensor:
    X = random(n, n)
    return X @ X.T + torch.eye(n, dtype=torch.float64)


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
