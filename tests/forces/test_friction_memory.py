"""Friction with memory is learned from the torques that a fit leaves, and only where it is there."""

from __future__ import annotations

import numpy as np
import torch

from forcegp.forces.friction_memory import learn_memory
from forcegp.forces.measurements import Measurement

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
    memory = learn_memory(train, residual, torch.zeros_like(residual), residual.square())
    assert memory is not None
    expected = 2.0 * z_test - 2.0 * torch.tanh(test.qd[:, 0] / 0.02)
    left = expected - memory.force(test)[:, 0]
    # Samples of velocity integrate z to some percent.
    assert float(left[100:].std()) < 0.2 * float(expected.std())
    assert float(memory.share[0]) < 0.1
    # The second joint has noise alone.
    assert float(memory.share[1]) > 0.95
    assert bool((memory.force(test)[:, 1].abs() < 0.05).all())


def test_samples_far_apart_show_no_memory() -> None:
    train, _ = log(60.0, 1)
    residual = torch.zeros_like(train.qd)
    assert learn_memory(train[torch.arange(0, len(train.q), 10)], *3 * [residual[::10]]) is None
