"""The figures of an evaluation against models whose errors are known."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp import evaluate
from forcegp.errors import DataError
from forcegp.forces.priors.sets import default_priors
from forcegp.gp.optimise import LearningOptions
from forcegp.models.prediction import Prediction, Predictor
from random_data import NOISE_STD, random_data, table_system

ROUNDING = 1e-12
"""Sums over some thousand numbers of the order of one."""

system = table_system()
data = random_data(system, 3000)


class KnownError(Predictor):
    """Predicts the noise-free acceleration plus a given error, and claims a given standard deviation."""

    kind = "known_error"

    def __init__(self, error: Tensor, std: float | None, noise_std: float = NOISE_STD) -> None:
        self.system, self.error, self.std, self.noise_std = system, error, std, noise_std
        self.seen = 0

    def save(self, path: str | Path) -> None:
        raise NotImplementedError

    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: forcegp.ConstrainedSystem | None = None,
    ) -> Prediction:
        rows = slice(self.seen, self.seen + len(q))
        self.seen += len(q)
        assert active is not None and torch.equal(active, data.active(["table"])[rows])
        spread = None if self.std is None else torch.eye(7, dtype=q.dtype).expand(len(q), 7, 7) * self.std**2
        return Prediction(data.qdd_clean[rows] + self.error[rows], spread)


def gaussian(std: float, seed: int = 5) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return std * torch.randn(len(data), 7, generator=generator, dtype=torch.float64)


def test_errors_are_the_known_ones() -> None:
    error = torch.tensor([0.1, -0.2, 0.3, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(3000, 7)
    found = evaluate(KnownError(error, None), data, compare=False)
    assert found.clean is not None and found.summary()["clean_mae"] == found.clean.mae
    assert found.clean.mae_by_joint == pytest.approx([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0], abs=ROUNDING)
    assert found.clean.mae == pytest.approx(1.6 / 7, abs=ROUNDING)
    assert found.clean.rmse == pytest.approx(math.sqrt(1.14 / 7), abs=ROUNDING)
    noise = data.qdd_clean + error - data.qdd
    assert found.noisy.mae == pytest.approx(float(noise.abs().mean()), abs=ROUNDING)
    assert found.noisy.rmse_by_joint == pytest.approx((noise**2).mean(0).sqrt().tolist(), abs=ROUNDING)
    assert (found.samples, found.kind, found.joint_names) == (3000, "known_error", data.joint_names)
    for name in ("coverage_noisy", "coverage_clean", "nlpd"):
        assert found.summary()[name] is None


def test_a_perfect_model_has_the_floor_of_the_paper() -> None:
    found = evaluate(KnownError(gaussian(0.0), None), data, compare=False)
    # The mean of 21000 absolute values with standard deviation 0.06: three standard errors.
    assert found.noisy.mae == pytest.approx(
        NOISE_STD * math.sqrt(2.0 / math.pi), abs=3 * 0.06 / math.sqrt(21000)
    )
    assert found.clean.mae == 0.0
    assert found.residual_max is not None and found.residual_max < 1e-11


def test_an_honest_uncertainty_is_calibrated() -> None:
    found = evaluate(KnownError(gaussian(0.2), 0.2), data, compare=False)
    # Shares among 21000 numbers: three standard errors of at most sqrt(0.25 / 21000).
    tolerance = 3.0 * math.sqrt(0.25 / 21000)
    assert found.uncertainty is not None
    assert found.uncertainty.coverage_noisy == pytest.approx(0.9545, abs=tolerance)
    assert found.uncertainty.coverage_clean == pytest.approx(0.9545, abs=tolerance)
    for level, share in found.uncertainty.calibration.items():
        assert share == pytest.approx(float(level), abs=tolerance)
    total = 0.2**2 + NOISE_STD**2
    # Half the variance of a squared normal variable over 21000 of them.
    expected = 0.5 * math.log(2.0 * math.pi * total) + 0.5
    assert found.uncertainty.nlpd == pytest.approx(expected, abs=3.0 * math.sqrt(0.5 / 21000))
    assert found.noise_std == pytest.approx((NOISE_STD,) * 7, rel=1e-12)  # a root of a mean of squares


@pytest.mark.parametrize(("claimed", "coverage"), [(0.02, 0.6), (2.0, 1.0)])
def test_a_dishonest_uncertainty_shows(claimed: float, coverage: float) -> None:
    honest, other = (evaluate(KnownError(gaussian(0.2), std), data, compare=False) for std in (0.2, claimed))
    assert other.uncertainty.nlpd > honest.uncertainty.nlpd + 0.3
    assert (
        other.uncertainty.coverage_noisy > 0.999
        if coverage == 1.0
        else other.uncertainty.coverage_noisy < coverage + 0.1
    )


def test_the_residual_is_that_of_closed_contacts() -> None:
    error = gaussian(0.1)
    found = evaluate(KnownError(error, None), data, compare=False)
    active = data.active(["table"])
    A = system.equations(data.q, data.qd).A
    expected = (A @ error[..., None])[..., 0][active].abs()
    assert found.residual == pytest.approx(float(expected.mean()), rel=1e-9)
    assert found.residual_max == pytest.approx(float(expected.max()), rel=1e-9)
    free = data.replace(contact={"table": torch.zeros(3000, dtype=torch.bool)})
    plain = forcegp.AnalyticalModel(system).nominal()
    assert evaluate(plain, free[:10]).residual is None


def test_chunks_do_not_matter_and_progress_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = evaluate(KnownError(gaussian(0.2), 0.2), data, compare=False)
    monkeypatch.setattr("forcegp.evaluation.predicted.CHUNK_STATES", 700)
    calls: list[tuple[int, int]] = []
    parts = evaluate(KnownError(gaussian(0.2), 0.2), data, compare=False, progress=lambda *x: calls.append(x))
    assert calls == [(700, 3000), (1400, 3000), (2100, 3000), (2800, 3000), (3000, 3000)]
    same = dataclasses.replace(parts, seconds_per_state=whole.seconds_per_state)
    old, new = whole.summary(), same.summary()
    assert old.pop("kind") == new.pop("kind")
    assert new == pytest.approx(old, rel=1e-9)


def test_without_clean_accelerations() -> None:
    found = evaluate(forcegp.AnalyticalModel(system).nominal(), data[:20].replace(extras={}))
    assert found.clean is None and found.summary()["clean_mae"] is None
    assert found.noise_std == pytest.approx((NOISE_STD,) * 7, rel=1e-12)  # a root of a mean of squares


def test_everything_fits_into_json() -> None:
    found = evaluate(KnownError(gaussian(0.2), 0.2), data, compare=False)
    read = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert read["noisy"]["mae"] == found.noisy.mae
    assert set(found.summary()) >= {"noisy_mae", "clean_mae", "nlpd", "residual"}


def test_a_structured_gp_with_learned_noise_is_held_against_that() -> None:
    model = forcegp.StructuredGP(
        system,
        mean="analytical",
        force_priors=default_priors(system, "analytical"),
        noise=forcegp.Noise(learn=True, acceleration=0.3),
    ).fit(data[:30], options=LearningOptions(max_evaluations=12))
    found = evaluate(model, data[40:60])
    learned = model.hyperparameters["noise.0.log_noise_std"].exp()
    assert found.noise_std == pytest.approx(learned.tolist())
    assert max(found.noise_std or ()) < 0.29


@pytest.mark.usefixtures("unchecked")
def test_wrong_use_is_refused() -> None:
    with pytest.raises(DataError, match="nothing to evaluate on"):
        evaluate(forcegp.AnalyticalModel(system).nominal(), data[:0])
    with pytest.raises(AttributeError, match=r"call fit = model\.fit\(data\)"):
        evaluate(forcegp.models.IndependentGP(system), data[:5])  # type: ignore[arg-type]
    with pytest.raises(DataError, match="joint"):
        evaluate(forcegp.AnalyticalModel(system).nominal(), data.select(tuple(reversed(data.joint_names))))


def test_a_perfect_model_is_better_than_every_trivial_predictor() -> None:
    some = data[:200]
    found = evaluate(KnownError(gaussian(0.01), 0.01), some, train=data[200:400])
    assert [v.against for v in found.verdicts] == ["mean", "robot file", "least squares"]
    assert all(v.better for v in found.verdicts) and "but" not in found.comparison
    error = gaussian(0.01)[:200] + some.qdd_clean - some.qdd
    M = forcegp.dynamics.mass_matrix(system.robot, some.q)
    torque = torch.einsum("nij,nj->ni", M, error).square().mean(0).sqrt()
    model = found.predictors[0]
    assert model.torque.all == pytest.approx(torque.tolist(), rel=1e-9)
    assert model.nlpd == found.uncertainty.nlpd


def test_the_robot_file_is_not_better_than_itself() -> None:
    found = evaluate(forcegp.AnalyticalModel(system).nominal(), data[:100], train=data[100:200])
    against = {v.against: v for v in found.verdicts}
    assert against["robot file"].torque == pytest.approx(1.0) and not against["robot file"].better
    assert "but is not better than" in found.comparison


def test_without_training_data_each_half_is_predicted_from_the_other() -> None:
    some = data[:100]
    halves = evaluate(KnownError(gaussian(0.01), None), some)
    errors = [some.qdd[50:].mean(0) - some.qdd[:50], some.qdd[:50].mean(0) - some.qdd[50:]]
    mean = next(p for p in halves.predictors if p.name == "mean")
    assert mean.acceleration.all == pytest.approx(torch.cat(errors).square().mean(0).sqrt().tolist())


class KnownMultiplier(KnownError):
    """Predicts a multiplier that is 1 N too large, with a standard deviation of 1 N."""

    def force_field(self) -> Any:
        return lambda system, at: at.q

    def predict(
        self, q: Tensor, qd: Tensor, tau: Tensor, quantity: str = "qdd", **settings: Any
    ) -> Prediction:
        if quantity == "qdd":
            return super().predict(q, qd, tau, **settings)
        rows = settings["active"][:, 0].cumsum(0)[:, None].to(q)
        return Prediction(rows + 1.0, torch.ones(len(q), 1, 1, dtype=q.dtype))


def test_multipliers_are_held_against_a_logged_sensor() -> None:
    some, closed = data[:50], data.contact["table"][:50]
    logged = closed.cumsum(0).double()
    some = some.replace(contact_extras={"multiplier": {"table": logged}})
    (found,) = evaluate(KnownMultiplier(gaussian(0.0), 0.1), some, compare=False).multipliers
    assert (found.contact, found.samples) == ("table", int(closed.sum()))
    assert found.bias == pytest.approx(1.0) and found.spread == pytest.approx(0.0, abs=1e-9)
    assert found.correlation == pytest.approx(1.0) and found.coverage == 1.0
    assert evaluate(KnownError(gaussian(0.0), 0.1), some, compare=False).multipliers == ()
