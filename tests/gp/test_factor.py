"""An extended factor is that of the sum."""

from __future__ import annotations

import pytest
import torch

from forcegp.gp.factor import bordered, extended


@pytest.mark.parametrize(("size", "rows"), [(40, 7), (5, 1), (3, 8)])
def test_extended_factor_is_that_of_the_sum(size: int, rows: int) -> None:
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(size, size, generator=generator, dtype=torch.float64)
    A = A @ A.mT + torch.eye(size, dtype=torch.float64)
    L = given = torch.linalg.cholesky(A)
    kept, new = given.clone(), torch.randn(rows, size, generator=generator, dtype=torch.float64)
    for _ in range(3):
        A, L = A + new.mT @ new, extended(L, new)
        assert torch.equal(L, L.tril())
        assert torch.allclose(L @ L.mT, A, rtol=1e-12, atol=1e-12)
    assert torch.equal(given, kept), "the given factor is left as it was"


def test_a_bordered_factor_is_that_of_the_whole_matrix() -> None:
    generator = torch.Generator().manual_seed(3)
    X = torch.randn(9, 9, dtype=torch.float64, generator=generator)
    A = X @ X.mT + torch.eye(9, dtype=torch.float64)
    whole, jitter = bordered(torch.linalg.cholesky(A[:6, :6]), A[:6, 6:], A[6:, 6:])
    torch.testing.assert_close(whole, torch.linalg.cholesky(A), rtol=1e-10, atol=1e-10)
    assert jitter == 0.0
