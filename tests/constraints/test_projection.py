"""Projection onto the constraint manifold, against its definition as a least-distance problem."""

import pytest
import torch

from forcegp.constraints.unilateral import POSITION_TOLERANCE, project_state, project_velocity
from forcegp.errors import NumericalError
from rollout_cases import arm, on_manifold

ROUNDING = 1e-12
"""Velocities of order one through a mass matrix of condition 1e3."""


def perturbed(size: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    q, qd = on_manifold(arm(), seed)
    generator = torch.Generator().manual_seed(seed + 1)
    return tuple(x + size * torch.randn(7, dtype=torch.float64, generator=generator) for x in (q, qd))


@pytest.mark.parametrize("size", [pytest.param(1e-6, marks=pytest.mark.slow), 1e-3, 3e-2])
def test_projected_states_lie_on_the_manifold(size: float) -> None:
    system = arm()
    q, qd = (torch.stack(x) for x in zip(*(perturbed(size, seed) for seed in range(4)), strict=True))
    assert float(system.equations(q, qd).c.abs().max()) > POSITION_TOLERANCE
    eom = system.equations(*project_state(system, q, qd))
    assert float(eom.c.abs().max()) <= POSITION_TOLERANCE
    assert float(eom.cd.abs().max()) <= ROUNDING


def test_projection_leaves_states_on_the_manifold_alone() -> None:
    system = arm()
    q, qd = on_manifold(system, 5)
    again = project_state(system, q, qd)
    assert torch.equal(again[0], q)
    assert float((again[1] - qd).abs().max()) <= ROUNDING


def test_open_contacts_are_not_projected() -> None:
    system = arm()
    q, qd = perturbed(1e-2)
    free = project_state(system, q, qd, torch.tensor([False]))
    assert torch.equal(free[0], q)
    assert torch.equal(free[1], qd)


def test_velocity_projection_is_the_nearest_in_kinetic_energy() -> None:
    """M (q̇⁺ − q̇⁻) = AᵀΛ, A q̇⁺ = 0, from a dense KKT system."""
    system = arm()
    q, qd = perturbed(1e-2)
    eom = system.equations(q, qd)
    m = eom.A.shape[0]
    kkt = torch.cat(
        [torch.cat([eom.M, -eom.A.mT], dim=1), torch.cat([eom.A, torch.zeros(m, m, dtype=q.dtype)], dim=1)]
    )
    solved = torch.linalg.solve(kkt, torch.cat([eom.M @ qd, torch.zeros(m, dtype=q.dtype)]))
    assert float((solved[:7] - project_velocity(eom, qd)).abs().max()) <= ROUNDING
    energy = [float(x @ eom.M @ x) for x in (project_velocity(eom, qd), qd)]
    assert energy[0] < energy[1], "an impact loses energy"


def test_a_surface_out_of_reach_is_an_error() -> None:
    from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact

    far = SurfaceContact("wall", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), Plane(offset=50.0))
    system = ConstrainedSystem(arm().robot, [far])
    q, qd = on_manifold(arm(), 0)
    with pytest.raises(NumericalError, match="no state on the constraint manifold"):
        project_state(system, q, qd)
