"""Jacobians of the mean in C: those of autograd, and finite differences of the mean."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.models.export.library import CompiledFit
from forcegp.models.export.mean import DIFFERENTIATED
from models.test_export import CASES, compiled, fitted, states

SAME = 1e-8
"""Of the largest entry of a Jacobian; the sums are the same in another order, and derivatives amplify."""
STEP, ROUGH = 1e-5, 1e-6
"""Of finite differences of the fourth order, and their error, in units of the largest entry."""


def difference(ours: Tensor, theirs: Tensor) -> float:
    """Largest difference in units of the largest entry of a state."""
    return float(((ours - theirs).abs().amax((-2, -1)) / theirs.abs().amax((-2, -1)).clamp(min=1e-12)).max())


def finite_differences(fast: CompiledFit, state: tuple[Tensor, ...], active: Tensor) -> list[Tensor]:
    """Derivatives of the mean of all quantities by q, q̇ and τ, of the fourth order."""
    found = []
    for i in range(3):
        columns = []
        for step in torch.eye(7, dtype=torch.float64) * STEP:

            def at(times: float, step: Tensor = step, i: int = i) -> Tensor:
                moved = [x + times * step if k == i else x for k, x in enumerate(state)]
                return fast.predict(*moved, DIFFERENTIATED, active=active, covariance=False).mean

            columns.append((8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * STEP))
        found.append(torch.stack(columns, dim=-1))
    return found


@pytest.mark.parametrize("name", CASES)
def test_jacobians_are_those_of_autograd_and_of_finite_differences(name: str) -> None:
    fit, fast = fitted(name), compiled(name)
    state, active = states(fit)
    ours, theirs = (x.linearize(*state, active=active) for x in (fast, fit))
    for field in ("dq", "dqd", "dtau", "multiplier_dq", "multiplier_dqd", "multiplier_dtau"):
        a, b = getattr(ours, field), getattr(theirs, field)
        assert a.shape == b.shape
        assert not b.numel() or difference(a, b) < SAME, field
    torch.testing.assert_close(ours.qdd, theirs.qdd, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(ours.multiplier, theirs.multiplier, rtol=1e-9, atol=1e-9)
    whole = fast.jacobian(*state, DIFFERENTIATED, active=active)
    differences = finite_differences(fast, state, active)
    for part in whole.parts.values():
        for a, b in zip(whole[1:4], differences, strict=True):
            assert not b[:, part].numel() or difference(a[:, part], b[:, part]) < ROUGH
