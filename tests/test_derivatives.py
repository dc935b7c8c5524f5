"""Closed-form derivatives of the dynamics against autograd and Pinocchio."""

from __future__ import annotations

import pytest
import torch
from torch.func import jacrev, vmap

from forcegp import dynamics
from forcegp.derivatives import forward_dynamics_derivatives, inverse_dynamics_derivatives
from forcegp.errors import ShapeError
from random_robots import Mirror, random_robot
from robots import random_states
from test_dynamics import EXACT, LARGE, relative, rounding

SEEDS = range(8)


@pytest.mark.parametrize("seed", SEEDS)
def test_against_autograd(seed: int) -> None:
    robot = random_robot(seed)
    q, qd, qdd, force = random_states(robot, 3, seed)
    M = dynamics.mass_matrix(robot, q)

    def inverse(*x: torch.Tensor) -> torch.Tensor:
        return dynamics.inverse_dynamics(robot, *x)

    def forward(*x: torch.Tensor) -> torch.Tensor:
        return dynamics.forward_dynamics(robot, *x)

    expected = vmap(jacrev(inverse, argnums=(0, 1, 2)))(q, qd, qdd)
    for ours, theirs in zip(inverse_dynamics_derivatives(robot, q, qd, qdd), expected, strict=True):
        assert relative(ours, theirs) < EXACT
    expected = vmap(jacrev(forward, argnums=(0, 1, 2)))(q, qd, force)
    for ours, theirs in zip(forward_dynamics_derivatives(robot, q, qd, force), expected, strict=True):
        assert relative(ours, theirs) < rounding(M)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("batch", [1, LARGE])
def test_against_pinocchio(seed: int, batch: int) -> None:
    robot = random_robot(seed)
    mirror = Mirror(robot)
    q, qd, qdd, force = random_states(robot, batch, seed)
    M = dynamics.mass_matrix(robot, q)
    k = batch - 1
    for ours, theirs in zip(
        inverse_dynamics_derivatives(robot, q, qd, qdd),
        mirror.inverse_derivatives(q[k], qd[k], qdd[k]),
        strict=True,
    ):
        assert relative(ours[k], theirs) < EXACT
    for ours, theirs in zip(
        forward_dynamics_derivatives(robot, q, qd, force),
        mirror.forward_derivatives(q[k], qd[k], force[k]),
        strict=True,
    ):
        assert relative(ours[k], theirs) < rounding(M[k])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
def test_shapes(batch: tuple[int, ...]) -> None:
    robot = random_robot(0)
    state = torch.zeros(*batch, robot.nq, dtype=torch.float64)
    for jacobian in forward_dynamics_derivatives(robot, state, state, state):
        assert jacobian.shape == (*batch, robot.nq, robot.nq)
    with pytest.raises(ShapeError, match="qdd has the wrong shape"):
        inverse_dynamics_derivatives(robot, state, state, state[..., :2])
