"""Coulomb friction that is coupled with the multiplier, against dense solves of the coupled equations."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.forces.measurements import Measurement
from forcegp.forces.posterior import ForceSamples
from forcegp.forces.priors.contact import (
    CoulombErrorPrior,
    CoulombFriction,
    SlidingFrictionPrior,
    below_jamming,
    coulomb_keys,
    coupled,
    with_coulomb,
)
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.problem import force_posterior, kernel_parameters
from forcegp.forces.quantities import States, affine_map, states
from forcegp.forces.term import ExpectedForce
from forcegp.gp.kernels import Linear
from forcegp.learning.specification import problem_for
from forces.cases import CONTACTS, draw, logged, mixed_contacts, sampled_forces, two_contacts
from random_data import table_system

N, MU, EPS = 8, (0.15, 0.1), 0.004
DENSE = 1e-8
"""Agreement of two solves of the same equations in double precision, relative to forces of 100 N m."""
GRADIENT = 1e-5
"""Of central differences with steps of 1e-5 on values of order 100."""
WIDTH_MU, WIDTH_EPS = 1.4e-3, 0.1
"""Scale of a grid over log μ and log ε, about the standard deviations that 30 samples leave."""
INTEGRATED = 0.02
"""Relative error of a standard deviation by a Laplace approximation with 30 samples."""


def friction() -> list[CoulombFriction]:
    return [
        CoulombFriction(name, *torch.tensor([mu, EPS], dtype=torch.float64))
        for name, mu in zip(CONTACTS, MU, strict=True)
    ]


def at_states() -> States:
    return states(two_contacts(), *draw(N), mixed_contacts(N))


def unit_friction(at: States, i: int, contact: str) -> np.ndarray:
    """u = −Jᵀ v/√(|v|² + ε²) of a sample with the tangential velocity v."""
    point = at.eom.contact_points[contact]
    n = point.normal[i].numpy() / np.linalg.norm(point.normal[i].numpy())
    v = (np.eye(3) - np.outer(n, n)) @ point.jacobian[i].numpy() @ at.qd[i].numpy()
    return -point.jacobian[i].numpy().T @ v / np.sqrt(v @ v + EPS**2)


def dense(at: States, Q: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q̈, λ and Q_z = Σ μ u λ of a sample from M q̈ − Σ (a + μ u) λ = Q, A q̈ = b over the closed contacts."""
    closed = [k for k in range(2) if bool(at.active[i, k])]
    A, M = at.eom.A[i].numpy()[closed], at.eom.M[i].numpy()
    U = np.array([MU[k] * unit_friction(at, i, CONTACTS[k]) for k in closed]).reshape(-1, 7).T
    K = np.block([[M, -(A.T + U)], [A, np.zeros((len(closed), len(closed)))]])
    x = np.linalg.solve(K, np.concatenate([Q, at.eom.b[i].numpy()[closed]]))
    multiplier = np.zeros(2)
    multiplier[closed] = x[7:]
    return x[:7], multiplier, U @ x[7:]


@pytest.mark.parametrize("quantity", ["qdd", "multiplier", "contact_friction", "total_force", "joint_force"])
def test_every_quantity_solves_the_coupled_equations(quantity: str) -> None:
    at, system = at_states(), two_contacts()
    z = coupled(system, at, affine_map(system, at, quantity), friction())
    Q, own = 30.0 * torch.stack(draw(N, seed=3)[:2])
    found = z.o + (z.B_Q @ Q[..., None])[..., 0] + (z.B_z @ own[..., None])[..., 0]
    for i in range(N):
        qdd, multiplier, Q_z = dense(at, (Q + own)[i].numpy(), i)
        expected = {
            "qdd": qdd,
            "multiplier": multiplier,
            "contact_friction": own[i].numpy() + Q_z,
            "total_force": (Q + own)[i].numpy() + Q_z,
            "joint_force": Q[i].numpy(),
        }[quantity]
        np.testing.assert_allclose(found[i].numpy(), expected, rtol=DENSE, atol=DENSE * 100.0)
    whole = with_coulomb(system, at, Q + own, friction())
    total = coupled(system, at, affine_map(system, at, "total_force"), friction())
    torch.testing.assert_close(whole, total.o + (total.B_Q @ (Q + own)[..., None])[..., 0])


