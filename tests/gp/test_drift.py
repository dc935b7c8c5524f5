"""Drifting weights against the dense covariance of a Kalman filter's prediction."""

from __future__ import annotations

import pytest
import torch

from forcegp.errors import ModelError
from forcegp.gp.sparse import drifted
from forcegp.gp.sums import Sums

SAME = 1e-10
"""Of two formulas in float64 on well-conditioned matrices of ten rows."""


def random_sums(n: int = 10) -> Sums:
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(25, n, generator=generator, dtype=torch.float64)
    y = torch.randn(25, generator=generator, dtype=torch.float64)
    one = y.new_ones(1)
    return Sums(rows.mT @ y, y @ y, one[0] * 25, one, one, rows.mT @ rows)


def posterior(sums: Sums) -> tuple[torch.Tensor, torch.Tensor]:
    P = torch.linalg.inv(sums.G + torch.eye(len(sums.G), dtype=torch.float64))
    return P @ sums.v, P


@pytest.mark.parametrize("factor", [0.0, 0.3, 0.99])
def test_mean_and_covariance(factor: float) -> None:
    sums, p = random_sums(), torch.tensor([2, 5, 6])
    m, P = posterior(sums)
    F = torch.eye(10, dtype=torch.float64)
    F[p, p] = factor
    Q = torch.zeros_like(F)
    Q[p, p] = 1.0 - factor**2
    got_m, got_P = posterior(drifted(sums, p, factor))
    torch.testing.assert_close(got_m, F @ m, rtol=SAME, atol=SAME)
    torch.testing.assert_close(got_P, F @ P @ F.mT + Q, rtol=SAME, atol=SAME)


def test_the_evidence_stays() -> None:
    """yᵀy − vᵀA⁻¹v, what the rows have left unexplained, does not change."""
    sums = random_sums()
    after = drifted(sums, torch.tensor([0, 9]), 0.7)
    left = [float(s.yy - s.v @ posterior(s)[0]) for s in (sums, after)]
    assert left[0] == pytest.approx(left[1], rel=SAME)


def test_a_factor_of_one_keeps_everything() -> None:
    sums = random_sums()
    assert drifted(sums, torch.tensor([1]), 1.0) is sums
    with pytest.raises(ModelError, match="invalid forgetting factor"):
        drifted(sums, torch.tensor([1]), 1.5)
