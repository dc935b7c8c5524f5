"""Noise with heavy tails: its likelihood at given weights, planted impacts, logs without any."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.errors import ModelError
from forcegp.forces.quantities import affine_map
from forcegp.models.structured_fit import StructuredFit
from forces.cases import logged, two_contacts
from forces.textbook import Textbook

N = 8
EVERY = 20
"""One sample in so many is an impact."""


def test_likelihood_with_weights_is_the_dense_one() -> None:
    """Sample i has the noise (B Σ_τ Bᵀ + Σ_q̈)/w_i, in contact too."""
    std = torch.tensor([0.5, 0.4, 0.3, 0.2, 0.2, 0.1, 0.05], dtype=torch.float64)
    model = forcegp.StructuredGP(
        two_contacts(),
        "analytical",
        [forcegp.priors.JointForcePrior()],
        noise=forcegp.Noise(acceleration=0.1, torque=tuple(std.tolist())),
        inference="exact",
    )
    fit = model.fit(logged(two_contacts(), N), learn=[])
    weight = torch.linspace(0.05, 1.5, N, dtype=torch.float64)
    training = dataclasses.replace(fit.training, weights=(weight,))
    problem = dataclasses.replace(fit.problem, training=training)
    found = float(problem.negative_log_likelihood(dict(fit.hyperparameters), problem.rows({})))
    y, noise, maps = (book := Textbook(fit)).data()
    m = fit.training.measurements[0]
    B = affine_map(fit.system, m.at(fit.system), "qdd").B_Q
    every = (torch.diag_embed(noise.reshape(N, 7)) + (B * std**2) @ B.mT) / weight[:, None, None]
    L = torch.linalg.cholesky(book.gram(maps) + torch.block_diag(*every))
    alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
    dense = float(0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi))
    assert found == pytest.approx(dense, rel=1e-9)


def with_friction(impacts: bool) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """A double pendulum with friction of its joints; one sample in twenty is hit by 30 rad/s²."""
    generator = torch.Generator().manual_seed(4)
    robot = forcegp.load_robot("double_pendulum")
    q, qd, tau, noise, hit = (torch.randn(200, 2, generator=generator, dtype=torch.float64) for _ in range(5))
    force = tau - 0.8 * torch.tanh(qd / 0.02) - 0.3 * qd
    qdd = forcegp.dynamics.forward_dynamics(robot, q, qd, force) + 0.1 * noise
    if impacts:
        qdd[::EVERY] += 30.0 * hit[::EVERY]
    t = 0.05 * torch.arange(200, dtype=torch.float64)
    data = forcegp.Dataset(t=t, q=q, qd=qd, tau=tau, qdd=qdd, joint_names=robot.joint_names)
    return forcegp.ConstrainedSystem(robot), data


def error(impacts: bool, degrees: float | None) -> tuple[float, StructuredFit]:
    """Mean absolute error of the friction of a new motion [N m]."""
    system, data = with_friction(impacts)
    priors = [forcegp.priors.JointFrictionPrior(load=False)]
    model = forcegp.StructuredGP(
        system,
        "analytical",
        priors,
        noise=forcegp.Noise(acceleration=0.1, torque=None, degrees_of_freedom=degrees),
    )
    fit = model.fit(data)
    q, qd, tau = torch.randn(3, 300, 2, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    truth = system.equations(q, qd).Q_K + tau - 0.8 * torch.tanh(qd / 0.02) - 0.3 * qd
    return float((fit.predict(q, qd, tau, "joint_force").mean - truth).abs().mean()), fit


def test_planted_impacts_hardly_count(tmp_path: Path) -> None:
    gaussian, _ = error(True, None)
    robust, model = error(True, 4.0)
    clean, _ = error(False, None)
    assert gaussian > 5.0 * clean, "impacts decide what a Gaussian likelihood learns"
    assert robust < 1.5 * clean
    assert model.training.weights is not None
    weights = model.training.weights[0]
    assert float(weights[::EVERY].max()) < 0.1
    assert float(weights.median()) > 0.8
    assert any("little weight" in warning for warning in model.result.warnings)
    model.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model")
    q, qd, tau = torch.randn(3, 5, 2, dtype=torch.float64)
    torch.testing.assert_close(again.predict(q, qd, tau).mean, model.predict(q, qd, tau).mean)


def test_without_impacts_little_is_lost() -> None:
    clean, _ = error(False, None)
    robust, model = error(False, 4.0)
    assert robust < 1.3 * clean
    assert model.training.weights is not None
    weights = model.training.weights[0]
    assert float((weights < 0.1).double().mean()) < 0.02


@pytest.mark.parametrize("degrees", [2.0, -1.0, float("nan")])
def test_degrees_that_are_not_valid(degrees: float) -> None:
    with pytest.raises(ModelError, match="degrees of freedom"):
        forcegp.StructuredGP(two_contacts(), "zero", noise=forcegp.Noise(degrees_of_freedom=degrees))
