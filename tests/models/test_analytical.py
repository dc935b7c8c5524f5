"""The analytical model against the equations of motion, and what it learns."""

from __future__ import annotations

import pytest
import torch

from forcegp import AnalyticalModel
from forcegp.errors import ModelError, UnknownNameError
from forcegp.gp.optimise import LearningOptions
from forcegp.models.analytical import Window
from forcegp.models.minibatch import BatchOptions
from forcegp.robot.inertia import pseudo_inertia
from random_data import random_data, table_system

ROUNDING = 1e-10
"""Absolute, on accelerations of some 10 rad/s² and forces of some 100 N."""
CONSTRAINT = 1e-11
"""|A q̈ − b| that rounding leaves."""

system = table_system()
frictionless = random_data(system, 120, friction=0.0)
test = random_data(system, 30, seed=1, friction=0.0)
LBFGS = LearningOptions("lbfgs", max_evaluations=60)


def states() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return test.q, test.qd, test.tau


def test_without_a_fit_it_is_the_robot_file() -> None:
    model, active = AnalyticalModel(system).nominal(), test.active(["table"])
    eom = system.equations(test.q, test.qd, active)
    Q = eom.Q_K + test.tau
    expected = {
        "qdd": eom.acceleration(Q),
        "qdd_free": eom.free_acceleration(Q),
        "multiplier": eom.multiplier(Q),
        "constraint_force": eom.constraint_force(Q),
        "joint_force": Q,
        "contact_friction": torch.zeros_like(Q),
    }
    for name, value in expected.items():
        predicted = model.predict(*states(), name, active=active)
        torch.testing.assert_close(predicted.mean, value, rtol=ROUNDING, atol=ROUNDING)
        assert predicted.covariance is None and predicted.variance is None
    torch.testing.assert_close(expected["qdd"], test.qdd_clean, rtol=ROUNDING, atol=ROUNDING)


def test_several_quantities_and_any_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    model = AnalyticalModel(system).nominal()
    whole = model.predict(*states(), ["qdd", "multiplier"])
    assert whole.parts == {"qdd": slice(0, 7), "multiplier": slice(7, 8)}
    monkeypatch.setattr("forcegp.models.prediction.CHUNK", 7)
    shaped = model.predict(*(x.reshape(5, 6, 7) for x in states()), ["qdd", "multiplier"])
    torch.testing.assert_close(shaped.mean.reshape(30, 8), whole.mean, rtol=ROUNDING, atol=ROUNDING)
    assert model.predict(test.q[:0], test.qd[:0], test.tau[:0]).mean.shape == (0, 7)
    with pytest.raises(UnknownNameError, match="'torque'"):
        model.predict(*states(), "torque")


def test_mass_and_damping_are_found_again() -> None:
    names = ("lbr_iiwa_joint_6", "lbr_iiwa_joint_7")
    model = AnalyticalModel(system, analytical_parameters={"mass": names, "damping": names}, seed=3)
    fit = model.fit(frictionless, options=LBFGS)
    assert fit.result.converged and fit.result.history[0] > 10.0 * fit.result.objective
    robot, true = fit.system.robot, system.robot
    # Noise of 0.1 rad/s² on 840 accelerations leaves the masses uncertain by some parts in a thousand.
    torch.testing.assert_close(robot.mass[5:], true.mass[5:], rtol=0.02, atol=0.0)
    torch.testing.assert_close(robot.damping[5:], true.damping[5:], rtol=0.1, atol=0.0)
    assert torch.equal(robot.mass[:5], true.mass[:5])


@pytest.mark.parametrize(
    "options", [LBFGS, BatchOptions(epochs=20, batch=12, learning_rate=0.05)], ids=["lbfgs", "adam"]
)
def test_every_link_is_learned_and_stays_physical(options: LearningOptions | BatchOptions) -> None:
    fit = AnalyticalModel(system).fit(frictionless, options=options)
    assert fit.result.evaluations == len(fit.result.history)
    assert fit.result.objective < 0.2 * fit.result.history[0]
    robot = fit.system.robot
    assert float(torch.linalg.eigvalsh(pseudo_inertia(robot.mass, robot.com, robot.inertia)).min()) > 0.0
    assert bool((robot.damping > 0.0).all())
    active = test.active(["table"])
    eom = fit.system.equations(test.q, test.qd, active)
    qdd = fit.predict(*states(), active=active).mean
    assert float(((eom.A @ qdd[..., None])[..., 0] - eom.b).abs().max()) < CONSTRAINT


def test_the_start_is_random_wide_and_repeatable() -> None:
    def start(seed: int, window: Window) -> torch.Tensor:
        model = AnalyticalModel(system, analytical_parameters={"mass": "all"}, seed=seed, window=window)
        fit = model.fit(frictionless, options=LearningOptions("lbfgs", max_evaluations=1))
        return fit.system.robot.mass / system.robot.mass

    wide = start(0, Window(relative=1.0))
    assert torch.equal(wide, start(0, Window(relative=1.0)))
    assert not torch.equal(wide, start(1, Window(relative=1.0)))
    assert float(wide.max() / wide.min()) > 1.5
    assert bool((wide.log().abs() <= 1.0).all())


def test_wrong_use_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="'weight'"):
        AnalyticalModel(system, analytical_parameters={"weight": "all"})
    with pytest.raises(ModelError, match="no samples to learn from"):
        AnalyticalModel(system).fit(frictionless[:0])
    with pytest.raises(ModelError, match="epochs of training"):
        BatchOptions(epochs=0)
    with pytest.raises(ModelError, match="held-out share"):
        BatchOptions(held_out=1.0)
