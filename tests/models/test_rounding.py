"""Standard deviations are those of a dense posterior in 80-bit arithmetic, or the fit is refused."""

from __future__ import annotations

import dataclasses
from functools import cache

import pytest
import torch

import forcegp
from extended import deviation_errors, is_extended
from forcegp.errors import NumericalError
from forcegp.forces.priors.sets import default_priors, friction_priors
from forcegp.gp.kernels import Matern52
from forcegp.models.prediction import Prediction, require_semidefinite
from forcegp.models.registry import create
from forcegp.models.structured_fit import StructuredFit
from forcegp.simulate import simulate

WITHIN = 0.01
"""Largest relative error of a standard deviation."""
FEW = forcegp.models.LearningOptions(max_evaluations=12)
"""Rounding depends on where learning ends, and not on whether it is done."""
OUTLIER = 1e8

pytestmark = pytest.mark.skipif(not is_extended(), reason="numpy.longdouble is no more than float64 here")


@cache
def log_of(name: str) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    scene = forcegp.load_scene(name)
    return scene.system(), simulate(scene.system(), dataclasses.replace(scene.simulation, duration=3.0)).data


def drawn(name: str, count: int) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset, forcegp.Dataset]:
    """Random training samples of a scene, and test samples of which some are among them."""
    system, data = log_of(name)
    rows = torch.randperm(len(data), generator=torch.Generator().manual_seed(count))
    return system, data[rows[:count].sort().values], data[rows[count - 4 : count + 6]]


CASES = [
    ("pendulum_wire", "sgp-zero", 20, {}),
    ("pendulum_wire", "sgp-mean", 80, {}),
    ("pendulum_wire", "sgp-zero", 40, {"noise": 1e-3}),
    ("pendulum_wire", "sgp-zero", 60, {}),
    ("pendulum_wire", "sgp-mean", 40, {"noise": forcegp.Noise(learn=True)}),
    ("pendulum_wire", "sgp-zero-se", 60, {}),
    ("pendulum_wire", "sgp", 40, {"force_priors": friction_priors}),
    pytest.param("kuka_plane", "sgp-zero", 20, {}, marks=pytest.mark.slow),
    ("kuka_plane", "sgp-zero", 40, {"noise": 1e-3}),
    ("kuka_plane", "sgp-mean", 40, {}),
    ("kuka_plane", "sgp-mean", 25, {"noise": 1e-4}),
    ("kuka_plane", "sgp-contact", 40, {}),
    pytest.param("kuka_plane", "sgp", 40, {"force_priors": friction_priors}, marks=pytest.mark.slow),
    ("kuka_plane", "sgp-mean-se", 20, {}),
    pytest.param("ur5_free", "sgp-zero", 30, {}, marks=pytest.mark.slow),
    ("ur5_free", "sgp-mean", 40, {"force_priors": (forcegp.priors.JointForcePrior(Matern52()),)}),
    ("ur5_free", "sgp", 60, {"force_priors": friction_priors}),
    pytest.param("ur5_wiping", "sgp-zero", 30, {}, marks=pytest.mark.slow),
    ("ur5_wiping", "sgp-mean", 30, {}),
    ("ur5_wiping", "sgp", 60, {"force_priors": friction_priors}),
]


@pytest.mark.parametrize(("scene", "model", "count", "options"), CASES)
def test_standard_deviations_are_right(scene: str, model: str, count: int, options: dict) -> None:
    system, train, test = drawn(scene, count)
    given = {key: value(system) if callable(value) else value for key, value in options.items()}
    fit = create(model, system, **given).fit(train, options=FEW)
    assert isinstance(fit, StructuredFit)
    assert deviation_errors(fit, test) < WITHIN


@pytest.mark.parametrize("scene", ["kuka_plane", "ur5_wiping"])
@pytest.mark.parametrize("mean", ["zero", "analytical"])
def test_an_acceleration_of_1e8_is_refused(scene: str, mean: str) -> None:
    system, train, _ = drawn(scene, 40)
    qdd = train.qdd.clone()
    qdd[7, 1] = OUTLIER
    model = forcegp.StructuredGP(system, mean, default_priors(system, mean))
    with pytest.raises(NumericalError, match="does not resolve the noise relative to the prior"):
        model.fit(dataclasses.replace(train, qdd=qdd), options=FEW)


@pytest.mark.parametrize("scene", ["kuka_plane", "ur5_wiping"])
def test_an_acceleration_of_1e8_is_noise_of_the_torque_if_that_is_learned(scene: str) -> None:
    system, train, test = drawn(scene, 40)
    qdd = train.qdd.clone()
    qdd[7, 1] = OUTLIER
    model = forcegp.StructuredGP(system, "analytical", friction_priors(system))
    fit = model.fit(dataclasses.replace(train, qdd=qdd), options=FEW)
    assert deviation_errors(fit, test) < WITHIN
    p = fit.predict(test.q, test.qd, test.tau, active=test.active(system.contact_names), noise=True)
    assert float(((p.mean - test.qdd).abs() <= 2.0 * p.std).double().mean()) > 0.9


@pytest.mark.parametrize("noise", [1e-6, 1e-8])
def test_a_noise_below_rounding_is_refused(noise: float) -> None:
    system, train, _ = drawn("kuka_plane", 30)
    with pytest.raises(NumericalError, match=r"noise at least [\d.e+]+ times as large"):
        forcegp.StructuredGP(system, "zero", noise=noise).fit(train, options=FEW)


def test_noise_learned_from_noise_free_accelerations_warns_and_is_right() -> None:
    system, data, test = drawn("pendulum_wire", 40)
    clean = dataclasses.replace(data, qdd=data.extras["qdd_clean"])
    priors = default_priors(system)
    fit = forcegp.StructuredGP(system, "analytical", priors, noise=forcegp.Noise(learn=True)).fit(clean)
    assert any("ended at their lower bound" in doubt for doubt in fit.result.warnings)
    assert deviation_errors(fit, test) < WITHIN


def test_a_variance_that_is_rounding_and_a_negative_eigenvalue_are_refused() -> None:
    system, train, test = drawn("pendulum_wire", 40)
    fit = forcegp.StructuredGP(system, "zero").fit(train, options=FEW)
    strong = {k: v + 16.0 if k.endswith("_std") else v for k, v in fit.hyperparameters.items()}
    with pytest.raises(NumericalError, match="does not resolve"):
        fit.condition(train, strong)
    covariance = torch.tensor([[1.0, 1.1], [1.1, 1.0]], dtype=torch.float64).expand(3, 2, 2)
    with pytest.raises(NumericalError, match=r"3 of 3 covariances .* not positive"):
        Prediction(torch.zeros(3, 2), covariance)
    require_semidefinite(torch.ones(4, 3, 3, dtype=torch.float64))
    require_semidefinite(torch.zeros(4, 3, 3, dtype=torch.float64))
    assert fit.predict(test.q, test.qd, test.tau).std is not None
