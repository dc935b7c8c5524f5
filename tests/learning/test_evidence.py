"""The fixed point of the evidence, against the density of the data."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.gp.sums import Sums
from forcegp.learning.evidence import (
    DECISIVE,
    Group,
    families_of,
    fixed_point,
    without_idle,
    worth,
)

ROWS = 200
EXACT = 1e-9
"""Of two formulas for the same density, in double precision."""
STATIONARY = 5e-3
"""Of a fixed point that is stopped when log s changes by less than 1e-3."""


def drawn(seed: int, size: int = 6, noise: float = 1.0) -> tuple[Tensor, Tensor]:
    """Columns, and data that only the first three of them explain."""
    generator = torch.Generator().manual_seed(seed)
    Phi = torch.randn(ROWS, size, generator=generator, dtype=torch.float64)
    y = Phi[:, :3] @ torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    return Phi, y + noise * torch.randn(ROWS, generator=generator, dtype=torch.float64)


def sums_of(Phi: Tensor, y: Tensor) -> Sums:
    none = y.new_zeros(1)
    return Sums(Phi.mT @ y, y @ y, y.new_tensor(float(len(y))), none, none, Phi.mT @ Phi)


def groups(size: int, per: int = 1) -> list[Group]:
    """Groups of `per` columns each, of prior 0, one component per group."""
    columns = torch.arange(size).split(per)
    return [Group("law.log_slope_std", (k, 0), 0, own) for k, own in enumerate(columns)]


def log_density(Phi: Tensor, y: Tensor) -> float:
    K = torch.eye(len(y), dtype=y.dtype) + Phi @ Phi.mT
    zero = torch.zeros_like(y)
    return float(torch.distributions.MultivariateNormal(zero, K).log_prob(y))


@pytest.mark.parametrize("seed", range(3))
def test_scales_are_a_fixed_point(seed: int) -> None:
    Phi, y = drawn(seed)
    own, stated = groups(6), torch.full((6,), -0.7, dtype=torch.float64)
    found = fixed_point(sums_of(Phi, y), own, stated, torch.ones(6, dtype=torch.bool))
    s = found.log_scales.exp()
    scaled = Phi * s
    V = torch.linalg.inv(torch.eye(6, dtype=torch.float64) + scaled.mT @ scaled)
    w = V @ scaled.mT @ y
    gamma = 1.0 - V.diagonal()
    expected = (s**2 * w**2 + (2.0 * stated).exp()) / (gamma + 1.0)
    torch.testing.assert_close(s**2, expected, rtol=STATIONARY, atol=0.0)
    torch.testing.assert_close(found.weights, w, rtol=EXACT, atol=EXACT)


def test_a_column_without_data_keeps_its_stated_scale() -> None:
    Phi, y = drawn(0)
    Phi[:, 5] = 0.0
    stated = torch.full((6,), 0.3, dtype=torch.float64)
    found = fixed_point(sums_of(Phi, y), groups(6), stated, torch.ones(6, dtype=torch.bool))
    assert float(found.log_scales[5]) == pytest.approx(0.3, abs=1e-9)
    assert float(found.determined[5]) == pytest.approx(0.0, abs=1e-12)
    assert float(found.variance[5, 5]) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(3))
def test_worth_is_the_ratio_of_the_densities_with_and_without_the_columns(seed: int) -> None:
    Phi, y = drawn(seed)
    own, none = groups(6), torch.zeros(6, dtype=torch.float64)
    found = fixed_point(sums_of(Phi, y), own, none, torch.zeros(6, dtype=torch.bool))
    for columns in ([0], [4], [1, 2], [3, 4, 5]):
        rest = [k for k in range(6) if k not in columns]
        ratio = log_density(Phi, y) - log_density(Phi[:, rest], y)
        assert worth(found, torch.tensor(columns)) == pytest.approx(ratio, rel=EXACT, abs=EXACT)
    both = log_density(Phi, y) - log_density(0.0 * Phi, y)
    assert found.log_evidence == pytest.approx(both, rel=EXACT)


def test_columns_that_the_evidence_speaks_against_are_dropped() -> None:
    """Three columns of nothing, in one family, judged together with broad stated scales."""
    Phi, y = drawn(1, noise=0.2)
    own, stated = groups(6, per=3), torch.full((2,), 3.0, dtype=torch.float64)
    free = torch.ones(2, dtype=torch.bool)
    sums = Sums(*(100.0 * x for x in sums_of(Phi, y).tensors))
    families = list(families_of(own).values())
    assert families == [[0], [1]]
    found, kept = without_idle(sums, own, stated, free, families)
    assert kept.tolist() == [True, False]
    before = fixed_point(sums, own, stated, free)
    assert worth(before, torch.arange(3, 6)) < -DECISIVE < 0.0 < worth(before, torch.arange(3))
    assert float(found.determined[1]) < 1e-6


def test_columns_that_the_data_hardly_determine_are_not_dropped() -> None:
    Phi, y = drawn(2)
    Phi[:, 3:] *= 1e-3
    own, stated = groups(6, per=3), torch.zeros(2, dtype=torch.float64)
    free = torch.ones(2, dtype=torch.bool)
    _, kept = without_idle(sums_of(Phi, y), own, stated, free, [[0], [1]])
    assert bool(kept.all())