def test_a_contact_that_the_system_lacks_has_no_friction() -> None:
    system = table_system()
    at = states(system, *draw(N), torch.ones(N, 1, dtype=torch.bool))
    z = affine_map(system, at, "qdd")
    other = CoulombFriction("ball", *torch.tensor([0.3, EPS], dtype=torch.float64))
    assert coupled(system, at, z, [other]) is z


def pressed(mu: float, n: int, seed: int = 0) -> forcegp.Dataset:
    """States in which a tip is pressed by 20 to 40 N on a table, under friction with the coefficient μ."""
    system, generator = table_system(), torch.Generator().manual_seed(seed)
    q, qd, tau = draw(n, seed)
    closed = torch.ones(n, 1, dtype=torch.bool)
    eom = system.equations(q, qd, closed)
    wanted = 20.0 + 20.0 * torch.rand(n, 1, generator=generator, dtype=torch.float64)
    tau = tau - (eom.A.mT @ (wanted - eom.multiplier(eom.Q_K + tau))[..., None])[..., 0]
    at = states(system, q, qd, tau, closed)
    law = [CoulombFriction("table", *torch.tensor([mu, EPS], dtype=torch.float64))]
    Q_bar = with_coulomb(system, at, at.eom.Q_K + tau, law)
    noise = 0.01 * torch.randn(n, 7, generator=generator, dtype=torch.float64)
    return forcegp.Dataset(
        t=torch.arange(n, dtype=torch.float64),
        q=q,
        qd=qd,
        tau=tau,
        qdd=at.eom.acceleration(Q_bar) + noise,
        joint_names=system.robot.joint_names,
        contact={"table": closed[:, 0]},
        contact_extras={"multiplier": {"table": at.eom.multiplier(Q_bar)[:, 0]}},
    )


def test_the_coefficient_is_learned_and_the_multiplier_found(tmp_path: Path) -> None:
    train, test = pressed(0.12, 30), pressed(0.12, 30, seed=7)
    prior = SlidingFrictionPrior("table", coupled=True)
    model = forcegp.StructuredGP(
        table_system(),
        "analytical",
        [prior],
        noise=forcegp.Noise(acceleration=0.01, torque=None),
    )
    fit = model.fit(train)
    assert fit.result.objective < -660.0, "not the optimum where a function of the state is the friction"
    mu, eps = (float(fit.hyperparameters[key].exp()) for key in coulomb_keys("table"))
    assert mu == pytest.approx(0.12, rel=0.02) and 0.5 * EPS < eps < 2.0 * EPS
    read = fit.predict(test.q, test.qd, test.tau, "multiplier")
    assert float((read.mean[:, 0] - test.multiplier["table"]).abs().max()) < 0.5
    fit.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model").predict(test.q, test.qd, test.tau, "multiplier")
    assert torch.equal(read.mean, again.mean) and torch.equal(read.variance, again.variance)


def test_updates_and_samples_carry_the_error_of_learned_friction() -> None:
    train, test = pressed(0.12, 30), pressed(0.12, 10, seed=7)
    prior = SlidingFrictionPrior("table", Linear(), coupled=True)
    noise = forcegp.Noise(acceleration=0.05, torque=None)
    fit = forcegp.StructuredGP(table_system(), "analytical", [prior], noise=noise).fit(train[:20])
    updated, whole = fit.update(train[20:]), fit.condition(train)
    one, other = (f.predict(test.q, test.qd, test.tau, "multiplier").variance for f in (updated, whole))
    assert one is not None and other is not None
    torch.testing.assert_close(one, other, rtol=1e-6, atol=0.0)
    samples = whole.force_samples(4000, torch.Generator().manual_seed(0))
    assert isinstance(samples, ForceSamples)
    at = states(whole.system, test.q, test.qd, test.tau, torch.ones(10, 1, dtype=torch.bool))
    multiplier = at.eom.multiplier(sum(sampled_forces(samples, whole.system, at)))
    spread = multiplier[..., 0].var(0) / other[:, 0]
    assert float((spread - 1.0).abs().max()) < 5.0 * math.sqrt(2.0 / 4000)


