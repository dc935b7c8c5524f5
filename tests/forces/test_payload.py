"""A payload acts like the difference of two robots."""

from __future__ import annotations

import pytest
import torch

from forcegp import dynamics
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.forces.quantities import states
from forces.cases import draw, mixed_contacts, two_contacts

SAME = 1e-9
"""Of two recursions in float64, relative to forces of some N m."""


def test_the_operator_is_what_a_point_mass_adds_to_inverse_dynamics() -> None:
    system, n = two_contacts(), 6
    robot, (q, qd, tau) = system.robot, draw(n)
    at = states(system, q, qd, tau, mixed_contacts(n))
    qdd = at.eom.acceleration(at.eom.Q_K + tau)
    mass = 0.7
    # A point mass at the link's centre of mass changes neither that nor the inertia about it.
    k, com = robot.nq - 1, robot.com[-1]
    heavy = robot.replace(mass=robot.mass + mass * torch.eye(robot.nq, dtype=torch.float64)[k])
    added = dynamics.inverse_dynamics(heavy, q, qd, qdd) - dynamics.inverse_dynamics(robot, q, qd, qdd)
    prior = PayloadPrior(mass=2.0, length=0.5)
    delta = torch.cat([torch.ones(1, dtype=torch.float64), com / 0.5]) * (mass / 2.0)
    got = -(prior.operator(system, at) @ delta)
    missing = added - got  # the inertia of the point mass about the link's origin, quadratic in its place
    rigid = robot.replace(
        mass=robot.mass,
        inertia=robot.inertia + mass * _point_inertia(com) * torch.eye(robot.nq)[k, :, None, None],
    )
    inertia = dynamics.inverse_dynamics(rigid, q, qd, qdd) - dynamics.inverse_dynamics(robot, q, qd, qdd)
    torch.testing.assert_close(missing, inertia, rtol=SAME, atol=SAME)


def _point_inertia(c: torch.Tensor) -> torch.Tensor:
    return (c @ c) * torch.eye(3, dtype=torch.float64) - torch.outer(c, c)


def test_an_unknown_joint_is_named() -> None:
    with pytest.raises(UnknownNameError, match="joint that carries a payload"):
        PayloadPrior(joint="elbow").check(two_contacts())


def test_the_force_of_the_known_payload_is_exact() -> None:
    system, n, mass = two_contacts(), 6, 1.5
    robot, (q, qd, tau) = system.robot, draw(n)
    at = states(system, q, qd, tau, mixed_contacts(n))
    # A point mass at the origin of the last link: its moment and inertia there are zero.
    last = torch.eye(robot.nq, dtype=torch.float64)[-1]
    com = robot.com * (robot.mass / (robot.mass + mass * last))[:, None]
    about = robot.inertia + robot.mass[:, None, None] * torch.stack([_point_inertia(c) for c in robot.com])
    heavy = robot.replace(mass=robot.mass + mass * last, com=com)
    inertia = about - heavy.mass[:, None, None] * torch.stack([_point_inertia(c) for c in com])
    loaded = states(system.with_robot(heavy.replace(inertia=inertia)), q, qd, tau, mixed_contacts(n)).eom
    want = loaded.acceleration(loaded.Q_K + tau)
    delta = last.new_tensor([mass, 0.0, 0.0, 0.0])

    def error(prior: PayloadPrior) -> float:
        force = at.eom.Q_K + tau + prior.operator(system, at) @ delta
        return float((at.eom.acceleration(force) - want).abs().max() / want.abs().max())

    prior = PayloadPrior()
    assert error(prior) > 0.01
    assert error(prior.around(delta)) < SAME


def test_a_payload_that_cannot_be_is_not_known() -> None:
    prior = PayloadPrior(length=0.1)
    here, far = torch.tensor([[2.0, 1.0, 0.0, 0.0], [1.0, 4.0, 0.0, 0.0]], dtype=torch.float64)
    assert prior.around(here).known == pytest.approx((2.0, 0.1, 0.0, 0.0))
    assert prior.around(far).known == ()
    assert prior.around(here).around(-here).known == ()
    with pytest.raises(ModelError, match="an invalid known payload"):
        PayloadPrior(known=(0.0, 0.0, 0.0, 0.0))
