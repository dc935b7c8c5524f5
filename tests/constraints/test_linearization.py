"""Jacobians of the constrained acceleration and the multiplier, against central differences."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import forcegp
from constraints.cases import random_state
from forcegp import ConstrainedSystem, Plane, SurfaceContact
from forcegp.constraints import Baumgarte, ImplicitSurface, PointConnection, Sphere
from forcegp.errors import ShapeError

STEP = 1e-6
TOLERANCE = 2e-6
"""Relative to the largest entry: central differences leave ε/STEP ~ 1e-10 of q̈, times M⁻¹ of light wrists."""

PLANE = SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.01, 0.1), Plane((0.1, 0.2, 1.0), 0.05))
BALL = SurfaceContact("ball", "lbr_iiwa_link_6", (0.02, 0.0, 0.1), Sphere((0.5, 0.1, -1.0), 1.1))
HILL = SurfaceContact(
    "hill", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), ImplicitSurface(lambda p: p[2] - 0.1 * torch.sin(3.0 * p[0]))
)
ROD = PointConnection("rod", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), None, (0.1, 0.2, 0.3))
SYSTEMS = {
    "free": (),
    "table": (PLANE,),
    "table and ball": (PLANE, BALL),
    "hill": (HILL,),
    "rod": (ROD,),
}


def system_of(contacts: tuple, baumgarte: Baumgarte | None = None) -> ConstrainedSystem:
    robot = forcegp.load_robot("kuka_iiwa")
    joints = torch.linspace(0.1, 0.7, robot.nq, dtype=robot.dtype)
    rough = robot.replace(friction=joints, damping=0.5 * joints, armature=0.1 * joints)
    return ConstrainedSystem(rough, contacts, baumgarte)


def central(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Jacobian by central differences, `(*batch, d, n)`."""
    columns = []
    for i in range(x.shape[-1]):
        step = torch.zeros_like(x)
        step[..., i] = STEP
        columns.append((function(x + step) - function(x - step)) / (2.0 * STEP))
    return torch.stack(columns, dim=-1)


def assert_near(ours: Tensor, oracle: Tensor) -> None:
    scale = max(1.0, float(oracle.abs().max())) if oracle.numel() else 1.0
    torch.testing.assert_close(ours, oracle, rtol=0, atol=TOLERANCE * scale)


@pytest.mark.parametrize("name", SYSTEMS)
def test_jacobians_are_those_of_central_differences(name: str) -> None:
    system = system_of(SYSTEMS[name], Baumgarte(5.0, 0.7) if "table" in name else None)
    q, qd, force = random_state(system, 4)
    closed = torch.tensor([[True, True], [True, False], [False, True], [True, True]])
    active = closed[:, : len(system.contacts)]

    def motion(q: Tensor, qd: Tensor, force: Tensor) -> Tensor:
        eom = system.equations(q, qd, active)
        return torch.cat([eom.acceleration(eom.Q_K + force), eom.multiplier(eom.Q_K + force)], dim=-1)

    at = system.linearize(q, qd, force, active)
    torch.testing.assert_close(torch.cat([at.qdd, at.multiplier], -1), motion(q, qd, force))
    oracles = (
        central(lambda x: motion(x, qd, force), q),
        central(lambda x: motion(q, x, force), qd),
        central(lambda x: motion(q, qd, x), force),
    )
    nq = system.robot.nq
    for oracle, qdd, multiplier in zip(oracles, at[1:4], at[5:], strict=True):
        assert_near(qdd, oracle[:, :nq])
        assert_near(multiplier, oracle[:, nq:])


def test_redundant_contacts_change_nothing() -> None:
    """Three contacts at one point move the robot as one does; the pseudo-inverse is not differentiated."""
    one = system_of((PLANE,))
    names = ("a", "b", "c")
    three = system_of(tuple(SurfaceContact(n, PLANE.frame, PLANE.point, PLANE.surface) for n in names))
    state = random_state(one, 3, seed=1)
    for a, b in zip(one.linearize(*state)[:4], three.linearize(*state)[:4], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_arguments_are_checked() -> None:
    system = system_of((PLANE,))
    q = torch.zeros(2, 7, dtype=torch.float64)
    with pytest.raises(ShapeError, match="q and force have unequal batch shapes"):
        system.linearize(q, q, q[0])
