"""Initial sizes of forces, by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.forces.priors.contact import SlidingFrictionPrior
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.start import initial_hyperparameters
from forcegp.gp.structured_covariance import Block

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
