"""A payload that is picked up is followed within a second of data, and a quiet arm does not forget it."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp import dynamics
from forcegp.errors import ModelError
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.models.following import follow
from forcegp.models.structured_fit import StructuredFit

RATE, STEP, JUMP = 100, 5, 200
"""Samples per second and per update [Hz, 1], and the sample at which the payload is picked up."""
NOISE = 0.1
MASS = 0.05
"""Error of the estimated mass [kg]; to first order alone it is 0.2 kg too small."""
AS_GOOD = 1.5
"""Ratio of the error to that of a fit which has only seen the loaded arm, for twice as long."""
FIRST_ORDER = 0.25
"""Ratio of errors with and without following; the prior is exact to first order in the payload."""


def _log(payload: float) -> forcegp.Dataset:
    """A slow motion of an arm whose last link carries a point mass at its centre of mass."""
    robot = forcegp.load_robot("kuka_iiwa")
    heavy = robot.replace(mass=robot.mass + payload * torch.eye(7, dtype=torch.float64)[-1])
    t = torch.arange(400, dtype=torch.float64)[:, None] / RATE
    rate = torch.linspace(1.0, 2.2, 7, dtype=torch.float64)
    middle = torch.tensor([0.0, 0.6, 0.0, -1.3, 0.0, 0.8, 0.0], dtype=torch.float64)
    q, qd = middle + 0.4 * torch.sin(rate * t), 0.4 * rate * torch.cos(rate * t)
    clean = -0.4 * rate**2 * torch.sin(rate * t)
    tau = dynamics.inverse_dynamics(heavy, q, qd, clean) + robot.damping * qd
    noise = NOISE * torch.randn(q.shape, dtype=q.dtype, generator=torch.Generator().manual_seed(0))
    return forcegp.Dataset(t[:, 0], q, qd, tau, clean + noise, robot.joint_names, extras={"qdd_clean": clean})


def _model() -> forcegp.StructuredGP:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("kuka_iiwa"))
    priors = [JointFrictionPrior(), PayloadPrior()]
    return forcegp.StructuredGP(system, "analytical", priors, noise=NOISE, inference="sparse")


def _error(fit: StructuredFit, data: forcegp.Dataset) -> float:
    predicted = fit.predict(data.q, data.qd, data.tau, covariance=False).mean
    return float((predicted - data.extras["qdd_clean"]).abs().mean())


def test_a_payload_is_followed_within_a_second() -> None:
    free, loaded = _log(0.0), _log(1.0)
    fit = _model().fit(free[:JUMP], learn=[])
    after = loaded[JUMP + RATE : JUMP + 2 * RATE]
    stale = _error(fit, after)
    changes = []
    for first in range(JUMP, JUMP + RATE, STEP):
        found = follow(fit, loaded[first : first + STEP], ["payload"])
        fit = found.fit
        changes += [first] if found.changed else []
    assert changes, "the payload is not noticed"
    assert changes[0] - JUMP < RATE // 4
    reference = _model().fit(loaded[:JUMP], learn=[])
    now = _error(fit, after)
    assert now < AS_GOOD * _error(reference, after) + 0.02
    assert now < FIRST_ORDER * stale
    one = {"one": torch.zeros(1, 1, dtype=torch.float64)}
    mass = fit.posterior.latent.latent_mean(1, one)[0, 0]
    assert float(mass) == pytest.approx(1.0, abs=MASS)


def test_nothing_changes_where_nothing_does() -> None:
    free = _log(0.0)
    first = fit = _model().fit(free[:JUMP], learn=[])
    for i in range(JUMP, JUMP + 100, STEP):
        found = follow(fit, free[i : i + STEP], ["payload"])
        assert not found.changed
        fit = found.fit
    reference = first.update(free[JUMP : JUMP + 100])
    test = free[300:]
    got, want = (m.predict(test.q, test.qd, test.tau) for m in (fit, reference))
    torch.testing.assert_close(got.mean, want.mean, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(got.covariance, want.covariance, rtol=1e-8, atol=1e-8)


def test_a_probability_is_a_probability() -> None:
    free = _log(0.0)
    fit = _model().fit(free[:50], learn=[])
    with pytest.raises(ModelError, match="invalid probability of a change"):
        follow(fit, free[50:52], ["payload"], change=1.0)
