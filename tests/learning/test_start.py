"""Initial sizes of forces, by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.forces.priors.contact import SlidingFrictionPrior
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.gp.features import Block
from forcegp.learning.search import (
    DEFAULT_RANGE,
    LIMITS,
    box_around,
    doubts_at_bounds,
    initial_hyperparameters,
)

N, ROWS = 50, 6


def block_of(W: Tensor, target: Tensor, inputs: str, width: int) -> Block:
    features = {inputs: torch.randn(len(W), width, dtype=torch.float64)}
    return Block((features,), (W,), target)


def test_forces_along_one_direction_start_as_if_alone() -> None:
    torch.manual_seed(0)
    direction = torch.randn(N, ROWS, dtype=torch.float64)
    speed = 0.5 * torch.rand(N, 1, dtype=torch.float64)
    W = torch.stack([speed * direction, direction], dim=-1)
    blocks = [block_of(W, 3.0 * speed * direction, "speed", 1)]
    found = initial_hyperparameters([SlidingFrictionPrior("table")], blocks)["contact_table.log_std"].exp()
    size = direction.square().sum(1).sqrt()
    dry = ((3.0 * speed[:, 0] * size).square().mean() / size.square().mean()).sqrt()
    assert found.tolist() == pytest.approx([3.0, float(dry)], rel=1e-9)


def test_other_forces_start_at_their_least_squares() -> None:
    torch.manual_seed(0)
    W, force = (torch.randn(N, *shape, dtype=torch.float64) for shape in ((ROWS, 3), (3,)))
    blocks = [block_of(W, (W @ force[..., None])[..., 0], "q", 3)]
    prior = JointForcePrior(SlidingFrictionPrior("table").kernel)
    found = initial_hyperparameters([prior], blocks)[f"{prior.name}.log_std"].exp()
    assert found.tolist() == pytest.approx(force.square().mean(0).sqrt().tolist(), rel=1e-9)


def test_learning_stays_around_its_start_and_says_where_it_ended_at_a_bound() -> None:
    start = {
        "joint.log_std": torch.tensor([0.0, 9.0]).double(),
        "joint.log_lengthscale": torch.tensor([1.0]).double(),
        "noise.0.log_noise_std": torch.tensor([-2.3]).double(),
        "coulomb.table.log_coefficient": torch.tensor(-1.0).double(),
    }
    box = box_around(start, {**start, "joint.log_lengthscale": torch.tensor([20.0]).double()})
    low, high = box["joint.log_std"]
    assert torch.equal(low, start["joint.log_std"] - DEFAULT_RANGE[0])
    assert torch.equal(high, start["joint.log_std"] + DEFAULT_RANGE[1])
    assert float(box["joint.log_lengthscale"][1]) == 20.0, "where learning begins"
    assert box["coulomb.table.log_coefficient"] == LIMITS["log_coefficient"]
    assert doubts_at_bounds(start, box) == ()
    ended = {
        **start,
        "joint.log_std": torch.stack([low[0], high[1]]),
        "noise.0.log_noise_std": torch.tensor([-2.3 - DEFAULT_RANGE[0]]).double(),
        "joint.log_lengthscale": torch.tensor([20.0]).double(),
    }
    size, noise = doubts_at_bounds(ended, box)
    assert size.startswith("1 of 2 values of joint.log_std ended at their upper bound")
    assert noise.startswith("1 of 1 values of noise.0.log_noise_std ended at their lower bound")
