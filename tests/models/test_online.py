"""Sparse fits that are updated and forget."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.errors import ModelError
from forcegp.forces.priors.joint import JointFrictionPrior
from forces.cases import draw, logged, mixed_contacts, two_contacts

SAME = 1e-8
"""Of sums in another order, through a factorisation of some dozens of basis functions."""
data = logged(two_contacts(), 24)


def model(inference: str = "sparse") -> forcegp.StructuredGP:
    return forcegp.StructuredGP(
        two_contacts(),
        "analytical",
        [JointFrictionPrior()],
        noise=forcegp.Noise(acceleration=0.1, torque=0.2),
        inference=inference,
    )


@pytest.mark.parametrize("inference", ["sparse", "exact"])
def test_an_update_is_a_refit(inference: str, tmp_path: Path) -> None:
    first = model(inference).fit(data[:16], learn=[])
    reference = first.condition(data)  # keeps the input scales of the first samples, as an update does
    grown = first.update(data[16:20]).update(data[20:])
    grown.save(tmp_path / "grown")
    grown = forcegp.load_model(tmp_path / "grown")
    q, qd, tau = draw(5, seed=3)
    for quantity in ("qdd", "multiplier"):
        a, b = (m.predict(q, qd, tau, quantity, active=mixed_contacts(5)) for m in (reference, grown))
        torch.testing.assert_close(a.mean, b.mean, rtol=SAME, atol=SAME)
        torch.testing.assert_close(a.covariance, b.covariance, rtol=SAME, atol=SAME)


def test_forgetting_returns_to_the_prior() -> None:
    before = model().fit(data, learn=[])
    after = before.forget(1e-9)
    q, qd, tau = draw(5, seed=3)
    spread = [fit.predict(q, qd, tau, "joint_force").variance for fit in (before, after)]
    assert bool((spread[1] > spread[0]).all())
    mean = two_contacts().equations(q, qd, torch.ones(5, 2, dtype=torch.bool)).Q_K + tau
    torch.testing.assert_close(after.predict(q, qd, tau, "joint_force").mean, mean, rtol=1e-4, atol=1e-4)


def test_what_cannot_be_updated() -> None:
    exact = model("exact").fit(data, learn=[])
    with pytest.raises(ModelError, match="exact inference cannot forget"):
        exact.forget(0.5)
    sparse = model().fit(data, learn=[])
    with pytest.raises(ModelError, match="invalid forgetting factor"):
        sparse.forget(0.0)
    with pytest.raises(ModelError, match="contains quantities that"):
        sparse.update([forcegp.priors.Observation(data[:2], "multiplier", 1.0)])


@pytest.mark.parametrize("inference", ["sparse", "exact"])
def test_samples_at_rest_change_no_fit_of_a_measured_robot(inference: str) -> None:
    """However few samples an update brings, those at rest only say that friction is below a limit."""
    spec = forcegp.StructuredGP(
        two_contacts(), "analytical", [JointFrictionPrior()], noise=0.1, inference=inference
    )
    fit = spec.fit(data, learn=[])
    still = dataclasses.replace(data[:3], qd=0.0 * data.qd[:3])
    assert fit.update(still) is fit
    both = forcegp.Dataset.concatenate([still, data[3:5]])
    q, qd, tau = draw(5, seed=3)
    one, other = (fit.update(new).predict(q, qd, tau, active=mixed_contacts(5)) for new in (both, data[3:5]))
    torch.testing.assert_close(one.mean, other.mean, rtol=SAME, atol=SAME)
    if inference == "sparse":
        assert fit.forget(still) is fit


def test_only_samples_that_were_added_can_be_forgotten(tmp_path: Path) -> None:
    fit = model().fit(data[:16], learn=[]).update(data[16:20])
    grown = fit.update(data[20:])
    states = draw(5, seed=3)
    for each in (grown, grown.forget(data[:4])):
        each.save(tmp_path / "model")
        loaded = forcegp.load_model(tmp_path / "model")
        assert isinstance(loaded, type(fit))
        back = loaded.forget(data[20:])
        same = fit if each is grown else fit.forget(data[:4])
        for a, b in zip(
            *((x.predict(*states).mean, x.predict(*states).covariance) for x in (back, same)), strict=True
        ):
            torch.testing.assert_close(a, b, rtol=SAME, atol=SAME)
        with pytest.raises(ModelError, match="4 of 4 samples to forget were never added"):
            back.forget(data[20:])
    with pytest.raises(ModelError, match="1 of 5 samples to forget were never added"):
        fit.forget(data[16:21])
    other = data.replace(tau=data.tau + 1e-9)
    with pytest.raises(ModelError, match="4 of 4 samples to forget were never added"):
        fit.forget(other[:4])
    with pytest.raises(ModelError, match="2 of 4 samples"):
        fit.forget(data[[3, 3, 3, 4]])
    with pytest.raises(ModelError, match="with their full weight"):
        fit.forget(0.9).forget(data[:4])
