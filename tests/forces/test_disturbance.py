"""Torques that are correlated in time, against the dense formula; what they do to a new motion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError
from forcegp.forces.priors.joint import DisturbancePrior, JointFrictionPrior
from forcegp.forces.problem import kernel_parameters
from forcegp.forces.quantities import affine_map
from forcegp.gp.kernels import OrnsteinUhlenbeck
from forcegp.models.structured_fit import StructuredFit
from forces.cases import draw, logged, mixed_contacts, two_contacts
from forces.textbook import Textbook

EXACT = 1e-9
STD, TIME = 2.0, 0.25
N = 10
SEGMENT = torch.arange(N) // 6


def two_runs() -> forcegp.Dataset:
    """Ten samples in two trajectories, whose clocks overlap."""
    data = logged(two_contacts(), N)
    return data.replace(t=0.1 * (torch.arange(N, dtype=torch.float64) - 6 * SEGMENT), segment=SEGMENT)


def model(priors: list, **settings: Any) -> forcegp.StructuredGP:
    return forcegp.StructuredGP(
        two_contacts(), "analytical", priors, noise=forcegp.Noise(acceleration=0.1, torque=None), **settings
    )


def conditioned(others: list) -> StructuredFit:
    """With a disturbance of `STD` and `TIME` at every joint."""
    found = model([*others, DisturbancePrior()]).fit(two_runs(), learn=[])
    values = dict(found.hyperparameters)
    values["disturbance.log_std"] = torch.full((7,), math.log(STD), dtype=torch.float64)
    values["disturbance.log_time"] = torch.full((7,), math.log(TIME), dtype=torch.float64)
    return found.condition(two_runs(), values)


def dense(B: Tensor) -> Tensor:
    """B K Bᵀ with K_ij = σ² exp(−|t_i − t_j|/T) within a trajectory, in as many rows as there are values."""
    t = two_runs().t
    k = STD**2 * torch.exp(-(t[:, None] - t).abs() / TIME) * (SEGMENT[:, None] == SEGMENT)
    return torch.einsum("iab,ij,jcb->iajc", B, k, B).reshape(B.shape[0] * 7, -1)


def test_likelihood_is_the_dense_one() -> None:
    found = conditioned([JointFrictionPrior()])
    plain = model([JointFrictionPrior()], inference="exact").fit(two_runs(), learn=[])
    plain = plain.condition(two_runs(), {k: v for k, v in found.hyperparameters.items() if "friction" in k})
    y, noise, maps = (book := Textbook(plain)).data()
    m = found.training.measurements[0]
    K = book.gram(maps) + torch.diag(noise) + dense(affine_map(found.system, m.at(found.system), "qdd").B_Q)
    L = torch.linalg.cholesky(K)
    alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
    expected = -float(0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi))
    assert found.result.log_marginal_likelihood == pytest.approx(expected, rel=EXACT)


def test_gradient() -> None:
    found = conditioned([JointFrictionPrior()])
    problem, values = found.problem, dict(found.hyperparameters)

    def objective(part: dict[str, Tensor]) -> Tensor:
        return problem.negative_log_likelihood(kernel_parameters({**values, **part}), problem.fixed_rows)

    keys = ["disturbance.log_std", "disturbance.log_time"]
    leaves = {key: values[key].clone().requires_grad_() for key in keys}
    for key, got in zip(keys, torch.autograd.grad(objective(leaves), list(leaves.values())), strict=True):
        step = torch.zeros(7, dtype=torch.float64)
        step[3] = 1e-5
        up, down = (objective({key: values[key] + s * step}) for s in (1.0, -1.0))
        assert float(got[3]) == pytest.approx(float(up - down) / 2e-5, rel=1e-5)


def test_a_new_motion_sees_it_as_variance(tmp_path: Path) -> None:
    found = conditioned([JointFrictionPrior()])
    q, qd, tau = draw(3, seed=5)
    at = found.system.equations(q, qd, mixed_contacts(3))
    predicted = found.predict(q, qd, tau, active=mixed_contacts(3))
    friction = found.posterior
    own = friction.rows(
        found.system,
        found.training.measurements[0][torch.arange(1)].at(found.system),
        affine_map(
            found.system, found.training.measurements[0][torch.arange(1)].at(found.system), "joint_force"
        ),
    )
    seen = friction.latent.covariance(own)[0].diagonal()
    assert bool((seen < STD**2).all()), "where it was measured it is known better"
    assert predicted.variance is not None
    small = found.predict(0 * q, 0 * qd, 0 * tau, "joint_force", active=mixed_contacts(3)).variance
    assert small is not None
    assert bool((small >= STD**2 * (1.0 - EXACT)).all())
    least = ((at.H * STD**2) @ at.H.mT).diagonal(dim1=-2, dim2=-1)
    assert bool((predicted.variance >= least * (1.0 - 1e-6)).all())
    found.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model").predict(q, qd, tau, active=mixed_contacts(3))
    torch.testing.assert_close(again.mean, predicted.mean)
    torch.testing.assert_close(again.covariance, predicted.covariance, rtol=1e-7, atol=1e-9)


def test_draws_have_its_covariance() -> None:
    """Random features: correlated within a trajectory, independent between two."""
    kernel, generator = OrnsteinUhlenbeck(), torch.Generator().manual_seed(0)
    params = {key: value.clone() for key, value in kernel.initial(1, {}).items()}
    x = {
        "time": torch.tensor([[0.0], [0.5], [2.0], [0.0]], dtype=torch.float64),
        "segment": torch.tensor([[0.0], [0.0], [0.0], [3.0]], dtype=torch.float64),
    }
    basis = kernel.draw(params, x, 200_000, generator).basis(x)[0]
    torch.testing.assert_close(basis @ basis.mT, kernel.covariance(params, x, x)[0], rtol=0, atol=0.015)


def test_sparse_inference_refuses_it() -> None:
    with pytest.raises(ModelError, match="assumes independent samples"):
        model([DisturbancePrior()], inference="sparse").fit(two_runs(), learn=[])


def test_a_time_that_is_not_positive() -> None:
    with pytest.raises(ModelError, match="correlation time"):
        OrnsteinUhlenbeck(time=0.0)


@pytest.mark.slow
def test_disturbances_are_learned_and_keep_friction_honest() -> None:
    """Six trajectories with disturbances of 0.5 N m for 0.5 s: their size, their time, friction's error."""
    generator = torch.Generator().manual_seed(2)
    robot = forcegp.load_robot("double_pendulum")
    n, dt = 240, 0.05
    segment = torch.arange(n) // 40
    q, qd, qdd = (torch.randn(n, 2, generator=generator, dtype=torch.float64) for _ in range(3))
    d, keep = torch.zeros(n, 2, dtype=torch.float64), math.exp(-dt / 0.5)
    for i in range(n):
        u = 0.5 * torch.randn(2, generator=generator, dtype=torch.float64)
        d[i] = u if i % 40 == 0 else keep * d[i - 1] + math.sqrt(1.0 - keep**2) * u
    force = -0.8 * torch.tanh(qd / 0.02) - 0.3 * qd
    tau = forcegp.dynamics.inverse_dynamics(robot, q, qd, qdd) - force - d
    data = forcegp.Dataset(
        t=dt * torch.arange(n, dtype=torch.float64), q=q, qd=qd, qdd=qdd, tau=tau, segment=segment,
        joint_names=robot.joint_names,
    )  # fmt: skip
    system = forcegp.ConstrainedSystem(robot)
    priors = [JointFrictionPrior(load=False), DisturbancePrior(OrnsteinUhlenbeck(time=0.1))]
    fit = forcegp.StructuredGP(system, "analytical", priors, noise=0.02).fit(data)
    std, time = (fit.hyperparameters[f"disturbance.log_{key}"].exp() for key in ("std", "time"))
    assert bool(((std / 0.5 - 1.0).abs() < 0.25).all()), std
    assert bool(((time / 0.5).log().abs() < 0.6).all()), time
    q, qd, tau = (torch.randn(100, 2, generator=generator, dtype=torch.float64) for _ in range(3))
    Q = fit.predict(q, qd, tau, "joint_force")
    assert Q.std is not None
    eom = system.equations(q, qd)
    truth = eom.Q_K + tau - 0.8 * torch.tanh(qd / 0.02) - 0.3 * qd
    # A dozen correlation times show the offset of friction to about 0.5/√12, and the posterior says so.
    assert Q.variance is not None
    of_friction = Q.variance - std**2
    assert 0.05 < float(of_friction.sqrt().mean()) < 0.25
    assert 0.1 < float(((Q.mean - truth) ** 2 / of_friction).mean()) < 4.0
    assert bool(((Q.std / 0.5 - 1.0).abs() < 0.35).all()), "the disturbance of a new motion is unknown"
