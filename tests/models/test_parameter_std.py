"""Error bars of learned robot parameters, from the curvature of the likelihood."""

from __future__ import annotations

import math

import pytest
import torch

import forcegp
from forcegp.dynamics import forward_dynamics
from forcegp.errors import ModelError
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.joint import JointForcePrior, JointFrictionPrior
from forcegp.gp.optimise import LearningOptions
from forcegp.models.structured_fit import StructuredFit
from forces.test_inference import gradients
from logs import random_log

ROBOT = forcegp.load_robot("double_pendulum")
FREE, FRICTION = forcegp.ConstrainedSystem(ROBOT), [JointFrictionPrior()]
HEAVIER, NOISE = 1.3, 0.3
SMOOTH = 1e-6
"""Relative rounding error of differences of gradients."""


def fitted(
    n: int, seed: int = 0, learn: dict | None = None, prior: ForcePrior | None = None
) -> StructuredFit:
    """A log of a robot with a heavier last link, whose mass is learned."""
    true = ROBOT.replace(mass=ROBOT.mass * torch.tensor([1.0, HEAVIER]).to(ROBOT.mass))
    generator = torch.Generator().manual_seed(seed)
    q, qd, tau = 2.0 * torch.rand(3, n, 2, generator=generator, dtype=torch.float64) - 1.0
    qdd = forward_dynamics(true, q, qd, 5.0 * tau - 0.5 * qd)
    qdd = qdd + NOISE * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    data = forcegp.Dataset(0.1 * torch.arange(n).double(), q, qd, 5.0 * tau, qdd, ROBOT.joint_names)
    theta = forcegp.robot.AnalyticalParameters(ROBOT, learn or {"mass": ROBOT.joint_names[-1:]})
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(ROBOT),
        "analytical",
        [prior or JointFrictionPrior()],
        NOISE,
        analytical_parameters=theta,
    )
    return model.fit(data, options=LearningOptions(max_evaluations=60))


def test_a_learned_mass_has_a_bar_that_holds_it() -> None:
    few, many = fitted(60), fitted(240, seed=1)
    bars = []
    for fit in (few, many):
        std = fit.parameter_std()["mass"]
        assert float(std[0]) == 0.0, "this mass is not learned"
        assert abs(float(fit.system.robot.mass[1] - HEAVIER * ROBOT.mass[1])) < 3.0 * float(std[1])
        bars.append(float(std[1] / ROBOT.mass[1]))
    assert bars[0] < 0.2 and bars[1] == pytest.approx(0.5 * bars[0], rel=0.35), "σ falls with √n"


def test_the_bars_are_those_of_the_dense_likelihood() -> None:
    """Second differences of the textbook formula, which has no torque noise."""
    fit, name, step = fitted(20, prior=JointForcePrior()), "analytical_parameters.coordinates.mass", 1e-4
    x = fit.hyperparameters[name]
    ahead, behind = (gradients(fit, {**fit.hyperparameters, name: y})[1][name] for y in (x + step, x - step))
    std = fit.system.robot.mass[1:] * ((ahead - behind) / (2.0 * step)).rsqrt()
    torch.testing.assert_close(fit.parameter_std()["mass"][1:], std, rtol=SMOOTH, atol=0.0)


def test_parameters_that_the_data_do_not_determine_have_infinite_bars() -> None:
    """In its plane, a pendulum shows nothing of its centre of mass beside the plane."""
    std = fitted(60, learn={"com": ROBOT.joint_names[-1:]}).parameter_std()["com"]
    assert std.shape == (2, 3) and std[0].tolist() == [0.0, 0.0, 0.0]
    assert [math.isinf(x) for x in std[1].tolist()] == [False, True, False]
    assert float(std[1, [0, 2]].min()) > 0.0 and float(std[1, [0, 2]].max()) < 0.05


def test_a_fit_without_learned_parameters_has_no_bars() -> None:
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(ROBOT), "analytical", [JointFrictionPrior()], NOISE
    )
    fit = model.fit(random_log(30, joints=ROBOT.joint_names), options=LearningOptions(max_evaluations=2))
    with pytest.raises(ModelError, match="no robot parameters"):
        fit.parameter_std()
