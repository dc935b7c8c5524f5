"""An extended factor is that of the sum."""

from __future__ import annotations

import pytest
import torch

from forcegp.gp import factor
from forcegp.gp.factor import bordered, extended


@pytest.fixture(params=["compiled", "LAPACK"])
def by(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """How factors are extended."""
    if request.param == "LAPACK":
        monkeypatch.setattr(factor, "_kernel", lambda: None)
    elif factor._kernel() is None:
        pytest.skip("no C++ compiler")
    return request.param


@pytest.mark.parametrize(("size", "rows"), [(40, 7), (40, 21), (5, 1), (3, 8), (4, 0)])
def test_extended_factor_is_that_of_the_sum(by: str, size: int, rows: int) -> None:
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


def test_rows_that_leave_columns_alone_change_nothing_there(by: str) -> None:
    L = torch.diag(torch.arange(1.0, 6.0, dtype=torch.float64))
    rows = torch.zeros(2, 5, dtype=torch.float64)
    rows[:, 2] = torch.tensor([4.0, 0.0])
    expected = torch.tensor([1.0, 2.0, 5.0, 4.0, 5.0], dtype=torch.float64)
    assert torch.allclose(extended(L, rows).diagonal().abs(), expected)


def test_a_factor_keeps_its_digits_over_many_updates(by: str) -> None:
    """Directions that the rows tell a million times more of than of others."""
    generator = torch.Generator().manual_seed(1)
    scale = torch.logspace(0, 3, 30, dtype=torch.float64)
    rows = torch.randn(200, 6, 30, generator=generator, dtype=torch.float64) * scale
    L = torch.eye(30, dtype=torch.float64)
    for own in rows:
        L = extended(L, own)
    whole = rows.flatten(0, 1)
    A = whole.mT @ whole + torch.eye(30, dtype=torch.float64)
    assert float(((L @ L.mT - A) / torch.outer(scale, scale)).abs().max()) < 1e-9


def test_a_bordered_factor_is_that_of_the_whole_matrix() -> None:
    generator = torch.Generator().manual_seed(3)
    X = torch.randn(9, 9, dtype=torch.float64, generator=generator)
    A = X @ X.mT + torch.eye(9, dtype=torch.float64)
    whole, jitter = bordered(torch.linalg.cholesky(A[:6, :6]), A[:6, 6:], A[6:, 6:])
    torch.testing.assert_close(whole, torch.linalg.cholesky(A), rtol=1e-10, atol=1e-10)
    assert jitter == 0.0
