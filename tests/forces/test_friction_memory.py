"""Friction with memory is learned from the torques that a fit leaves, and only where it is there."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import DataError
from forcegp.forces.friction_memory import MEMORY, learn_memory
from forcegp.forces.measurements import Measurement
from forcegp.forces.priors.sets import friction_priors
from forces.test_inertia import log as motion

ROBOT = forcegp.load_robot("double_pendulum")
STEP, DISTANCE = 0.01, 0.05


def log(seconds: float, seed: int) -> tuple[Measurement, torch.Tensor]:
    """A slow motion of two joints, and Dahl's friction of the first, by another integration."""
    random = np.random.default_rng(seed)
    t = torch.arange(round(seconds / STEP), dtype=torch.float64) * STEP
    w, phase = random.uniform(0.5, 3.0, (2, 4)), random.uniform(0.0, 6.0, (2, 4))
    angles = torch.from_numpy(w)[None] * t[:, None, None] + torch.from_numpy(phase)[None]
    qd = 0.1 * angles.cos().sum(-1)
    z, states = 0.0, []
    for v in qd[:, 0].tolist():
        for _ in range(10):
            z += 0.1 * STEP * (v - abs(v) * z) / DISTANCE
        states.append(z)
    still = torch.zeros_like(qd)
    m = Measurement("qdd", still, qd, still, torch.zeros(len(t), 0, dtype=torch.bool), still, t=t)
    return m, torch.tensor(states, dtype=torch.float64)


def test_friction_with_memory_is_explained_on_another_motion() -> None:
    (train, z), (test, z_test) = log(60.0, 1), log(30.0, 2)
    noise = 0.05 * torch.randn(len(z), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    static = 2.0 * torch.tanh(train.qd[:, 0] / 0.02)
    residual = noise.clone()
    residual[:, 0] += 2.0 * z - static
    # The fit takes the friction for noise of the torque, and expects none of sticking.
    expected = torch.stack([residual.square().mean(0).expand_as(residual), 0.0 * residual], dim=-1)
    memory = learn_memory(ROBOT, train, residual, 0.0 * residual, 0.0 * residual, expected)
    assert memory is not None
    expected = 2.0 * z_test - 2.0 * torch.tanh(test.qd[:, 0] / 0.02)
    left = expected - memory.force(ROBOT, test)[:, 0]
    # Samples of velocity integrate z to some percent.
    assert float(left[100:].std()) < 0.2 * float(expected.std())
    assert float(memory.share[0, 0]) < 0.1
    # The second joint has noise alone.
    assert float(memory.share[1, 0]) > 0.95
    assert bool((memory.force(ROBOT, test)[:, 1].abs() < 0.05).all())


def test_a_joint_at_rest_does_not_show_its_torque_noise_in_motion() -> None:
    """The preload of the second joint is explained, but only where it rests."""
    train, z = log(60.0, 1)
    noise = 0.05 * torch.randn(len(z), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    residual = noise + torch.tensor([0.0, 0.5], dtype=torch.float64)
    residual[:, 0] += 2.0 * z - 2.0 * torch.tanh(train.qd[:, 0] / 0.02)
    expected = torch.stack([residual.square().mean(0).expand_as(residual), 0.0 * residual], dim=-1)
    for slower, determined in ((1.0, True), (1e-3, False)):
        speed = train.qd * torch.tensor([1.0, slower], dtype=torch.float64)
        motion = dataclasses.replace(train, qd=speed)
        memory = learn_memory(ROBOT, motion, residual, 0.0 * residual, 0.0 * residual, expected)
        assert memory is not None
        assert float(memory.force(ROBOT, motion)[:, 1].mean()) == pytest.approx(0.5, abs=0.05)
        assert float(memory.share[0, 0]) < 0.1
        assert (float(memory.share[1, 0]) < 0.1) is determined
        assert determined or float(memory.share[1, 0]) >= 1.0


def test_predictions_along_a_log_remember_how_a_joint_reversed() -> None:
    """Another motion of the same robot; a state alone does not determine this friction."""
    zero = torch.zeros_like(ROBOT.damping)
    robot = ROBOT.replace(damping=zero, friction=zero)
    system = forcegp.ConstrainedSystem(robot)
    train, test = (motion(robot, memory=0.05, seed=seed) for seed in (0, 1))
    fit = forcegp.StructuredGP(system, "analytical", friction_priors(system)).fit(train)
    alone = fit.predict(test.q, test.qd, test.tau, noise=True)
    along = fit.predict_log(test, noise=True)
    errors = [(x.mean - test.qdd).square().mean(0) for x in (alone, along)]
    assert bool((errors[1] < 0.3 * errors[0]).all())
    assert alone.std is not None and along.std is not None
    assert bool((along.std < alone.std).all())
    inside = ((along.mean - test.qdd).abs() <= 2.0 * along.std).double().mean(0)
    assert bool((inside > 0.9).all()) and bool((inside < 1.0).all())
    with pytest.raises(DataError, match="needs a log in time order"):
        fit.predict_log(test[torch.arange(len(test)).flip(0)])
    forgetful = {k: x for k, x in fit.hyperparameters.items() if not k.startswith(MEMORY)}
    again = dataclasses.replace(fit, hyperparameters=forgetful).predict_log(test, noise=True)
    torch.testing.assert_close(again.mean, alone.mean)


def test_samples_far_apart_show_no_memory() -> None:
    train, _ = log(60.0, 1)
    x = torch.zeros_like(train.qd[::10])
    assert (
        learn_memory(ROBOT, train[torch.arange(0, len(train.q), 10)], x, x, x, torch.stack([x, x], dim=-1))
        is None
    )
