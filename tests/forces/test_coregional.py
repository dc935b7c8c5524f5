"""Correlated joint forces: likelihood and gradient against the dense formula, exact and sparse; recovery."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError
from forcegp.forces.problem import kernel_parameters
from forcegp.forces.quantities import affine_map
from forcegp.models.structured_fit import StructuredFit
from forces.cases import draw, logged, mixed_contacts, two_contacts

N = 9
EXACT = 1e-9


def conditioned(**settings: Any) -> StructuredFit:
    """With two causes, random W and κ."""
    model = forcegp.StructuredGP(
        two_contacts(), "analytical", [forcegp.CoregionalPrior(causes=2)], noise=0.1, **settings
    )
    model = model.fit(logged(two_contacts(), N), learn=[])
    generator = torch.Generator().manual_seed(3)
    values = {
        key: x + 0.4 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
        for key, x in model.hyperparameters.items()
    }
    model = model.condition(logged(two_contacts(), N), values)
    return model


def dense(model: StructuredFit, values: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Negative log likelihood, and mean of q̈ at the training states, of K ⊗ (W Wᵀ + diag κ)."""
    fit, m = model, model.training.measurements[0]
    at = m.at(fit.system)
    x = torch.cat([model.training.scales[0].apply({"q": m.q, "qd": m.qd})[k] for k in ("q", "qd")], -1)
    length = values["coregional.log_lengthscale"].exp()[0]
    k = torch.exp(-0.5 * (((x[:, None] - x) / length) ** 2).sum(-1))
    std, W = values["coregional.log_std"].exp(), values["coregional.mixing"]
    W = W / W.norm(dim=0) * std[:2]
    C = W @ W.T + torch.diag(std[2:] ** 2)
    z = affine_map(fit.system, at, "qdd")
    K = torch.einsum("iab,ij,bc,jdc->iajd", z.B_Q, k, C, z.B_Q).reshape(7 * N, 7 * N)
    mean = at.eom.acceleration(at.eom.Q_K + m.tau).reshape(-1)
    y = m.values.reshape(-1) - mean
    L = torch.linalg.cholesky(K + 0.01 * torch.eye(7 * N, dtype=torch.float64))
    alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
    nll = 0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi)
    return nll, (mean + K @ alpha).reshape(N, 7)


def test_likelihood_and_mean_are_the_dense_ones() -> None:
    model = conditioned(inference="exact")
    nll, mean = dense(model, dict(model.hyperparameters))
    assert model.result.log_marginal_likelihood == pytest.approx(-float(nll), rel=EXACT)
    m = model.training.measurements[0]
    found = model.predict(m.q, m.qd, m.tau, active=m.active).mean
    torch.testing.assert_close(found, mean, rtol=1e-8, atol=1e-8)


def test_gradient() -> None:
    model = conditioned(inference="exact")
    problem, values = model.problem, {k: x.clone() for k, x in model.hyperparameters.items()}
    leaves, again = ({key: x.clone().requires_grad_() for key, x in values.items()} for _ in range(2))
    objective = problem.negative_log_likelihood(kernel_parameters(leaves), problem.rows_for(leaves, {}))
    found = dict(zip(leaves, torch.autograd.grad(objective, list(leaves.values())), strict=True))
    expected = torch.autograd.grad(dense(model, again)[0], list(again.values()))
    for (key, got), want in zip(found.items(), expected, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-6, msg=key)


def test_sparse_inference_with_all_points_is_exact(tmp_path: Path) -> None:
    one, two = conditioned(inference="exact"), conditioned(inference="sparse", inducing_points=N)
    q, qd, tau = draw(4, seed=2)
    for quantity in ("qdd", "joint_force"):
        a, b = (f.predict(q, qd, tau, quantity, active=mixed_contacts(4)) for f in (one, two))
        torch.testing.assert_close(a.mean, b.mean, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(a.covariance, b.covariance, rtol=1e-4, atol=1e-5)
    for i, model in enumerate((one, two)):
        model.save(tmp_path / str(i))
        again = forcegp.load_model(tmp_path / str(i)).predict(q, qd, tau, active=mixed_contacts(4))
        torch.testing.assert_close(again.mean, model.predict(q, qd, tau, active=mixed_contacts(4)).mean)


def test_a_cause_of_two_joints_is_found_and_predicted_better() -> None:
    """Q_2 = −1.5 Q_1, with little noise at joint 1 and much at joint 2: the first tells of the second."""
    generator = torch.Generator().manual_seed(6)
    robot = forcegp.load_robot("double_pendulum")
    q, qd, tau, noise = (torch.randn(60, 2, generator=generator, dtype=torch.float64) for _ in range(4))

    def cause(q: Tensor, qd: Tensor) -> Tensor:
        g = 2.0 * torch.sin(1.5 * q[:, :1]) * torch.cos(q[:, 1:]) + 0.5 * qd[:, :1]
        return torch.cat([g, -1.5 * g], dim=-1)

    noise_std = torch.tensor([0.05, 10.0], dtype=torch.float64)
    qdd = forcegp.dynamics.forward_dynamics(robot, q, qd, tau + cause(q, qd)) + noise_std * noise
    t = torch.arange(60, dtype=torch.float64)
    data = forcegp.Dataset(t=t, q=q, qd=qd, tau=tau, qdd=qdd, joint_names=robot.joint_names)
    system = forcegp.ConstrainedSystem(robot)
    kernel = forcegp.CoregionalPrior().kernel
    errors = {}
    for prior in (forcegp.CoregionalPrior(), forcegp.JointForcePrior(kernel, inputs=("q", "qd"))):
        model = forcegp.StructuredGP(
            system,
            "analytical",
            [prior],
            noise=forcegp.Noise(acceleration=(0.05, 10.0), torque=None),
        )
        model = model.fit(data)
        new = torch.Generator().manual_seed(8)
        q, qd, tau = (torch.randn(200, 2, generator=new, dtype=torch.float64) for _ in range(3))
        found = model.predict(q, qd, tau, "joint_force").mean - system.equations(q, qd).Q_K - tau
        errors[prior.name] = float((found - cause(q, qd)).abs()[:, 1].mean())
        if prior.name == "coregional":
            W = model.hyperparameters["coregional.mixing"][:, 0]
            assert float(W[1] / W[0]) == pytest.approx(-1.5, rel=0.15)
    assert errors["coregional"] < 0.7 * errors["joint"], errors


def test_a_force_without_a_cause() -> None:
    with pytest.raises(ModelError, match="needs at least one cause"):
        forcegp.CoregionalPrior(causes=0)
