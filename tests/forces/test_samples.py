"""Functions drawn from the posterior: their moments, and that each obeys the equations of motion."""

from __future__ import annotations

import pytest
import torch

from forcegp.forces.posterior import CHUNK_STATES, draw_samples
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.quantities import states
from forces.cases import conditioned, draw, logged, mixed_contacts, sampled_forces, two_contacts

COUNT = 1500
STANDARD_ERRORS = 5.0
"""A mean of `COUNT` draws is off by so many standard errors with a chance below 1e-6."""
SPREAD = 0.15
"""Relative error of a standard deviation: 1/√(2 COUNT) by chance, and the random features."""


def test_moments_are_those_of_the_posterior() -> None:
    model = conditioned(logged(two_contacts(), 10), force_priors=[JointForcePrior()])
    (q, qd, tau), active = draw(4, seed=7), mixed_contacts(4)
    q = q * 0.1 + model.training.measurements[0].q[:4]  # near data, where the correction matters
    samples = draw_samples(model.posterior, COUNT, torch.Generator().manual_seed(1))
    Q, Q_z = sampled_forces(samples, model.system, states(model.system, q, qd, tau, active))
    expected = model.predict(q, qd, tau, "joint_force", active=active)
    assert Q.shape == (COUNT, 4, 7) and bool((Q_z == 0.0).all())
    error = (Q.mean(0) - expected.mean).abs() / (expected.std / COUNT**0.5)
    assert float(error.max()) < STANDARD_ERRORS
    assert float((Q.std(0) / expected.std - 1.0).abs().max()) < SPREAD


def test_every_sample_obeys_newton_and_the_constraint() -> None:
    system = two_contacts()
    model = conditioned(logged(system, 8))
    (q, qd, tau), active = draw(6, seed=7), mixed_contacts(6)
    samples = draw_samples(model.posterior, 5, torch.Generator().manual_seed(2))
    Q, Q_z = sampled_forces(samples, system, states(system, q, qd, tau, active))
    assert bool((Q_z[:, ~active.any(-1)] == 0.0).all()), "no friction without contact"
    eom = system.equations(q, qd, active)
    for force in Q + Q_z:
        qdd, rounding = eom.acceleration(force), 1e-10 * float(force.abs().max())
        assert float(((eom.A @ qdd[..., None])[..., 0] - eom.b).abs().max()) < 1e-9 * float(qdd.abs().max())
        newton = (
            (eom.M @ qdd[..., None])[..., 0] - force - (eom.A.mT @ eom.multiplier(force)[..., None])[..., 0]
        )
        assert float(newton.abs().max()) < rounding * 10


def test_a_sample_is_one_function() -> None:
    """The same at a state whatever else is asked with it, and reproducible from the seed."""
    system = two_contacts()
    model = conditioned(logged(system, 6))
    at = states(system, *draw(5, seed=7), mixed_contacts(5))
    one, two = (
        draw_samples(model.posterior, 3, torch.Generator().manual_seed(4), features=64) for _ in range(2)
    )
    Q, Q_z = sampled_forces(one, system, at)
    assert torch.equal(Q, sampled_forces(two, system, at)[0])
    own = torch.tensor([2, 0, 1])
    few = states(system, *(x[:3] for x in draw(5, seed=7)), mixed_contacts(5)[:3])
    chosen = sampled_forces(one, system, few)
    assert torch.allclose(
        sum(chosen)[own, torch.arange(3)], (Q + Q_z)[own, torch.arange(3)], rtol=1e-12, atol=1e-12
    )
    other = draw_samples(model.posterior, 3, torch.Generator().manual_seed(5), features=64)
    assert not torch.allclose(Q, sampled_forces(other, system, at)[0])


@pytest.mark.parametrize(
    ("count", "runs"), [(CHUNK_STATES + 3, 1), (5, CHUNK_STATES // 2), (2, CHUNK_STATES + 1)]
)
def test_each_sample_at_its_own_states(count: int, runs: int) -> None:
    """However many states are looked at together, the forces are those of each sample at all states."""
    system = two_contacts()
    model = conditioned(logged(system, 6))
    samples = draw_samples(model.posterior, count, torch.Generator().manual_seed(4), features=64)
    q, qd, tau = draw(count * runs, seed=7)
    at = states(system, q, qd, tau, mixed_contacts(count * runs))
    own = torch.arange(count).repeat_interleave(runs), torch.arange(count * runs)
    force = sum(sampled_forces(samples, system, at))[own]
    assert torch.allclose(samples(system, at), force, rtol=1e-10, atol=1e-10)
