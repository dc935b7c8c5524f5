"""Noise of the motor torque in the likelihood, against the dense formula; tempering; the finite priors."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

import forcegp
from forcegp.errors import ModelError
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.forces.posterior import STICK_NOISE
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.problem import force_posterior, kernel_parameters, without_inducing
from forcegp.forces.quantities import affine_map
from forces.cases import draw, logged, mixed_contacts, two_contacts
from forces.textbook import Textbook

EXACT = 1e-9
"""Relative agreement of two exact formulas in double precision, through one factorisation of a few hundred
rows."""
GRADIENT = 1e-5
"""Of central differences with steps of 1e-5 on values of order 100."""
STD = torch.tensor([0.5, 0.4, 0.3, 0.2, 0.2, 0.1, 0.05], dtype=torch.float64)
FINITE = [JointFrictionPrior(), InertialPrior()]


def fitted(priors: list, torque_noise: object = tuple(STD.tolist()), n: int = 8, **settings: object):
    model = forcegp.StructuredGP(
        two_contacts(),
        "analytical",
        priors,
        noise=forcegp.Noise(acceleration=0.1, torque=torque_noise),
        **settings,
    )  # type: ignore[arg-type]
    return model.fit(logged(two_contacts(), n), learn=[])


@pytest.mark.parametrize("priors", [[forcegp.priors.JointForcePrior()], [JointFrictionPrior()]])
def test_likelihood_with_torque_noise_is_the_dense_one(priors: list) -> None:
    model = forcegp.StructuredGP(
        two_contacts(),
        "analytical",
        priors,
        noise=forcegp.Noise(acceleration=0.1, torque=tuple(STD.tolist())),
        inference="exact",
    )
    fit = model.fit(logged(two_contacts(), 8), learn=[])
    y, noise, maps = (book := Textbook(fit)).data()
    m = fit.training.measurements[0]
    B = affine_map(fit.system, m.at(fit.system), "qdd").B_Q
    K = book.gram(maps) + torch.diag(noise) + torch.block_diag(*((B * STD**2) @ B.mT))
    L = torch.linalg.cholesky(K)
    alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
    dense = -float(0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi))
    assert fit.result.log_marginal_likelihood == pytest.approx(dense, rel=EXACT)


def test_gradient_for_torque_noise() -> None:
    fit = fitted(FINITE)
    problem = without_inducing(fit.problem)
    values = {**fit.hyperparameters, TORQUE_NOISE: STD.log()}

    def objective(log_std: torch.Tensor) -> torch.Tensor:
        rows = problem.rows({**values, TORQUE_NOISE: log_std})
        return problem.negative_log_likelihood(kernel_parameters(values), rows)

    leaf = STD.log().requires_grad_()
    (found,) = torch.autograd.grad(objective(leaf), [leaf])
    for j in range(7):
        step = torch.zeros(7, dtype=torch.float64)
        step[j] = 1e-5
        difference = (objective(STD.log() + step) - objective(STD.log() - step)) / 2e-5
        assert float(found[j]) == pytest.approx(float(difference), rel=GRADIENT, abs=GRADIENT)


def test_finite_priors_are_inferred_sparsely_and_exactly() -> None:
    q, qd, tau = draw(5, seed=4)
    one, two = fitted(FINITE, inference="exact"), fitted(FINITE, inference="sparse")
    assert two.problem.inducing is not None and one.problem.inducing is None
    assert one.result.log_marginal_likelihood == pytest.approx(two.result.log_marginal_likelihood, rel=EXACT)
    for quantity in ("qdd", "multiplier", "joint_force"):
        a, b = (f.predict(q, qd, tau, quantity, active=mixed_contacts(5)) for f in (one, two))
        torch.testing.assert_close(a.mean, b.mean, rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(a.covariance, b.covariance, rtol=1e-6, atol=1e-6)


def test_a_power_of_the_likelihood_is_that_many_samples() -> None:
    """Two copies of every sample at the power ½ are the samples once."""
    data = logged(two_contacts(), 6)
    model = forcegp.StructuredGP(
        two_contacts(),
        "analytical",
        FINITE,
        noise=forcegp.Noise(acceleration=0.1, torque=0.2),
    )
    once = model.fit(data, learn=[])
    twice = model.fit(data[torch.arange(6).repeat(2)], learn=[])
    tempered = force_posterior(dataclasses.replace(twice.problem, power=0.5), twice.hyperparameters)
    states = twice.training.measurements[0][torch.arange(4)].at(twice.system)
    z = affine_map(twice.system, states, "joint_force")
    torch.testing.assert_close(
        tempered.read_mean(twice.system, states, z), once.posterior.read_mean(twice.system, states, z)
    )
    assert tempered.latent.log_likelihood < 0.0


def test_noise_of_a_predicted_measurement() -> None:
    fit = fitted(FINITE)
    q, qd, tau = draw(3)
    quiet, noisy = (fit.predict(q, qd, tau, active=mixed_contacts(3), noise=noise) for noise in (False, True))
    at = fit.system.equations(q, qd, mixed_contacts(3))
    expected = (at.H * STD**2) @ at.H.mT + 0.01 * torch.eye(7, dtype=torch.float64)
    torch.testing.assert_close(noisy.covariance - quiet.covariance, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("given", ["loud", -0.1])
def test_torque_noise_that_is_not_valid(given: object) -> None:
    with pytest.raises(ModelError, match="noise of the motor torque"):
        forcegp.StructuredGP(two_contacts(), "analytical", FINITE, noise=forcegp.Noise(torque=given))  # type: ignore[arg-type]


def test_a_joint_that_sticks_has_a_spread_of_its_own() -> None:
    """Friction within ±2 N m of a joint that hardly moves is learned as a spread, read where it sticks."""
    generator = torch.Generator().manual_seed(3)
    robot = forcegp.load_robot("double_pendulum")
    robot = robot.replace(damping=torch.zeros_like(robot.damping), friction=torch.zeros_like(robot.friction))
    n = 400
    q, qd, qdd, u = (torch.randn(n, 2, generator=generator, dtype=torch.float64) for _ in range(4))
    qd[::2, 0] *= 1e-3
    friction = torch.stack(
        [torch.where(qd[:, 0].abs() < 0.02, 2.0 * u[:, 0], 0.5 * qd[:, 0].sign()), 0.1 * u[:, 1]], -1
    )
    tau = forcegp.dynamics.inverse_dynamics(robot, q, qd, qdd) + friction
    t = torch.arange(n, dtype=torch.float64) * 0.01
    data = forcegp.Dataset(t=t, q=q, qd=qd, qdd=qdd, tau=tau, joint_names=robot.joint_names)
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical", noise=0.01).fit(data)
    assert not bool(fit.system.robot.armature.any()), "what holds a joint is not inertia"
    assert float(fit.hyperparameters[STICK_NOISE].exp()[0]) == pytest.approx(2.0, rel=0.2)
    assert fit.torque_std is not None and float(fit.torque_std[0]) < 0.2
    at = torch.zeros(2, 2, dtype=torch.float64), torch.tensor([[0.0, 1.0], [1.0, 1.0]]).double()
    std = fit.predict(*at, torch.zeros(2, 2, dtype=torch.float64), "joint_force").std
    assert float(std[0, 0]) == pytest.approx(2.0, rel=0.2) and float(std[1, 0]) < 0.3
