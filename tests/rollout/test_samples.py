"""Function samples along a trajectory, the probability of lost contact, and comparisons with a log."""

import dataclasses
import math
from functools import cache

import pytest
import torch

from forcegp.constraints import Baumgarte, ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import DataError, ModelError
from forcegp.forces.posterior import draw_samples
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.priors.sets import default_priors
from forcegp.forces.quantities import states
from forcegp.gp.optimise import LearningOptions
from forcegp.models.analytical import AnalyticalFit, AnalyticalModel
from forcegp.models.base import FittedModel
from forcegp.models.registry import create
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.report.animation import animation_source
from forcegp.report.rollouts import PAGE, RolloutData, rollout_data, write_rollouts
from forcegp.rollout import (
    Comparison,
    ForceLaw,
    RolloutOptions,
    beside_log,
    compare,
    contact_loss_probability,
    rollout,
)
from rollout_cases import arm, simulated

DRIFT = 1e-4
"""Bound of the constraint error of every sample with Baumgarte's terms [m]."""
NEWTON = 1e-8
"""Largest residual of Newton's equation [N m]; torques are of order a hundred."""


def log() -> Dataset:
    return simulated(viscous_friction=1.0).data


@cache
def fitted(mean: str = "analytical") -> StructuredFit:
    system = arm(Baumgarte())
    model = StructuredGP(system, mean, default_priors(system, mean), noise=0.1)
    model = model.fit(log()[torch.arange(0, 288, 7)], options=LearningOptions(max_evaluations=15))
    return model


def test_each_sample_obeys_the_constraint_and_newtons_equation() -> None:
    data = log()
    found = fitted().rollout(data.q[0], data.qd[0], data, 0.15, samples=5).need_samples()
    assert found.q.shape == (5, 37, 7)
    assert float(found.drift.abs().max()) < DRIFT
    eom = found.system.equations(found.q, found.qd)
    assert float(((eom.A @ found.qdd[..., None])[..., 0] - eom.b).abs().max()) < NEWTON
    # What is left of M q̈ − Aᵀλ is the sampled force, which is the same function at every time.
    force = (eom.M @ found.qdd[..., None])[..., 0] - (eom.A.mT @ found.multiplier[..., None])[..., 0]
    drawn = draw_samples(fitted().posterior, 5, torch.Generator().manual_seed(0))
    for k in (0, 20, 36):
        active = torch.ones(5, 1, dtype=torch.bool)
        at = states(found.system, found.q[:, k], found.qd[:, k], found.tau[:, k], active)
        assert float((drawn(found.system, at) - force[:, k]).abs().max()) < NEWTON


def test_a_seed_fixes_the_samples_and_a_sample_is_a_model_of_its_own() -> None:
    data, model = log(), fitted()

    def roll(seed: int) -> torch.Tensor:
        path = model.rollout(data.q[0], data.qd[0], data, 0.05, samples=3, seed=seed)
        return path.need_samples().q

    assert torch.equal(roll(1), roll(1))
    assert not torch.equal(roll(1), roll(2))
    force = model.force_samples(3, torch.Generator().manual_seed(1))
    start = data.q[0].expand(3, 7)
    alone = rollout(ForceLaw(force), model.system, start, 0.0 * start + data.qd[0], data, 0.05)
    assert torch.equal(alone.q, roll(1))


def test_batches_of_states_and_samples_keep_their_order() -> None:
    data, model = log(), fitted()
    rows = torch.tensor([0, 60])
    tau = torch.stack([data.tau[r : r + 13] for r in rows.tolist()])
    options = RolloutOptions(dt=1.0 / 240.0)
    both = model.rollout(data.q[rows], data.qd[rows], tau, 0.05, samples=4, seed=3, options=options)
    assert both.need_samples().q.shape == (4, 2, 13, 7)
    for i in range(2):
        alone = model.rollout(
            data.q[rows[i]], data.qd[rows[i]], tau[i], 0.05, samples=4, seed=3, options=options
        )
        assert torch.allclose(both[i].q, alone.q, atol=1e-10, rtol=0.0)
        assert torch.allclose(both.need_samples().q[:, i], alone.need_samples().q, atol=1e-9, rtol=0.0)


