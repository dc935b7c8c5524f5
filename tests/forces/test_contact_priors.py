"""Priors on contact forces: which way they push, when, and what is learned of a friction that is known."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp.forces.priors.contact import ContactForcePrior, SlidingFrictionPrior
from forcegp.forces.quantities import states
from forces.cases import draw, mixed_contacts, two_contacts
from random_data import NOISE_STD, random_data, table_system

system = two_contacts()
q, qd, tau = draw(12)
at = states(system, q, qd, tau, mixed_contacts(12))
closed = mixed_contacts(12)[:, 0]


def test_sliding_friction_is_the_force_against_the_velocity() -> None:
    E = SlidingFrictionPrior("table", smoothing=0.02).operator(system, at)
    n = torch.tensor([0.0, 0.2, 1.0], dtype=torch.float64) / (1.0 + 0.2**2) ** 0.5
    for i in range(12):
        J = at.eom.contact_points["table"].jacobian[i]
        v = J @ qd[i] - n * (n @ (J @ qd[i]))
        viscous, dry = -J.mT @ v, -J.mT @ v / (v @ v + 0.02**2) ** 0.5
        expected = torch.stack([viscous, dry], dim=-1) if closed[i] else torch.zeros(7, 2)
        torch.testing.assert_close(E[i], expected.double(), rtol=1e-10, atol=1e-12)


def test_sliding_friction_takes_energy_and_presses_on_nothing() -> None:
    E = SlidingFrictionPrior("table").operator(system, at)
    power = (E.mT @ qd[..., None])[..., 0]
    assert bool((power[closed] < 0.0).all()) and bool((power[~closed] == 0.0).all())
    # A tangential force is in the span of the Cartesian one, which has no normal part.
    any_force = ContactForcePrior("table").operator(system, at)
    weights = torch.linalg.lstsq(any_force[closed], E[closed], driver="gelsd").solution
    torch.testing.assert_close(any_force[closed] @ weights, E[closed], rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("prior", [ContactForcePrior("table"), SlidingFrictionPrior("table")])
def test_without_contacts_there_is_no_contact_force(prior: ContactForcePrior | SlidingFrictionPrior) -> None:
    free = forcegp.ConstrainedSystem(system.robot)
    there = states(free, q, qd, tau, torch.ones(12, 0, dtype=torch.bool))
    assert not prior.operator(free, there).any()
    assert prior.operator(free, there).shape == (12, 7, prior.outputs(free.robot))


def test_friction_is_found_from_few_points() -> None:
    table = table_system()
    data, test = (
        random_data(table, 60, friction=1.5),
        random_data(table, 200, seed=1, friction=1.5, free=False),
    )
    point = table.equations(test.q, test.qd).contact_points["table"]
    slip = point.velocity - point.normal * (point.normal * point.velocity).sum(-1, keepdim=True)
    true = -1.5 * (point.jacobian.mT @ slip[..., None])[..., 0]

    def relative_error(prior: ContactForcePrior | SlidingFrictionPrior) -> float:
        model = forcegp.StructuredGP(table, "analytical", [prior], noise=NOISE_STD).fit(data)
        found = model.predict(test.q, test.qd, test.tau, "contact_friction").mean
        return float((found - true).norm() / true.norm())

    sliding = relative_error(SlidingFrictionPrior("table"))
    assert sliding < 0.05 and sliding < relative_error(ContactForcePrior("table"))
