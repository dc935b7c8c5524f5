"""Ripple: wave numbers that a log shows, and none that it does not."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from forcegp.forces.priors.ripple import MOST_WAVES, RipplePrior, ripple_of, waves_of
from forcegp.forces.term import JointState

STEP, ROWS = 0.005, 4000


def motion(seed: int) -> Tensor:
    """A sum of sines over some radians, as of an excitation."""
    generator = torch.Generator().manual_seed(seed)
    w, phase = torch.rand(2, 5, generator=generator, dtype=torch.float64)
    t = STEP * torch.arange(ROWS, dtype=torch.float64)
    return 0.5 * ((0.3 + 2.0 * w) * t[:, None] + 2.0 * math.pi * phase).sin().sum(-1)


def coloured(seed: int, memory: float = 0.95) -> Tensor:
    """Noise of unit variance whose neighbours are correlated."""
    generator = torch.Generator().manual_seed(seed)
    white = torch.randn(ROWS, generator=generator, dtype=torch.float64)
    e = [white[0]]
    for x in white[1:]:
        e.append(memory * e[-1] + math.sqrt(1.0 - memory**2) * x)
    return torch.stack(e)


@pytest.mark.parametrize("k", [23.0, 57.3, 160.0])
def test_the_wave_number_is_found(k: float) -> None:
    q = motion(0)
    (found,) = waves_of(q, 0.5 * torch.sin(k * q + 1.0) + coloured(1, memory=0.0))
    assert abs(found - k) < 0.05 * 2.0 * math.pi / float(q.max() - q.min())


def test_two_sources_and_a_harmonic() -> None:
    q = motion(2)
    torque = torch.sin(40.0 * q) + 0.7 * torch.cos(80.0 * q + 0.3) + 0.5 * torch.sin(101.0 * q) + coloured(3)
    assert sorted(waves_of(q, torque)) == pytest.approx([40.0, 80.0, 101.0], abs=0.1)


def test_noise_and_smooth_forces_have_no_waves() -> None:
    """A few percent of joints with correlated noise have a false line; a smooth force or a kink is none."""
    false = sum(len(waves_of(motion(seed), coloured(100 + seed))) for seed in range(30))
    assert false <= 2
    q = motion(5)
    assert waves_of(q, 3.0 * torch.sin(1.3 * q) + (q + 0.2).abs() + 0.3 * coloured(6)) == ()


def test_a_joint_at_rest_has_none() -> None:
    assert waves_of(torch.zeros(ROWS, dtype=torch.float64), coloured(7)) == ()
    q = torch.stack([motion(8), motion(9)], dim=-1)
    assert ripple_of(q, torch.stack([coloured(8), coloured(9)], dim=-1)) is None


def test_columns_are_sines_and_missing_waves_are_zero() -> None:
    q = torch.stack([motion(10), motion(11)], dim=-1)
    torque = torch.stack([torch.sin(30.0 * q[:, 0]), torch.zeros(ROWS, dtype=torch.float64)], dim=-1)
    prior = ripple_of(q, torque + 0.1 * torch.stack([coloured(12), coloured(13)], dim=-1))
    assert prior is not None and len(prior.waves[0]) <= MOST_WAVES and set(prior.waves[1]) == {0.0}
    columns = RipplePrior(waves=((30.0,), (0.0,))).columns(JointState(q, q, q))
    torch.testing.assert_close(columns["sin_0"][:, 0], torch.sin(30.0 * q[:, 0]))
    torch.testing.assert_close(columns["cos_0"][:, 0], torch.cos(30.0 * q[:, 0]))
    assert not columns["sin_0"][:, 1].any() and not columns["cos_0"][:, 1].any()