def test_accelerations_follow_from_the_force_field() -> None:
    fit = forcegp.StructuredGP(
        two_contacts(), "analytical", [JointFrictionPrior(), SlidingFrictionPrior("table", coupled=True)], 0.1
    ).fit(logged(two_contacts(), 12), learn=[])
    at, closed = at_states(), mixed_contacts(N)
    force = fit.force_field()(fit.system, at)
    expected = fit.predict(at.q, at.qd, at.tau, active=closed).mean
    torch.testing.assert_close(at.eom.acceleration(force), expected)


def test_gradient_for_the_friction() -> None:
    priors = [JointFrictionPrior(), SlidingFrictionPrior("table", coupled=True)]
    model = forcegp.StructuredGP(two_contacts(), "analytical", priors, forcegp.Noise(0.1, torque=0.3))
    fit = model.fit(logged(two_contacts(), 8), learn=[])
    problem = dataclasses.replace(fit.problem, inducing=None)
    keys = coulomb_keys("table")

    def objective(x: Tensor) -> Tensor:
        values = {**fit.hyperparameters, keys[0]: x[0], keys[1]: x[1]}
        return problem.negative_log_likelihood(kernel_parameters(values), problem.rows(values))

    start = torch.tensor([0.1, 0.01], dtype=torch.float64).log()
    leaf = start.clone().requires_grad_()
    (found,) = torch.autograd.grad(objective(leaf), [leaf])
    for j in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[j] = 1e-4
        difference = (objective(start + step) - objective(start - step)) / 2e-4
        assert float(found[j]) == pytest.approx(float(difference), rel=GRADIENT, abs=GRADIENT)


def test_no_contact_jams_where_it_was_seen_to_slide() -> None:
    system, data = table_system(), pressed(0.1, 20)
    m = Measurement("qdd", data.q, data.qd, data.tau, data.active(("table",)), data.qdd)
    key = coulomb_keys("table")[0]
    bounds = below_jamming(system, [m], [SlidingFrictionPrior("table", coupled=True)], {key: (-7.0, 9.0)})
    largest = float(np.exp(bounds[key][1]))
    at = m.at(system)
    u = np.stack([unit_friction_of_table(at, i) for i in range(20)])
    gains = 1.0 + largest * np.einsum("ij,ij->i", at.eom.L[..., 0].numpy(), u)
    assert gains.min() == pytest.approx(0.05, abs=1e-3)


def unit_friction_of_table(at: States, i: int) -> np.ndarray:
    """The generalized force of a unit force against the sliding."""
    J = at.eom.contact_points["table"].jacobian[i].numpy() * np.array([[1.0], [1.0], [0.0]])
    v = J @ at.qd[i].numpy()
    return -J.T @ v / np.linalg.norm(v)


@pytest.mark.parametrize("learned", [False, True])
def test_the_error_of_learned_friction_acts_as_its_derivative(learned: bool) -> None:
    """Also if terms of the joints are expected to have a force, here viscous friction and an offset."""
    at, system, names = at_states(), two_contacts(), list(CONTACTS)
    laws, known = friction(), at.eom.Q_K + at.tau
    d, offset = torch.linspace(-3.0, -1.0, 7).double(), torch.linspace(2.0, -2.0, 7).double()
    expected = ExpectedForce(())
    if learned:
        weights = {"expected.joint_friction.velocity": d, "expected.joint_friction.one": offset}
        expected = ExpectedForce.of([JointFrictionPrior()], weights)
        known = known + d * at.qd + offset
    for k, contact in enumerate(names):
        E = CoulombErrorPrior(contact, tuple(laws), expected).operator(system, at)
        z = coupled(system, at, affine_map(system, at, "multiplier"), laws)
        found = z.B_z @ E
        for j, key in enumerate(("coefficient", "smoothing")):
            ends = []
            for sign in (1.0, -1.0):
                moved = list(laws)
                value = getattr(laws[k], key) * math.exp(sign * 1e-5)
                moved[k] = dataclasses.replace(laws[k], **{key: value})
                ends.append(at.eom.multiplier(with_coulomb(system, at, known, moved)))
            difference = (ends[0] - ends[1]) / 2e-5
            torch.testing.assert_close(found[..., j], difference, rtol=1e-4, atol=1e-4)


