"""Least squares against closed forms, and on logs of robots that the robot file describes wrongly."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import forcegp
from forcegp.evaluation import least_squares
from forcegp.evaluation.least_squares import LeastSquares, as_torque, baselines, identify_rigid
from forcegp.forces.priors.inertial import DIVERGENCE
from forcegp.robot.inertia import pseudo_inertia, pseudo_inertia_of
from random_data import random_data, table_system

system = table_system()
free = forcegp.ConstrainedSystem(system.robot, [])
TORQUE_NOISE = 0.05
VISCOUS, COULOMB, OFFSET = 0.4, 0.8, 0.3


def true_system(constrained: bool) -> forcegp.ConstrainedSystem:
    """The robot whose links are heavier than in the file."""
    heavier = system.robot.replace(mass=1.25 * system.robot.mass, inertia=1.25 * system.robot.inertia)
    return (system if constrained else free).with_robot(heavier)


def wrong_log(n: int, seed: int, constrained: bool) -> forcegp.Dataset:
    """A log of a robot with heavier links, undeclared friction, an offset and noise of torque."""
    truth = true_system(constrained)
    robot = truth.robot
    data = random_data(system, n, seed, friction=0.0, free=not constrained)
    data = data.replace(contact={"table": torch.full((n,), constrained)})
    eom = truth.equations(data.q, data.qd, data.active(truth.contact_names))
    lost = VISCOUS * data.qd + COULOMB * torch.tanh(data.qd / robot.friction_velocity) + OFFSET
    qdd = eom.acceleration(eom.Q_K + data.tau - lost)
    noise = TORQUE_NOISE * torch.randn(n, robot.nq, generator=torch.Generator().manual_seed(seed))
    return data.replace(qdd=qdd, tau=data.tau + noise, extras={})


@pytest.mark.parametrize("constrained", [False, True])
def test_what_the_robot_file_gets_wrong_is_found(constrained: bool) -> None:
    own = system if constrained else free
    train, test = (wrong_log(400, seed, constrained) for seed in (1, 2))
    found = identify_rigid(own, train)
    friction = torch.tensor([VISCOUS, COULOMB, OFFSET], dtype=torch.float64).repeat_interleave(7)
    zero, truth = 0.0 * friction, true_system(constrained)
    error, before, floor = (
        as_torque(own, test.q, p.predict(test) - test.qdd).square().mean().sqrt()
        for p in (found, LeastSquares(own, zero), LeastSquares(truth, friction))
    )
    # The truth itself is off by the noise of the torque.
    assert float(error) < 1.1 * float(floor) and float(before) > 10.0 * float(floor)
    if not constrained:
        viscous, coulomb, offset = found.friction.reshape(3, 7)
        # Standard errors of some hundred samples with this noise, times five.
        assert (viscous - VISCOUS).abs().max() < 0.25
        assert (coulomb - COULOMB).abs().max() < 0.1 and (offset - OFFSET).abs().max() < 0.1


def test_an_interior_optimum_is_the_ridge_regression_of_a_textbook() -> None:
    data = wrong_log(200, 3, constrained=False)
    prior = least_squares._prior_std(free.robot, data)
    G, g, _ = least_squares._normal_equations(free, data, prior)
    gram, right = G.sum(0) / TORQUE_NOISE**2 + torch.eye(91, dtype=torch.float64), g.sum(0) / TORQUE_NOISE**2
    _, x = least_squares._minimised(free.robot, gram, right, prior[:70])
    W, y = (v.numpy() for v in least_squares._rows(free, data))
    A = np.concatenate([(W * prior.numpy()).reshape(-1, 91) / TORQUE_NOISE, np.eye(91)])
    b = np.concatenate([y.ravel() / TORQUE_NOISE, np.zeros(91)])
    ridge = np.linalg.lstsq(A, b, rcond=None)[0]
    physical = np.sum((A @ x.numpy() - b) ** 2)
    # Physical links restrict the parameters, so that the unrestricted optimum is a lower bound.
    assert np.sum((A @ ridge - b) ** 2) <= physical * (1 + 1e-9)
    assert physical < 1.05 * np.sum((A @ ridge - b) ** 2)


def test_links_at_the_edge_of_the_physical_are_the_most_probable_ones() -> None:
    """The gradient of the objective balances that of the divergence γ [tr(J₀⁻¹J) − log |J|]."""
    data = wrong_log(60, 3, constrained=False)
    data = data.replace(
        tau=data.tau + torch.randn(data.tau.shape, generator=torch.Generator().manual_seed(0))
    )
    prior = least_squares._prior_std(free.robot, data)
    G, g, _ = least_squares._normal_equations(free, data, prior)
    gram, right = G.sum(0) / TORQUE_NOISE**2 + torch.eye(91, dtype=torch.float64), g.sum(0) / TORQUE_NOISE**2
    found, x = least_squares._minimised(free.robot, gram, right, prior[:70])
    J, J0 = (pseudo_inertia(r.mass, r.com, r.inertia) for r in (found, free.robot))
    units = pseudo_inertia_of(torch.eye(10, dtype=torch.float64))
    slope = ((gram @ x - right)[:70] / prior[:70]).view(7, 10)
    # S with ⟨S, E_p⟩ = ∂f/∂π_p
    row, column = torch.triu_indices(4, 4)
    twice = torch.where(row == column, 1.0, 2.0).double()
    S = torch.zeros_like(J)
    S[:, row, column] = S[:, column, row] = torch.linalg.solve(units[:, row, column] * twice, slope.mT).mT
    L = torch.linalg.cholesky(J)
    left = L.mT @ (S + DIVERGENCE * torch.linalg.inv(J0)) @ L - DIVERGENCE * torch.eye(4)
    assert float(left.abs().max()) < DIVERGENCE
    assert float(torch.linalg.eigvals(torch.linalg.solve(J0, J)).abs().min()) < 1e-2, "an edge is reached"


def test_identified_links_are_physical_even_from_few_samples() -> None:
    found = identify_rigid(free, wrong_log(25, 4, constrained=False)).system.robot
    M = forcegp.dynamics.mass_matrix(found, wrong_log(50, 5, constrained=False).q)
    assert bool((found.mass > 0.0).all()) and bool((torch.linalg.eigvalsh(M) > 0.0).all())


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("n", "seed", "constrained"), [(21, 5, True), (30, 3, False)])
def test_rejected_steps_emit_no_warning(n: int, seed: int, constrained: bool) -> None:
    found = identify_rigid(system if constrained else free, wrong_log(n, seed, constrained))
    assert bool(found.friction.isfinite().all())


def test_what_the_motion_does_not_excite_stays_as_in_the_file() -> None:
    data = wrong_log(60, 6, constrained=False)
    still = data.replace(q=0.0 * data.q, qd=0.0 * data.qd, qdd=0.0 * data.qdd, tau=0.0 * data.tau)
    found = identify_rigid(free, still)
    # At rest nothing tells viscous and Coulomb friction.
    assert found.friction[:14].abs().max() < 1e-9


def test_the_trivial_predictors_are_what_they_are_called() -> None:
    train, test = (wrong_log(100, seed, constrained=False) for seed in (7, 8))
    found = {baseline.name: baseline for baseline in baselines(free, train)}
    assert list(found) == ["mean", "robot file", "least squares"]
    torch.testing.assert_close(found["mean"].predict(test), train.qdd.mean(0).expand(100, 7))
    expected = forcegp.AnalyticalModel(free).nominal()
    eom = free.equations(test.q, test.qd)
    torch.testing.assert_close(found["robot file"].predict(test), eom.acceleration(eom.Q_K + test.tau))
    assert expected.system is free
    rms = (found["mean"].predict(train) - train.qdd).square().mean(0).sqrt()
    torch.testing.assert_close(found["mean"].std, rms)