def test_the_spread_of_samples_is_the_posterior_s() -> None:
    """Before any time has passed, sampled multipliers are draws from N(μ, σ²)."""
    data, model = log(), fitted("zero")
    path = model.rollout(data.q[3], data.qd[3], data[3:], 1.0 / 240.0, samples=400)
    drawn = path.need_samples().multiplier[:, 0, 0]
    expected = model.predict(data.q[3], data.qd[3], data.tau[3], "multiplier")
    assert expected.std is not None
    std = float(expected.std)
    assert float(drawn.mean()) == pytest.approx(float(expected.mean), abs=4.0 * std / 20.0)
    assert float(drawn.std()) == pytest.approx(std, rel=0.2)
    lower, upper, median = path.bands(drawn)
    assert float(lower) < float(median) < float(upper)


def test_probability_of_lost_contact_is_that_of_the_posterior_draws() -> None:
    """Pulled by the table's own reaction, half of the posterior lies below zero."""
    data, model = log(), fitted("zero")
    q, qd, tau = data.q[:3], data.qd[:3], data.tau[:3]
    found = model.predict(q, qd, tau, "multiplier")
    assert found.std is not None
    draws = (
        found.mean + found.std * torch.randn(20000, 3, 1, generator=torch.Generator().manual_seed(0)).double()
    )
    share = (draws < 0.0).double().mean(0)
    assert torch.allclose(contact_loss_probability(model, q, qd, tau), share, atol=0.02)


def test_a_contact_that_sticks_is_lost_by_its_normal_force_alone() -> None:
    data, system = log(), fitted("zero").system
    held = [dataclasses.replace(contact, stick_speed=0.005) for contact in system.contacts]
    held = ConstrainedSystem(system.robot, held, system.baumgarte)
    model = StructuredGP(held, "analytical", [JointFrictionPrior()], noise=0.1).fit(data[:400])
    q, tau = data.q[:3], data.tau[:3]
    found = model.predict(q, torch.zeros_like(q), tau, "multiplier")
    assert found.std is not None and bool((found.mean < 0.0).any())
    loss = contact_loss_probability(model, q, torch.zeros_like(q), tau)
    expected = torch.distributions.Normal(found.mean[:, :1], found.std[:, :1]).cdf(torch.zeros(1).double())
    assert torch.allclose(loss, expected, atol=1e-12)


def test_a_contact_that_is_open_is_lost() -> None:
    data, model = log(), fitted("zero")
    q, qd, tau = data.q[:2], data.qd[:2], data.tau[:2]
    active = torch.tensor([[True], [False]])
    loss = contact_loss_probability(model, q, qd, tau, active=active)
    alone = contact_loss_probability(model, q[:1], qd[:1], tau[:1])
    assert torch.allclose(loss[:1], alone, atol=1e-6) and 0.0 < float(alone) < 1.0
    assert float(loss[1]) == 1.0


@pytest.mark.parametrize("name", ["gp", "nn"])
def test_a_model_of_accelerations_stays_on_its_own_system(name: str) -> None:
    data, model = log(), create(name, arm(Baumgarte()), noise=0.1)
    model = model.fit(data[torch.arange(0, 288, 24)])
    free = ConstrainedSystem(model.system.robot)
    with pytest.raises(ModelError, match="predicts accelerations only for the system to which it was fitted"):
        model.rollout(data.q[0], data.qd[0], data, 0.02, system=free)
    softer = dataclasses.replace(model.system, baumgarte=None)
    assert torch.isfinite(model.rollout(data.q[0], data.qd[0], data, 0.02, system=softer).q).all()


def test_a_learned_model_loses_no_contact_while_it_slides() -> None:
    """Neither its mean nor any sample opens a contact that stays closed in simulation."""
    data = log()
    options = RolloutOptions(unilateral=True)
    path = fitted().rollout(data.q[0], data.qd[0], data, 0.5, samples=8, options=options)
    for found in (path, path.need_samples()):
        assert not found.events and bool(found.active.all())
    assert float(contact_loss_probability(fitted(), data.q, data.qd, data.tau).max()) < 1e-3


