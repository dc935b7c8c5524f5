"""Initial sizes of forces, by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.search import FAR, LIMITS, box_around, doubts_at_bounds, initial_hyperparameters
from forcegp.gp.features import Block
from forcegp.gp.kernels import SquaredExponential

N, ROWS = 50, 6


def sizes_of(W: Tensor, target: Tensor, sizes: list[float]) -> list[float]:
    """Initial sizes of forces for rows with negligible noise."""
    prior = JointForcePrior(SquaredExponential(shared=True))
    block = Block(({"q": torch.randn(len(W), 3, dtype=torch.float64)},), (1e6 * W,), 1e6 * target)
    found = initial_hyperparameters([prior], [block], [torch.tensor(sizes, dtype=torch.float64)])
    return found[f"{prior.name}.log_std"].exp().tolist()


def test_forces_start_at_their_least_squares() -> None:
    torch.manual_seed(0)
    W, force = (torch.randn(N, *shape, dtype=torch.float64) for shape in ((ROWS, 3), (3,)))
    found = sizes_of(W, (W @ force[..., None])[..., 0], [1.0, 1.0, 1.0])
    assert found == pytest.approx(force.square().mean(0).sqrt().tolist(), rel=1e-9)


def test_a_force_that_no_row_shows_starts_at_its_typical_size_times_that_of_the_others() -> None:
    force = torch.linspace(-2.0, 5.0, N, dtype=torch.float64)
    W = torch.tensor([1.0, 0.0], dtype=torch.float64).expand(N, 1, 2)
    size = float(force.square().mean().sqrt())
    assert sizes_of(W, force[:, None], [2.0, 14.0]) == pytest.approx([size, 7.0 * size], rel=1e-2)


def test_forces_that_show_in_their_sum_only_share_it_by_their_typical_sizes() -> None:
    force = torch.linspace(-2.0, 5.0, N, dtype=torch.float64)
    W = torch.ones(N, 1, 2, dtype=torch.float64)
    size = float(force.square().mean().sqrt()) / math.hypot(3.0, 4.0)
    assert sizes_of(W, force[:, None], [3.0, 4.0]) == pytest.approx([3.0 * size, 4.0 * size], rel=1e-2)


def test_learning_stays_around_its_start_and_says_where_it_ended_at_a_bound() -> None:
    start = {
        "joint.log_std": torch.tensor([0.0, 9.0]).double(),
        "joint.log_lengthscale": torch.tensor([1.0]).double(),
        "noise.0.log_noise_std": torch.tensor([-2.3]).double(),
        "coulomb.table.log_coefficient": torch.tensor(-1.0).double(),
    }
    box = box_around(start, {**start, "joint.log_lengthscale": torch.tensor([20.0]).double()})
    low, high = box["joint.log_std"]
    assert torch.equal(low, start["joint.log_std"] - FAR[0])
    assert torch.equal(high, start["joint.log_std"] + FAR[1])
    assert float(box["joint.log_lengthscale"][1]) == 20.0, "where learning begins"
    assert box["coulomb.table.log_coefficient"] == LIMITS["log_coefficient"]
    assert doubts_at_bounds(start, box) == ()
    ended = {**start, "joint.log_std": torch.stack([low[0], high[1]]), "noise.0.log_noise_std": torch.tensor(
        [-2.3 - FAR[0]]).double(), "joint.log_lengthscale": torch.tensor([20.0]).double()}  # fmt: skip
    size, noise = doubts_at_bounds(ended, box)
    assert size.startswith("1 of 2 values of joint.log_std ended at their upper bound")
    assert noise.startswith("1 of 1 values of noise.0.log_noise_std ended at their lower bound")
