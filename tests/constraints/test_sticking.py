"""Contacts that stick: rows along the surface, told apart from sliding by the speed of the touching point."""

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.constraints.contact import SurfaceContact
from forcegp.errors import ParameterError
from forcegp.forces.priors.contact import SlidingFrictionPrior
from forcegp.forces.quantities import affine_map, states_at

ALWAYS = 1e9
SURFACES = (
    forcegp.Plane(normal=(0.6, 0.0, 0.8), offset=0.1),
    forcegp.constraints.Sphere(center=(0.5, 0.0, -0.2), radius=0.4),
)


def sticking(
    surface: forcegp.Plane | forcegp.constraints.Sphere, radius: float, speed: float | None
) -> forcegp.ConstrainedSystem:
    robot = forcegp.load_robot("franka_panda")
    tip = SurfaceContact(
        "tip", robot.frame_names[-1], (0.0, 0.02, 0.1), surface, radius=radius, stick_speed=speed
    )
    return forcegp.ConstrainedSystem(robot, [tip])


def states(seed: int, count: int = 5) -> tuple[Tensor, Tensor]:
    q, qd = torch.randn(2, count, 7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return q, qd


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("radius", [0.0, 0.02])
def test_the_right_hand_side_is_the_derivative_of_the_rows(
    surface: forcegp.Plane | forcegp.constraints.Sphere, radius: float
) -> None:
    """d(A q̇)/dt = A q̈ − b by central differences, where the point rests on the surface."""
    system = sticking(surface, radius, ALWAYS)
    q, qd = states(0)
    eom = system.equations(q, qd)
    qd = qd - (eom.L @ (eom.A @ qd[..., None]))[..., 0]
    _, qdd = states(1)
    eom, h = system.equations(q, qd), 1e-5

    def along(step: float) -> Tensor:
        moved = q + step * qd + 0.5 * step**2 * qdd, qd + step * qdd
        return (system.equations(*moved).A @ moved[1][..., None])[..., 0]

    slope = (along(h) - along(-h)) / (2.0 * h)
    torch.testing.assert_close(slope, (eom.A @ qdd[..., None])[..., 0] - eom.b, atol=1e-7, rtol=0.0)


def test_a_resting_point_is_held_as_by_a_connection() -> None:
    """The same acceleration as of a point fixed in the world, and the multipliers are the force on it."""
    system = sticking(SURFACES[0], 0.0, 0.01)
    q, _ = states(2)
    rest, tau = torch.zeros_like(q), torch.ones_like(q)
    at, _ = states_at(system, q, rest, tau, None)
    contact = system.contacts[0]
    assert isinstance(contact, SurfaceContact)
    pin = forcegp.constraints.PointConnection("pin", contact.frame, contact.point, None, (0.0, 0.0, 0.0))
    pinned = forcegp.ConstrainedSystem(system.robot, [pin]).equations(q, rest)
    Q = at.eom.Q_K + tau
    torch.testing.assert_close(at.eom.acceleration(Q), pinned.acceleration(Q), atol=1e-9, rtol=1e-9)
    z = affine_map(system, at, "contact_force")
    force = (z.B_Q @ Q[..., None])[..., 0] + z.o
    torch.testing.assert_close(force, pinned.multiplier(Q), atol=1e-8, rtol=1e-9)
    # Newton's equation with the force in the world: M q̈ = Q + Jᵀ F
    left = (at.eom.M @ at.eom.acceleration(Q)[..., None])[..., 0]
    torch.testing.assert_close(left, Q + (pinned.A.mT @ force[..., None])[..., 0], atol=1e-8, rtol=1e-9)


def test_above_the_speed_the_contact_slides() -> None:
    """With the equations of motion of a contact that has one row."""
    q, qd = states(3)
    Q = torch.ones_like(q)
    sticks, slides = (sticking(SURFACES[1], 0.02, speed).equations(q, qd) for speed in (1e-6, None))
    torch.testing.assert_close(sticks.acceleration(Q), slides.acceleration(Q), atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(sticks.multiplier(Q)[:, :1], slides.multiplier(Q), atol=1e-9, rtol=1e-9)
    assert not bool(sticks.multiplier(Q)[:, 1:].any())


def test_friction_of_sliding_is_no_force_of_a_point_that_rests() -> None:
    q, qd = states(4)
    for speed, acts in ((1e-6, True), (ALWAYS, False)):
        system = sticking(SURFACES[0], 0.0, speed)
        at, _ = states_at(system, q, qd, torch.zeros_like(q), None)
        assert bool(SlidingFrictionPrior("tip").operator(system, at).any()) == acts


def test_a_speed_that_is_not_positive_is_refused() -> None:
    with pytest.raises(ParameterError, match="has an invalid stick speed"):
        sticking(SURFACES[0], 0.0, 0.0)