def test_models_without_a_posterior_say_so() -> None:
    data, plain = log(), AnalyticalModel(arm(Baumgarte())).nominal()
    with pytest.raises(ModelError, match="does not predict the uncertainty of the multiplier"):
        contact_loss_probability(plain, data.q[0], data.qd[0], data.tau[0])
    with pytest.raises(ModelError, match="no function samples"):
        plain.rollout(data.q[0], data.qd[0], data, 0.02, samples=2)
    with pytest.raises(ModelError, match="pass samples=100"):
        plain.rollout(data.q[0], data.qd[0], data, 0.02).need_samples()


class Freefloating(AnalyticalFit):
    """A model of accelerations alone, that knows of no surface."""

    def force_field(self) -> None:
        return None

    def predict(self, q, qd, tau, quantity="qdd", *, active=None, covariance=True, system=None):
        return super().predict(q, qd, tau, "qdd_free", active=active, covariance=covariance)


def test_comparison_tells_models_apart_and_the_page_holds_them(tmp_path, monkeypatch) -> None:
    system = arm(Baumgarte())
    plain = AnalyticalModel(system).nominal()
    models: dict[str, FittedModel] = {
        "analytical": plain,
        "nn": Freefloating(**vars(plain)),
        "sgp-mean": fitted(),
    }
    found = compare(models, log(), 0.3, starts=2, samples=3)
    assert found.error_at("sgp-mean", 0.25) < found.error_at("analytical", 0.25)
    assert found.error_at("analytical", 0.25) < found.error_at("nn", 0.25)
    assert 0.0 <= found.coverage("sgp-mean") <= 1.0
    factor = found.inflation("sgp-mean", 0.5)
    assert found.coverage("sgp-mean", 0.5, 1.001 * factor) >= 0.5
    assert found.inflation("sgp-mean") == math.inf, "two trajectories cannot calibrate a 90 % band"
    again = compare({"sgp-mean": models["sgp-mean"]}, log(), 0.3, torch.tensor([0, 215]), 3)
    assert torch.equal(again.predicted_tip("sgp-mean"), found.predicted_tip("sgp-mean"))
    start = found.predicted_tip("analytical")[:, 0]
    assert torch.allclose(start, simulated(1.0).position[[0, 215]], atol=1e-12)
    data = rollout_data(found)
    assert RolloutData.from_json(data.to_json(), "test", DataError) == data
    path = rollout_data(found, found).models[2]
    assert path.inflation is path.calibrated_coverage is None
    with monkeypatch.context() as enough:
        enough.setattr(Comparison, "inflation", lambda *_: 2.0)
        path = rollout_data(found, found).models[2]
        assert path.inflation == 2.0
        assert path.calibrated_coverage == found.coverage("sgp-mean", inflation=2.0)
    nn = data.models[1]
    assert nn.multiplier == [] and nn.drift[-1] < -1e-3, "it sinks through the table"
    page = write_rollouts(tmp_path, "Test", data).read_text()
    assert (tmp_path / PAGE).stat().st_size < 2_000_000
    assert page.count("<img") == 4 and "<canvas" in page
    assert f"script-src '{animation_source()}'" in page, "the page's policy lets its own script run"
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_a_rollout_beside_its_log() -> None:
    data = log()[:61]
    path = fitted().rollout(data.q[0], data.qd[0], data, 0.25)
    found = beside_log("sgp-mean", path, data, 1.0 / 240.0)
    expected = (path.tip(found.frame, found.point) - found.tip[0]).norm(dim=-1)
    assert torch.allclose(found.tip_error("sgp-mean")[0], expected)


def test_a_selected_log_cannot_be_compared_with() -> None:
    data = log()
    models: dict[str, FittedModel] = {"analytical": AnalyticalModel(arm(Baumgarte())).nominal()}
    with pytest.raises(DataError, match="too short"):
        compare(models, data, 50.0)
    with pytest.raises(DataError, match="too short"):
        compare(models, data, 0.1, torch.tensor([0, len(data) - 2]))
    with pytest.raises(DataError, match="time order"):
        compare(models, data[torch.randperm(len(data), generator=torch.Generator().manual_seed(0))], 0.1)


def test_projection_holds_every_sample_on_the_surface() -> None:
    data = log()
    options = RolloutOptions(stabilization="projection")
    path = fitted().rollout(data.q[0], data.qd[0], data, 0.1, samples=3, options=options)
    assert max(float(x.drift[..., 1:, :].abs().max()) for x in (path, path.need_samples())) < 1e-10
