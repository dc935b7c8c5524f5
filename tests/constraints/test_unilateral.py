"""Contacts open and close as rigid bodies do."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp import ConstrainedSystem, Plane, SurfaceContact, dynamics, kinematics
from forcegp.constraints import Baumgarte, PointConnection
from forcegp.constraints.unilateral import contact_forces, land, sliding_friction
from robots import kinetic_energy

FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
SOLVED = 1e-10
"""Linear solves of quantities near one with the mass matrix."""
ROBOT = forcegp.load_robot("kuka_iiwa", gravity=(0, 0, -9.8))
Q = torch.tensor([0.1, 0.9, -0.2, -1.4, 0.3, 0.8, 0.0], dtype=torch.float64)
QD = torch.tensor([0.3, -0.2, 0.5, 0.4, -0.6, 0.1, 0.2], dtype=torch.float64)
OPEN, CLOSED = torch.tensor([False]), torch.tensor([True])


def _system(clearance: float) -> ConstrainedSystem:
    """A table so far below the tip."""
    height = float(kinematics.point_position(ROBOT, Q, FRAME, POINT)[2]) - clearance
    return ConstrainedSystem(
        ROBOT, [SurfaceContact("table", FRAME, POINT, Plane((0, 0, 1), height))], Baumgarte()
    )


def _descending(system: ConstrainedSystem) -> torch.Tensor:
    """A velocity that takes the tip into the table."""
    return QD if float(system.equations(Q, QD).cd) < 0.0 else -QD


def test_an_impact_stops_the_tip_and_takes_energy_by_a_normal_impulse() -> None:
    system = _system(-1e-6)
    qd = _descending(system)
    landing = land(system, Q, qd, OPEN)
    assert landing.impact and bool(landing.closed.all())
    A = landing.eom.A
    assert float((A @ landing.qd).abs().max()) < SOLVED
    impulse = dynamics.mass_matrix(ROBOT, Q) @ (landing.qd - qd)
    strength = torch.linalg.lstsq(A.mT, impulse[:, None]).solution
    torch.testing.assert_close((A.mT @ strength)[:, 0], impulse, atol=SOLVED, rtol=0.0)
    assert float(strength) > 0.0
    before, after = (kinetic_energy(ROBOT, Q, v) for v in (qd, landing.qd))
    assert 0.0 < float(after) < float(before)
    torch.testing.assert_close(landing.eom.cd.abs(), torch.zeros(1).double(), atol=SOLVED, rtol=0.0)


@pytest.mark.parametrize(("clearance", "sign"), [(1e-6, 1.0), (-1e-6, -1.0)])
def test_no_impact_above_the_table_or_on_the_way_up(clearance: float, sign: float) -> None:
    system = _system(clearance)
    qd = sign * _descending(system)
    landing = land(system, Q, qd, OPEN)
    assert not landing.impact and not bool(landing.closed.any())
    assert torch.equal(landing.qd, qd)
    assert float(landing.eom.A.abs().max()) == 0.0


@pytest.mark.parametrize("force", [50.0, -50.0])
def test_a_contact_that_would_pull_opens(force: float) -> None:
    system = _system(0.0)
    at_rest = torch.zeros_like(Q)
    landing = land(system, Q, at_rest, CLOSED)
    eom = landing.eom
    Q_u = -eom.Q_K - (eom.A.mT @ torch.tensor([force], dtype=torch.float64))
    touch = contact_forces(system, Q, at_rest, landing, Q_u, 1.0)
    if force > 0.0:
        assert bool(touch.closed.all())
        assert float(touch.multiplier) == pytest.approx(force, abs=1e-7)
        torch.testing.assert_close(touch.Q_I, force * eom.A[0], atol=1e-7, rtol=0.0)
    else:
        assert not bool(touch.closed.any())
        assert float(touch.multiplier) == 0.0 and float(touch.Q_I.abs().max()) == 0.0


def test_a_connection_of_points_holds_both_ways() -> None:
    tip = kinematics.point_position(ROBOT, Q, FRAME, POINT).tolist()
    system = ConstrainedSystem(ROBOT, [PointConnection("pin", FRAME, POINT, None, tip)])
    at_rest = torch.zeros_like(Q)
    landing = land(system, Q, at_rest, CLOSED)
    Q_u = -landing.eom.Q_K - (landing.eom.A.mT @ torch.tensor([5.0, 0.0, -5.0], dtype=torch.float64))
    touch = contact_forces(system, Q, at_rest, landing, Q_u, 1.0)
    expected = torch.tensor([5.0, 0.0, -5.0], dtype=torch.float64)
    torch.testing.assert_close(touch.multiplier, expected, atol=1e-8, rtol=0.0)


def test_friction_is_tangential_and_takes_power() -> None:
    system = _system(0.0)
    eom = system.equations(Q, QD)
    velocity = kinematics.point_velocity(ROBOT, Q, QD, FRAME, POINT)
    Q_z = sliding_friction(system, eom, CLOSED, 2.0)
    sliding = velocity[:2].square().sum()
    torch.testing.assert_close(QD @ Q_z, -2.0 * sliding, atol=SOLVED, rtol=0.0)
    J = kinematics.point_jacobian(ROBOT, Q, FRAME, POINT)
    expected = -2.0 * J[:2].mT @ velocity[:2]
    torch.testing.assert_close(Q_z, expected, atol=SOLVED, rtol=0.0)
    assert float(sliding_friction(system, eom, OPEN, 2.0).abs().max()) == 0.0
