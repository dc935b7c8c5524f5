"""The wrench on a frame: Jacobian against Pinocchio, least squares against the dense formula, the filter."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import forcegp
from forcegp import dynamics
from forcegp.errors import ParameterError, UnknownNameError
from forcegp.forces.external_wrench import (
    AXES,
    MomentumLog,
    WrenchFrame,
    least_squares,
    momentum_force,
    observe,
    over_levers,
)
from pinocchio_oracle import Oracle
from robots import ARMS

EXACT = 1e-9
"""Relative agreement of two exact formulas through small factorisations."""
SLOPE = 1e-6
"""Of a central difference with a step of 1e-5 s."""
GENERATOR = torch.Generator().manual_seed(0)


def normal(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=GENERATOR)


@pytest.mark.parametrize("reference", ["world", "local"])
def test_the_jacobian_is_pinocchios(reference: str) -> None:
    arm = next(arm for arm in ARMS if arm.name == "ur5")
    robot = arm.load()
    oracle, q = Oracle(arm, robot), normal(robot.nq)
    R, _, J = oracle.frame(q.numpy(), "wrist_3_link")
    own = WrenchFrame("wrist_3_link", reference).jacobian(robot, q).numpy()
    turn = R.T if reference == "local" else np.eye(3)
    np.testing.assert_allclose(own, np.vstack([turn @ J[3:], turn @ J[:3]]), atol=EXACT)
    some = WrenchFrame("wrist_3_link", reference, ("mz", "fx")).jacobian(robot, q).numpy()
    np.testing.assert_array_equal(some, own[[5, 0]])


@pytest.mark.parametrize("joints", [2, 6, 7])
def test_least_squares_is_the_dense_formula(joints: int) -> None:
    J, r, A = normal(4, 6, joints), normal(4, joints), normal(4, joints, joints)
    S, prior = A @ A.mT + 0.1 * torch.eye(joints, dtype=torch.float64), WrenchFrame("tool").prior
    mean, covariance = least_squares(J, r, S, prior)
    # (J S⁻¹ Jᵀ + W⁻¹)⁻¹ J S⁻¹ r, and by conditioning: W − W J (Jᵀ W J + S)⁻¹ Jᵀ W
    precision = J @ torch.linalg.inv(S) @ J.mT + torch.diag(prior**-2)
    dense = torch.linalg.solve(precision, (J @ torch.linalg.solve(S, r[..., None])))[..., 0]
    W = torch.diag(prior**2)
    conditioned = W - W @ J @ torch.linalg.solve(J.mT @ W @ J + S, J.mT @ W)
    torch.testing.assert_close(mean, dense, rtol=1e3 * EXACT, atol=EXACT)
    torch.testing.assert_close(covariance, conditioned, rtol=1e3 * EXACT, atol=1e4 * EXACT)


def test_the_estimate_over_levers_is_the_dense_mixture() -> None:
    """With the marginal likelihood of the joint forces under each prior."""
    J, r, A, frame = normal(5, 6, 7), 5.0 * normal(5, 7), normal(5, 7, 7), WrenchFrame("tool")
    S = A @ A.mT + 0.1 * torch.eye(7, dtype=torch.float64)
    weights, parts = [], []
    for lever in frame.levers:
        prior = lever * frame.prior
        marginal = torch.distributions.MultivariateNormal(
            torch.zeros(7, dtype=torch.float64), S + J.mT @ torch.diag(prior**2) @ J
        )
        weights.append(marginal.log_prob(r))
        parts.append(least_squares(J, r, S, prior))
    weight = torch.softmax(torch.stack(weights), 0)
    mean = sum(w[:, None] * m for w, (m, _) in zip(weight, parts, strict=True))
    second = sum(
        w[:, None, None] * (C + m[:, :, None] * m[:, None, :])
        for w, (m, C) in zip(weight, parts, strict=True)
    )
    assert bool((weight.amax(0) < 0.99).any())
    found = over_levers(*least_squares(J, r, S, frame.prior), frame.prior, frame.levers)
    torch.testing.assert_close(found[0], mean, rtol=1e3 * EXACT, atol=1e2 * EXACT)
    expected = second - mean[:, :, None] * mean[:, None, :]
    torch.testing.assert_close(found[1], expected, rtol=1e3 * EXACT, atol=1e4 * EXACT)


def test_a_direction_that_no_joint_feels_keeps_the_prior() -> None:
    robot = forcegp.load_robot("double_pendulum")
    frame = WrenchFrame(robot.frame_names[-1])
    q = normal(5, robot.nq)
    J = frame.jacobian(robot, q)
    eye = torch.eye(robot.nq, dtype=torch.float64).expand(5, -1, -1)
    _, covariance = least_squares(J, normal(5, robot.nq), 1e-4 * eye, frame.prior)
    _, _, V = torch.linalg.svd(J.mT)
    hidden = V[..., robot.nq :, :] @ torch.diag(frame.prior**-2) @ V[..., robot.nq :, :].mT
    # Along null(Jᵀ) the precision is that of the prior alone.
    own = V[..., robot.nq :, :] @ torch.linalg.inv(covariance) @ V[..., robot.nq :, :].mT
    torch.testing.assert_close(own, hidden, rtol=1e-6, atol=1e-6)


def test_momentum_changes_as_the_equations_of_motion_say() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    q, qd, force = normal(3, 7), normal(3, 7), 10.0 * normal(3, 7)
    qdd = dynamics.forward_dynamics(robot, q, qd, force)
    h = 1e-5
    later, earlier = (
        (dynamics.mass_matrix(robot, q + s * qd + 0.5 * s * s * qdd) @ (qd + s * qdd)[..., None])[..., 0]
        for s in (h, -h)
    )
    _, added = momentum_force(robot, q, qd)
    rate = force + dynamics.gravity_force(robot, q) + added
    torch.testing.assert_close((later - earlier) / (2.0 * h), rate, rtol=SLOPE, atol=1e3 * SLOPE)


def one_joint(n: int, w: float, seed: int, step: float = 0.01) -> MomentumLog:
    """A flywheel of inertia 2 kg m² with the moment w, force errors and noise as the filter assumes them."""
    random = np.random.default_rng(seed)
    eta, psi = random.normal(), (0.1 - step) / (0.1 + step)
    p, momenta = 0.0, []
    for _ in range(n):
        momenta.append(p + 0.02 * random.normal())
        p += step * (w + 0.5 * eta)
        eta = psi * eta + (1.0 - psi**2) ** 0.5 * random.normal()
    ones = np.ones((n, 1, 1))
    return MomentumLog(
        t=step * np.arange(n),
        p=np.array(momenta)[:, None],
        p_noise=0.02**2 * ones,
        u=np.zeros((n, 1)),
        J=ones,
        prior=np.array([5.0]),
        change=np.array([0.5]),
        factor=0.5 * ones,
        correlation=np.array([0.1]),
    )


def test_the_filter_covers_a_constant_moment() -> None:
    means, variances = zip(*(observe(one_joint(600, 3.0, seed)) for seed in range(40)), strict=True)
    errors = np.array([mean[-1, 0] - 3.0 for mean in means])
    std = float(variances[0][-1, 0, 0]) ** 0.5
    assert std < 0.5  # of 5 before the data
    # The mean square of 40 errors of unit variance lies between 0.4 and 1.8; a constant is less than assumed.
    assert 0.1 < float((errors / std).var()) < 1.8


@pytest.mark.parametrize(
    ("settings", "kind", "text"),
    [
        ({"reference": "base"}, UnknownNameError, "reference of a wrench"),
        ({"axes": ("fx", "fw")}, UnknownNameError, "component of a wrench"),
        ({"axes": ("fx", "fx")}, ParameterError, "components of a wrench"),
        ({"axes": ()}, ParameterError, "components of a wrench"),
        ({"prior_std": (0.0, 1.0)}, ParameterError, "prior_std"),
        ({"change": (1.0, float("inf"))}, ParameterError, "change"),
    ],
)
def test_invalid_wrenches(settings: dict, kind: type[Exception], text: str) -> None:
    with pytest.raises(kind, match=text):
        WrenchFrame("tool", **settings)
    assert len(AXES) == 6
