"""A force that no law names is learned from what the laws leave."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.forces.measurements import observations_of
from forcegp.forces.priors.memory import Past, bristles
from forcegp.forces.priors.sets import friction_priors
from forcegp.gp.sums import Sums, without_feedback
from forcegp.models.structured_fit import StructuredFit

FIRST, LATER = 5, 3


def sums(seed: int = 0) -> Sums:
    generator = torch.Generator().manual_seed(seed)
    Phi = torch.randn(40, FIRST + LATER, generator=generator, dtype=torch.float64)
    y = torch.randn(40, generator=generator, dtype=torch.float64)
    zero = torch.zeros(1, dtype=torch.float64)
    return Sums(Phi.mT @ y, y @ y, torch.tensor(40.0), zero, zero, Phi.mT @ Phi)


def weights(of: Sums) -> Tensor:
    return torch.linalg.solve(of.G + torch.eye(len(of.G), dtype=of.G.dtype), of.v)


def test_later_weights_do_not_change_the_first_ones() -> None:
    later = torch.arange(FIRST, FIRST + LATER)
    whole = sums()
    cut = weights(without_feedback(whole, later))
    G, v = whole.G[:FIRST, :FIRST], whole.v[:FIRST]
    w = torch.linalg.solve(G + torch.eye(FIRST, dtype=G.dtype), v)
    torch.testing.assert_close(cut[:FIRST], w)
    # ridge regression of the later weights on the residuals of the first ones
    left = whole.v[FIRST:] - whole.G[FIRST:, :FIRST] @ w
    eye = torch.eye(LATER, dtype=G.dtype)
    torch.testing.assert_close(cut[FIRST:], torch.linalg.solve(whole.G[FIRST:, FIRST:] + eye, left))
    assert without_feedback(whole, later[:0]) is whole


def test_bars_of_the_first_weights_contain_the_later_force() -> None:
    """Their covariance is that of both learned together, and their mean does not change."""
    later, whole = torch.arange(FIRST, FIRST + LATER), sums()
    wide, eye = without_feedback(whole, later, True), torch.eye(FIRST + LATER, dtype=torch.float64)
    torch.testing.assert_close(weights(wide), weights(without_feedback(whole, later)))
    marginal, both = (torch.linalg.inv(x.G + eye)[:FIRST, :FIRST] for x in (wide, whole))
    torch.testing.assert_close(marginal, both)


def logged(force: float, seconds: float = 60.0, seed: int = 0) -> tuple[forcegp.Dataset, Tensor]:
    """A pendulum with friction, ripple and a force on (q, q̇) that no law names; and its accelerations."""
    robot = forcegp.load_robot("double_pendulum")
    generator = torch.Generator().manual_seed(seed)
    w, phase = torch.rand(2, 5, 2, generator=generator, dtype=torch.float64)
    t = 0.005 * torch.arange(round(seconds / 0.005), dtype=torch.float64)
    angle = (0.3 + 2.0 * w) * t[:, None, None] + 6.28 * phase
    q, qd = 0.4 * angle.sin().sum(1), 0.4 * ((0.3 + 2.0 * w) * angle.cos()).sum(1)
    qdd = -0.4 * ((0.3 + 2.0 * w) ** 2 * angle.sin()).sum(1)
    noise = torch.randn(2, len(t), 2, generator=generator, dtype=torch.float64)
    tau = forcegp.dynamics.inverse_dynamics(robot, q, qd, qdd) - forcegp.dynamics.damping_force(robot, qd)
    tau = tau + 0.3 * qd + 0.5 * torch.tanh(qd / 0.02) + 0.3 * torch.sin(30.0 * q) + 0.1 * noise[0]
    tau = tau + force * torch.sin(1.5 * q + q.flip(-1)) * (1.0 + 0.3 * qd.flip(-1))
    return forcegp.Dataset(t, q, qd, tau, qdd + 0.05 * noise[1], robot.joint_names), qdd


def torque_error(fit: StructuredFit, force: float) -> float:
    test, exact = logged(force, 10.0, seed=1)
    M = forcegp.dynamics.mass_matrix(fit.system.robot, test.q)
    error = fit.predict(test.q, test.qd, test.tau).mean - exact
    return float((M @ error[..., None]).square().mean().sqrt())


def test_defaults_learn_ripple_and_an_unnamed_force(tmp_path: Path) -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    data, _ = logged(1.0)
    fit = forcegp.StructuredGP(system).fit(data)
    worth, names = fit.result.worth, [prior.name for prior in fit.force_priors]
    assert {"ripple", "residual"} <= set(names)
    assert all(worth[f"ripple of {joint}"] > 5.0 for joint in data.joint_names)
    assert any(worth[f"residual of {joint}"] > 5.0 for joint in data.joint_names)
    laws = forcegp.StructuredGP(system, force_priors=friction_priors(system), inertia="auto").fit(data)
    assert torque_error(fit, 1.0) < 0.8 * torque_error(laws, 1.0)
    # the learned terms survive a file, and conditioning on another log
    fit.save(tmp_path / "model")
    loaded = forcegp.load_model(tmp_path / "model")
    state = data.q[:5], data.qd[:5], data.tau[:5]
    torch.testing.assert_close(loaded.predict(*state).mean, fit.predict(*state).mean)
    one, two = fit.predict(*state), fit.compiled().predict(*state)
    torch.testing.assert_close(two.mean, one.mean, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(two.covariance, one.covariance, rtol=1e-6, atol=1e-8)
    assert [prior.name for prior in fit.condition(data[:4000]).force_priors] == names


def test_without_such_a_force_there_is_no_residual() -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    fit = forcegp.StructuredGP(system).fit(logged(0.0)[0])
    assert "residual" not in [prior.name for prior in fit.force_priors]


def test_the_order_of_rows_has_no_effect_on_a_fit() -> None:
    # Without order, held-out blocks contain neighbours of the samples, and noise is kept as a force.
    data, _ = logged(0.0)
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    shuffled = data[torch.randperm(len(data), generator=torch.Generator().manual_seed(0))]
    assert not shuffled.header.ordered
    one, two = (forcegp.StructuredGP(system).fit(each).predict_log(data) for each in (data, shuffled))
    assert torch.equal(one.mean, two.mean) and torch.equal(one.std, two.std)


def test_noise_of_each_row_moves_with_its_row() -> None:
    data, _ = logged(0.0)
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
    noise = 1.0 + data.q.square()
    (sorted_,) = observations_of([forcegp.priors.Observation(data[order], noise_std=noise[order])])
    assert torch.equal(sorted_.data.t, data.t) and torch.equal(torch.as_tensor(sorted_.noise_std), noise)


@pytest.mark.parametrize("cut", [1, 137, 400])
def test_bristles_continue_from_piece_to_piece(cut: int) -> None:
    data, _ = logged(0.0, 3.0)
    segment = (torch.arange(len(data)) >= 300).long()
    whole = bristles(data.t, data.qd, segment)
    past = Past(data.t[cut - 1 : cut], data.qd[cut - 1 : cut], segment[cut - 1 : cut], whole[cut - 1 : cut])
    rest = bristles(data.t[cut:], data.qd[cut:], segment[cut:], past)
    torch.testing.assert_close(rest, whole[cut:], rtol=1e-9, atol=1e-12)
