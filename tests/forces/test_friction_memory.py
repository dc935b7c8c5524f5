"""Friction with memory is learned from the torques that a fit leaves, and only where it is there."""

from __future__ import annotations

import numpy as np
import torch

import forcegp
from forcegp.forces.friction_memory import learn_memory
from forcegp.forces.measurements import Measurement

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


def test_samples_far_apart_show_no_memory() -> None:
    train, _ = log(60.0, 1)
    x = torch.zeros_like(train.qd[::10])
    assert (
        learn_memory(ROBOT, train[torch.arange(0, len(train.q), 10)], x, x, x, torch.stack([x, x], dim=-1))
        is None
    )