def test_the_multiplier_is_as_uncertain_as_learned_friction_leaves_it() -> None:
    """The variance of λ against an integral over (log μ, log ε) on a grid, at given θ_v and θ_d."""
    train, test = pressed(0.12, 30), pressed(0.12, 20, seed=7)
    prior = SlidingFrictionPrior("table", Linear(), coupled=True)
    model = forcegp.StructuredGP(
        table_system(),
        "analytical",
        [prior],
        noise=forcegp.Noise(acceleration=0.05, torque=None),
        inference="exact",
    )
    fit, keys = model.fit(train), coulomb_keys("table")
    at = states(fit.system, test.q, test.qd, test.tau, torch.ones(20, 1, dtype=torch.bool))
    z = affine_map(fit.system, at, "multiplier")
    centre = torch.stack([fit.hyperparameters[key] for key in keys])
    means, variances, losses = [], [], []
    steps = torch.linspace(-4.0, 4.0, 9, dtype=torch.float64)
    for move in torch.cartesian_prod(steps * WIDTH_MU, steps * WIDTH_EPS):
        values = {**fit.hyperparameters, **dict(zip(keys, centre + move, strict=True))}
        rows = fit.problem.rows(values)
        loss = fit.problem.negative_log_likelihood(kernel_parameters(values), rows)
        mean, covariance = force_posterior(fit.problem, values).read(fit.system, at, z)
        means.append(mean[:, 0])
        variances.append(covariance[:, 0, 0])
        losses.append(loss + 0.5 * move.square().sum())
    weights = torch.softmax(-torch.stack(losses), 0)[:, None]
    mean = (weights * torch.stack(means)).sum(0)
    expected = (weights * (torch.stack(variances) + (torch.stack(means) - mean) ** 2)).sum(0)
    found = fit.predict(test.q, test.qd, test.tau, "multiplier").variance
    assert found is not None
    alone = force_posterior(fit.problem, fit.hyperparameters).read(fit.system, at, z)[1][:, 0, 0]
    torch.testing.assert_close(found[:, 0].sqrt(), expected.sqrt(), rtol=INTEGRATED, atol=0.0)
    assert bool((alone.sqrt() < 0.8 * expected.sqrt()).any()), "the friction hardly matters here"


def test_the_search_for_friction_sees_contacts_that_slide() -> None:
    """Of 400 samples, 20 slide, and 10 of them are among 50 that are evenly spaced."""
    system, data = two_contacts(), logged(two_contacts(), 400)
    slides = torch.arange(400) % 20 == 4
    data = dataclasses.replace(data, qd=torch.where(slides[:, None], data.qd, 1e-4 * data.qd))
    prior = SlidingFrictionPrior(CONTACTS[0], coupled=True)
    model = forcegp.StructuredGP(system, force_priors=[JointFrictionPrior(), prior], noise=0.1)
    problem = problem_for(model.specification, None, data, None)[1]
    (few,) = problem.showing_coulomb(50).training.measurements
    moving = few.qd.norm(dim=-1) > 1e-2
    assert int(moving.sum()) == 20 and len(few.q) <= 51
    assert all(bool((few.q == x).all(-1).any()) for x in data.q[slides])
    assert problem.showing_coulomb(1000).training.samples == problem.training.samples
