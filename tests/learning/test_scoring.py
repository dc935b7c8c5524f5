"""Fisher scoring for the variances of rows ends at a maximum of their density."""

from __future__ import annotations

import itertools

import pytest
import torch

from forcegp.learning.scales import Residuals, _settled

ROWS = 60


def rows_of(seed: int) -> Residuals:
    """Rows that show two forces over eight orders of magnitude, with forces of heavy tails."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(ROWS, *shape, generator=generator, dtype=torch.float64)

    size = torch.empty(ROWS, 2, dtype=torch.float64).uniform_(-2.0, 6.0, generator=generator)
    B = torch.diag_embed(10.0**size) @ (torch.eye(2, dtype=torch.float64) + 0.5 * normal(2, 2))
    force = 10.0 * normal(2) * torch.rand(ROWS, 2, generator=generator, dtype=torch.float64) ** 6
    slow = torch.exp(-((3.0 * normal(2)) ** 2))
    return Residuals((B @ force[..., None])[..., 0] + normal(2), B, slow, torch.zeros_like(force))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("start", [1e-16, 1e-2, 1e4])
def test_no_other_variance_has_a_larger_density(seed: int, start: float) -> None:
    """Steps that are not shortened end at densities that are lower by up to 10¹⁰ nats."""
    rows, one = rows_of(seed), torch.ones(4, dtype=torch.float64)
    found = _settled(rows, start * one, one, one > 0.0)
    density = rows.log_density(*found.chunk(2))
    for k, factor in itertools.product(range(4), (0.5, 2.0)):
        other = torch.where(torch.arange(4) == k, factor * found.clamp(min=1e-6), found)
        assert rows.log_density(*other.chunk(2)) < density + 0.1


def test_padding_changes_no_density() -> None:
    """Measurements with fewer values per sample are scored beside others."""
    rows, theta = rows_of(0), torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    padded = rows.padded(5)
    assert padded.r.shape[-1] == 5
    assert padded.log_density(*theta.chunk(2)) == pytest.approx(rows.log_density(*theta.chunk(2)), rel=1e-12)
    for one, other in zip(padded.read(*theta.chunk(2)), rows.read(*theta.chunk(2)), strict=True):
        torch.testing.assert_close(one, other)
