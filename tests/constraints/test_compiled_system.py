"""Compiled equations of motion are those of the tensor functions, and leave derivatives to them."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp.constraints.compiled_system import CompiledSystem, compiled_system

SAME = 1e-11
"""Of two recursions in float64, relative to entries of up to a hundred."""
NAMES = ("M", "A", "b", "c", "cd", "Q_C", "Q_G", "Q_D")
ROBOT = forcegp.load_robot("kuka_iiwa", base_position=(0.1, 0.0, 0.05), base_rpy=(0.0, 0.0, 0.3))
FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
TABLE = forcegp.SurfaceContact("table", FRAME, POINT, forcegp.Plane((0.1, 0.0, 1.0), 0.055))
BALL = forcegp.SurfaceContact(
    "ball", "lbr_iiwa_link_5", (0.0, 0.1, 0.0), forcegp.constraints.Sphere((0.5, 0.0, -0.5), 0.4)
)
HOOK = forcegp.constraints.PointConnection("hook", FRAME, POINT, "lbr_iiwa_link_0", (0.4, 0.1, 0.2))
SYSTEMS = {"free": (), "table": (TABLE,), "both": (TABLE, BALL), "hook": (HOOK, BALL)}


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


@pytest.mark.parametrize("name", SYSTEMS)
def test_one_state_and_further_points_are_the_same(name: str) -> None:
    system = forcegp.ConstrainedSystem(ROBOT, SYSTEMS[name], forcegp.constraints.Baumgarte())
    compiled = compiled_system(system, (FRAME, POINT))
    if not isinstance(compiled, CompiledSystem):
        pytest.skip("needs a C++ compiler")
    q, qd = torch.randn(2, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    active = torch.tensor([True, False][: len(system.contacts)], dtype=torch.bool)
    want, got = system.equations(q, qd, active), compiled.equations(q, qd, active)
    for field in NAMES:
        torch.testing.assert_close(getattr(got, field), getattr(want, field), rtol=SAME, atol=SAME)
    for point in (POINT, (0.0, 0.1, 0.0)):  # one of the kernel, and one that it does not know
        own, theirs = got.point_motion(FRAME, point), want.point_motion(FRAME, point)
        torch.testing.assert_close(tuple(own), tuple(theirs), rtol=SAME, atol=SAME)


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
