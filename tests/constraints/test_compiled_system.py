"""Compiled equations of motion are those of the tensor functions, and leave derivatives to them."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp.constraints.compiled_system import CompiledSystem, compiled_system

SAME = 1e-11
"""Of two recursions in float64, relative to entries of up to a hundred."""
NAMES = ("M", "A", "b", "c", "cd", "Q_C", "Q_G", "Q_D")


def _pair(scene: str) -> tuple[forcegp.ConstrainedSystem, CompiledSystem]:
    system = forcegp.load_scene(scene).system()
    compiled = compiled_system(system)
    if not isinstance(compiled, CompiledSystem):
        pytest.skip("needs a C++ compiler")
    return system, compiled


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
def test_equations_are_the_same(batch: tuple[int, ...]) -> None:
    system, compiled = _pair("kuka_plane")
    q, qd = torch.randn(2, *batch, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    active = torch.rand(*batch, 1, generator=torch.Generator().manual_seed(1)) < 0.5
    want, got = system.equations(q, qd, active), compiled.equations(q, qd, active)
    for name in NAMES:
        torch.testing.assert_close(getattr(got, name), getattr(want, name), rtol=SAME, atol=SAME)
    for name, point in want.contact_points.items():
        torch.testing.assert_close(vars(got.contact_points[name]), vars(point), rtol=SAME, atol=SAME)
    torch.testing.assert_close(vars(got.motion), vars(want.motion), rtol=0.0, atol=0.0)


def test_derivatives_are_those_of_the_tensor_functions() -> None:
    system, compiled = _pair("kuka_plane")
    q, qd = torch.randn(2, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def bias(own: forcegp.ConstrainedSystem, q: torch.Tensor) -> torch.Tensor:
        return own.equations(q, qd).b

    want, got = (torch.func.jacrev(lambda q, own=own: bias(own, q))(q) for own in (system, compiled))
    torch.testing.assert_close(got, want, rtol=0.0, atol=0.0)
    leaf = q.clone().requires_grad_()
    (by_autograd,) = torch.autograd.grad(bias(compiled, leaf).sum(), leaf)
    torch.testing.assert_close(by_autograd, want[0], rtol=SAME, atol=SAME)


def test_a_robot_that_is_learned_is_not_compiled() -> None:
    system, compiled = _pair("kuka_plane")
    learned = system.robot.replace(mass=system.robot.mass.clone().requires_grad_())
    assert type(compiled_system(system.with_robot(learned))) is forcegp.ConstrainedSystem
    assert type(compiled.with_robot(learned)) is forcegp.ConstrainedSystem
