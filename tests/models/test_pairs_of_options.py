"""Every pair of options works, or is refused with a typed error: neither option is lost in silence."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from itertools import combinations
from typing import Any

import pytest
import torch

import forcegp
from forcegp.data import DataHeader
from forcegp.errors import ForceGPError
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.gp.kernels import SquaredExponential
from forcegp.gp.optimise import LearningOptions
from forcegp.robot.parameters import AnalyticalParameters

SAMPLES = 45
SAME = 1e-9
"""Relative difference of predictions below which an option had no effect."""
FEW = LearningOptions(max_evaluations=4, warm_start=None)
Settings = dict[str, Any]


@cache
def log() -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """A double pendulum with friction, whose rows are in order of time."""
    generator = torch.Generator().manual_seed(0)
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    t = 0.02 * torch.arange(SAMPLES, dtype=torch.float64)
    w, phase = torch.tensor([2.0, 3.3]), torch.tensor([0.3, 1.1])
    angle = (w * t[:, None] + phase).double()
    q, qd, qdd = angle.sin(), w * angle.cos(), -(w**2) * angle.sin()
    tau = forcegp.dynamics.inverse_dynamics(system.robot, q, qd, qdd) + 0.5 * qd + torch.tanh(qd / 0.05)
    noise = 0.1 * torch.randn(SAMPLES, 2, generator=generator, dtype=torch.float64)
    header = DataHeader(noise_std=0.1, dt=0.02)
    data = forcegp.Dataset(t, q, qd, tau, qdd + noise, system.robot.joint_names, header=header)
    outlier = data.qdd.clone()
    outlier[7] += 5.0
    return system, data.replace(qdd=outlier)


def with_noise(**fields: Any) -> Callable[[Settings], Settings]:
    return lambda s: s | {"noise": dataclasses.replace(s["noise"], **fields)}


def with_prior(make: Callable[[], Any]) -> Callable[[Settings], Settings]:
    return lambda s: s | {"force_priors": [*s["force_priors"], make()]}


def in_units(s: Settings) -> Settings:
    return s | {
        "force_priors": [dataclasses.replace(s["force_priors"][0], scaled=False), *s["force_priors"][1:]]
    }


def theta() -> AnalyticalParameters:
    return AnalyticalParameters(log()[0].robot, {"mass": "all"})


OPTIONS: dict[str, Callable[[Settings], Settings]] = {
    "acceleration noise": with_noise(acceleration=0.3),
    "learned noise": with_noise(learn=True),
    "stated torque noise": with_noise(torque=0.5),
    "learned torque noise": with_noise(torque="learn"),
    "noise of the state": with_noise(state=(1e-2, 5e-2)),
    "heavy tails": with_noise(degrees_of_freedom=4.0),
    "zero mean": lambda s: s | {"mean": "zero"},
    "joint friction": with_prior(forcegp.priors.JointFrictionPrior),
    "inertial prior": with_prior(InertialPrior),
    "analytical parameters": lambda s: s | {"analytical_parameters": theta()},
    "sparse": lambda s: s | {"inference": forcegp.models.Inference("sparse", inducing_points=6)},
    "units": in_units,
}
REPLACE = {frozenset(("stated torque noise", "learned torque noise"))}
"""Two values of one option."""


def predicted(*names: str) -> torch.Tensor | None:
    """Mean and covariance of accelerations with some options; `None` if they are refused."""
    system, data = log()
    kernel = SquaredExponential(("q", "qd"))
    settings: Settings = {
        "mean": "analytical",
        "force_priors": [JointForcePrior(kernel, inputs=("q", "qd"))],
        "noise": forcegp.Noise(torque=None),
    }
    for name in names:
        settings = OPTIONS[name](settings)
    try:
        fit = forcegp.StructuredGP(system, **settings).fit(data, options=FEW)
    except ForceGPError:
        return None
    p = fit.predict(data.q[::5] + 0.1, data.qd[::5], data.tau[::5])
    assert bool(torch.isfinite(p.mean).all()) and bool((p.variance > 0.0).all())
    return torch.cat([p.mean.flatten(), p.covariance.flatten()])


alone = cache(predicted)


@pytest.mark.parametrize("name", OPTIONS)
def test_each_option_has_an_effect(name: str) -> None:
    result, without = alone(name), alone()
    assert result is not None and without is not None
    assert float((result - without).abs().max()) > SAME * float(without.abs().max())


@pytest.mark.parametrize(("one", "two"), list(combinations(OPTIONS, 2)))
def test_no_option_is_lost_beside_another(one: str, two: str) -> None:
    if frozenset((one, two)) in REPLACE:
        pytest.skip("two values of one option")
    both = predicted(one, two)
    if both is None:
        return
    for name in (one, two):
        single = alone(name)
        assert single is not None
        assert float((both - single).abs().max()) > SAME * float(single.abs().max()), f"only {name} counts"
