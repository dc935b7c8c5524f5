"""A and b of constraints against finite differences in time, and the sign of the multiplier."""

from __future__ import annotations

import pytest
import torch

import forcegp
from constraints.cases import CONSTRAINTS, SEEDS, chain, random_state, system_of
from forcegp.constraints import ConstrainedSystem, Plane, PointConnection, SurfaceContact
from forcegp.errors import ForceGPError, UnknownNameError

FIRST_DIFFERENCE = 1e-7
"""h² times third derivatives at h = 1e-5, and rounding of 1e-15 / h."""
SECOND_DIFFERENCE = 2e-4
"""h² times fourth derivatives (of order 1e3 here) at h = 2e-4, and rounding of 1e-15 / h²."""

kinds = pytest.mark.parametrize("kind", list(CONSTRAINTS))
seeds = pytest.mark.parametrize("seed", SEEDS)


@kinds
@seeds
def test_rate_of_c_is_A_qd(kind: str, seed: int) -> None:
    system, h = system_of(kind, seed), 1e-5
    q, qd, _ = random_state(system, 4, seed=seed)
    at = system.equations(q, qd)
    rate = (system.equations(q + h * qd, qd).c - system.equations(q - h * qd, qd).c) / (2 * h)
    scale = float(rate.abs().max())
    assert torch.allclose(at.cd, (at.A @ qd[..., None])[..., 0], atol=1e-12 * scale)
    assert float((rate - at.cd).abs().max()) < FIRST_DIFFERENCE * max(scale, 1.0)


@kinds
@seeds
def test_second_derivative_of_c_is_A_qdd_minus_b(kind: str, seed: int) -> None:
    """Along q(t) = q + t q̇ + ½ t² q̈, c̈ = A q̈ − b: the sign of the text, not of table 1."""
    system, h = system_of(kind, seed), 2e-4
    q, qd, qdd = random_state(system, 4, seed=seed)
    qdd = 0.1 * qdd

    def c(t: float) -> torch.Tensor:
        return system.equations(q + t * qd + 0.5 * t**2 * qdd, qd).c

    at = system.equations(q, qd)
    expected = (at.A @ qdd[..., None])[..., 0] - at.b
    found = (c(h) - 2 * c(0.0) + c(-h)) / h**2
    assert float((found - expected).abs().max()) < SECOND_DIFFERENCE * max(1.0, float(expected.abs().max()))


def test_pressing_has_a_positive_multiplier() -> None:
    """A tool pushed into a table by its weight is held up; the force points out of the solid."""
    robot = forcegp.load_robot("kuka_iiwa")
    q = torch.tensor([0.3, 0.8, 0.1, -1.2, 0.2, 0.9, 0.0], dtype=torch.float64)
    tip = forcegp.kinematics.frame_pose(robot, q, "lbr_iiwa_link_7")[1]
    table = SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.0), Plane((0, 0, 1), float(tip[2])))
    eom = ConstrainedSystem(robot, [table]).equations(q, torch.zeros(7, dtype=torch.float64))
    assert float(eom.multiplier(eom.Q_G)) > 0.0
    below = SurfaceContact("ceiling", "lbr_iiwa_link_7", (0.0, 0.0, 0.0), Plane((0, 0, -1), -float(tip[2])))
    hung = ConstrainedSystem(robot, [below]).equations(q, torch.zeros(7, dtype=torch.float64))
    assert float(hung.multiplier(hung.Q_G)) < 0.0
    assert torch.allclose(eom.constraint_force(eom.Q_G), hung.constraint_force(hung.Q_G))


def test_the_multiplier_of_a_resting_weight_is_its_weight(tmp_path) -> None:
    path = tmp_path / "lift.urdf"
    path.write_text(
        """<robot name="lift"><link name="world"/><link name="block"><inertial><mass value="2.5"/>
        <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="up" type="prismatic"><parent link="world"/><child link="block"/><axis xyz="0 0 1"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
    )
    robot = forcegp.load_robot(path, gravity=(0, 0, -9.8))
    system = ConstrainedSystem(robot, [SurfaceContact("floor", "block", (0, 0, 0), Plane())])
    zero = torch.zeros(1, dtype=torch.float64)
    eom = system.equations(zero, zero)
    assert float(eom.multiplier(eom.Q_K)) == pytest.approx(2.5 * 9.8, rel=1e-14)


def test_a_loop_is_closed_between_two_links() -> None:
    robot = chain(5)
    loop = PointConnection("loop", "tool", (0.1, 0.0, 0.0), "link1", (0.0, 0.2, 0.0))
    system = ConstrainedSystem(robot, [loop])
    q, qd, Q = random_state(system, 6)
    eom = system.equations(q, qd)
    first = forcegp.kinematics.point_jacobian(robot, q, "tool", (0.1, 0.0, 0.0))
    other = forcegp.kinematics.point_jacobian(robot, q, "link1", (0.0, 0.2, 0.0))
    qdd = eom.acceleration(Q)

    def acceleration(J: torch.Tensor, frame: str, point: tuple[float, float, float]) -> torch.Tensor:
        """Of a point, from its Jacobian at two neighbouring times."""
        h = 1e-6
        J1, J0 = (forcegp.kinematics.point_jacobian(robot, q + s * h * qd, frame, point) for s in (1.0, -1.0))
        return (J @ qdd[..., None] + (J1 - J0) / (2 * h) @ qd[..., None])[..., 0]

    gap = acceleration(first, "tool", (0.1, 0.0, 0.0)) - acceleration(other, "link1", (0.0, 0.2, 0.0))
    assert eom.rank.tolist() == [3] * 6
    assert float(gap.abs().max()) < FIRST_DIFFERENCE * float(qdd.abs().max())


@pytest.mark.parametrize(
    ("contact", "error", "message"),
    [
        (
            SurfaceContact("a", "tol", (0.0, 0.0, 0.0), Plane()),
            UnknownNameError,
            r"'tol'[\s\S]*did you mean 'tool'",
        ),
        (PointConnection("a", "tool", (0.0, 0.0, 0.0), "lnk1", (0.0, 0.0, 0.0)), UnknownNameError, "link1"),
        (
            SurfaceContact("a", "tool", (0.0, 0.0), Plane()),
            ForceGPError,
            "the touching point of 'a' is not a point",
        ),
        (
            PointConnection("a", "tool", (0.0, 0.0, 0.0), None, (0.0,)),
            ForceGPError,
            "an end of 'a' is not a point",
        ),
    ],
)
def test_constraints_that_do_not_fit_are_refused(contact, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ConstrainedSystem(chain(0), [contact])
