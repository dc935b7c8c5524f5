"""Noise of the state under learned forces: covariance by Monte Carlo, and fits to pendulums with springs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.noise import learned_slopes, state_jacobian
from forcegp.forces.priors.sets import default_priors
from forcegp.forces.quantities import States, states
from forcegp.learning import fit as steps
from forcegp.learning import noise_learning
from forcegp.models.structured_fit import StructuredFit
from forces.cases import draw, mixed_contacts, two_contacts

Q_STD, QD_STD, SAMPLES = 0.02, 0.01, 100
DRAWS, STATES = 4000, 4
SAMPLED = 0.08
"""Relative error of a covariance of at most 7 components from 4000 draws, about √(7/4000), doubled."""
SEEDS = (1, 2)
BETTER = 0.8
"""Learned slopes divide the mean error over the seeds by 1.25 at least."""


def spring(q: Tensor, qd: Tensor) -> Tensor:
    """A stiff spring and damping that no robot file knows."""
    return -20.0 * torch.sin(2.0 * q) - 0.5 * qd


def stiff(system: forcegp.ConstrainedSystem, at: States) -> Tensor:
    """All impressed forces, ten times the spring among them."""
    return at.eom.Q_K + at.tau + 10.0 * spring(at.q, at.qd)


@pytest.mark.parametrize("quantity", ["qdd", "multiplier"])
def test_covariance_is_that_of_sampled_states(quantity: str) -> None:
    system, (q, qd, tau), active = two_contacts(), draw(STATES), mixed_contacts(STATES)
    m = Measurement(quantity, q, qd, tau, active, torch.zeros(STATES, 7 if quantity == "qdd" else 2))
    std = torch.cat([torch.full((7,), 1e-4), torch.full((7,), 1e-3)]).double()
    generator = torch.Generator().manual_seed(1)
    delta = std * torch.randn(DRAWS, STATES, 14, generator=generator, dtype=torch.float64)
    moved = ((q + delta[..., :7]).reshape(-1, 7), (qd + delta[..., 7:]).reshape(-1, 7))
    at = states(system, *moved, tau.repeat(DRAWS, 1), active.repeat(DRAWS, 1))
    F = stiff(system, at)
    z = at.eom.acceleration(F) if quantity == "qdd" else at.eom.multiplier(F)
    z = z.reshape(DRAWS, STATES, -1)
    z = z - z.mean(0)
    sampled = torch.einsum("sni,snj->nij", z, z) / (DRAWS - 1)

    def apart(G: Tensor | None) -> Tensor:
        assert G is not None
        off = (G * std**2) @ G.mT - sampled
        size = sampled.flatten(1).norm(dim=1)
        return off.flatten(1).norm(dim=1)[size > 0.0] / size[size > 0.0]

    training = learned_slopes(Training((m,), (), ()), system, stiff)
    assert training.slopes is not None
    assert apart(training.slopes[0]).max() < SAMPLED
    assert apart(state_jacobian(system, m)).min() > 2.0 * SAMPLED  # the file does not know the spring


def pendulum() -> forcegp.ConstrainedSystem:
    return forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))


def measured(seed: int, samples: int = SAMPLES, noisy: bool = True) -> tuple[forcegp.Dataset, Tensor]:
    """A double pendulum with springs, measured at noisy states, and its noise-free accelerations."""
    system, generator = pendulum(), torch.Generator().manual_seed(seed)
    normal = torch.randn(6, samples, 2, generator=generator, dtype=torch.float64)
    q, qd, tau = normal[0], 0.5 * normal[1], normal[2]
    eom = system.equations(q, qd)
    truth = eom.acceleration(eom.Q_K + tau + spring(q, qd))
    if noisy:
        q, qd = q + Q_STD * normal[3], qd + QD_STD * normal[4]
    t = torch.arange(samples, dtype=torch.float64)
    return forcegp.Dataset(t, q, qd, tau, truth + 0.1 * normal[5], system.robot.joint_names), truth


def model(mean: str = "analytical", inference: str = "auto") -> forcegp.StructuredGP:
    noise = forcegp.Noise(0.1, torque=None, state=(Q_STD, QD_STD))
    priors = default_priors(pendulum(), mean)
    return forcegp.StructuredGP(pendulum(), mean, priors, noise=noise, inference=inference)


def fitted(seed: int, mean: str = "analytical", inference: str = "auto") -> StructuredFit:
    return model(mean, inference).fit(measured(seed)[0])


def error_of(model: StructuredFit, seed: int) -> float:
    test, truth = measured(50 + seed, 300, noisy=False)
    return float((model.predict(test.q, test.qd, test.tau).mean - truth).abs().mean())


@pytest.mark.parametrize("mean", ["analytical", pytest.param("zero", marks=pytest.mark.slow)])
def test_learned_slopes_are_better(mean: str, monkeypatch: pytest.MonkeyPatch) -> None:
    learned = [fitted(seed, mean) for seed in SEEDS]
    assert all(model.training.slopes is not None for model in learned)
    monkeypatch.setattr(steps, "RELEARNINGS", 0)
    of_file = [fitted(seed, mean) for seed in SEEDS]
    assert all(model.training.slopes is None for model in of_file)
    one, two = (sum(map(error_of, models, SEEDS)) for models in (learned, of_file))
    assert one < BETTER * two, (one, two)


def test_slopes_without_evidence_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(training: Training, system: forcegp.ConstrainedSystem, force: object) -> Training:
        G = state_jacobian(system, training.measurements[0])
        assert G is not None
        return dataclasses.replace(training, slopes=(1000.0 * G,))

    monkeypatch.setattr(noise_learning, "learned_slopes", wrong)
    assert fitted(1).training.slopes is None


def test_sparse_inference_has_the_slopes_of_the_file() -> None:
    assert fitted(1, inference="sparse").training.slopes is None


def test_slopes_are_saved_and_go_on(tmp_path: Path) -> None:
    model, (test, _) = fitted(1), measured(7, 30)
    model.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model")
    assert isinstance(again, StructuredFit)
    assert torch.equal(
        model.predict(test.q, test.qd, test.tau).mean, again.predict(test.q, test.qd, test.tau).mean
    )
    more = measured(8, 20)[0]
    G = model.update(more).training.slopes
    assert G is not None and [len(own) for own in G if own is not None] == [SAMPLES, 20]
    conditioned = again.condition(more)
    assert conditioned.training.slopes is not None
    torch.testing.assert_close(conditioned.training.slopes[0], G[1])


def test_forces_without_slopes_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_tensors(*given: object) -> Training:
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.")

    monkeypatch.setattr(noise_learning, "learned_slopes", no_tensors)
    model = fitted(1)
    assert model.training.slopes is None
    assert any("slopes of the learned forces" in warning for warning in model.result.warnings)


def test_a_fit_that_learns_nothing_conditions_as_it_was_learned() -> None:
    fit, more = fitted(1), measured(8, 20)[0]
    value = fit.condition(more).result.log_marginal_likelihood
    again = model().fit(more, learn=[], after=fit)
    assert again.training.slopes is not None and again.result.log_marginal_likelihood == value
