"""An extended factor is that of the sum."""

from __future__ import annotations

import pytest
import torch

from forcegp.gp.factor import extended


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
