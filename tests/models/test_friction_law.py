"""Friction laws of simulators, fitted to planted friction; MuJoCo's bristles are the oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from forcegp.errors import optional_module
from forcegp.forces.priors.memory import DISTANCES, bristles
from forcegp.models.friction_law import RATE, Laws, Reversals, _Joint, laws_of

mujoco = optional_module("mujoco", "These tests")
FASTEST = torch.tensor([1.5, 0.4], dtype=torch.float64)
AT = Reversals.of(FASTEST)
LAW = np.array([0.3, 0.1, 0.2, 2.0, 0.8, 0.15, 80.0])
"""d, b, c, f, s, v_s and σ₀ of a joint."""


def engine(peak: float, phases: np.ndarray, law: np.ndarray) -> np.ndarray:
    """Bristle force of MuJoCo's DC motor in a harmonic motion, at phases after a reversal."""
    f, s, speed, stiffness = law[3:]
    lugre = f"{stiffness} 0 {f} {f + s} {speed}"
    motor = f'<dcmotor joint="a" input="none" motorconst="1e-9" resistance="1" lugre="{lugre}"/>'
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="5e-5"/>'
        '<worldbody><body><joint name="a"/><geom size="1"/></body></worldbody>'
        f"<actuator>{motor}</actuator></mujoco>"
    )
    data, forces, times = mujoco.MjData(model), [], []
    period = 2.0 * math.pi / RATE
    while data.time < 3.5 * period:
        data.qvel[:] = peak * math.sin(RATE * data.time)
        times.append(data.time)
        forces.append(stiffness * data.act[0])
        mujoco.mj_step(model, data)
    return np.interp(3.0 * period + phases / RATE, times, forces)


@pytest.mark.parametrize("level", [3, 15])
def test_bristles_bend_as_in_mujoco(level: int) -> None:
    """Forwards, before and after a reversal; backwards, they bend the other way."""
    joint = _Joint(AT, 0)
    f, s, speed, stiffness = LAW[3:]
    found = f * joint.direction(*(np.array([x]) for x in (f / stiffness, s / f, speed)))[0]
    forwards = (AT.level == level).numpy() & (joint.v > 0.0)
    expected = engine(float(AT.speeds[level, 0]), joint.phase[forwards], LAW)
    np.testing.assert_allclose(found[forwards], expected, atol=5e-3 * f)
    np.testing.assert_allclose(found[(AT.level == level).numpy() & (joint.v < 0.0)], -expected, atol=5e-3 * f)
    assert np.ptp(expected) > 0.5 * f


def test_the_past_is_that_of_a_log() -> None:
    """States of bristles along a sampled harmonic motion after many periods."""
    t = 1e-4 * torch.arange(round(3.5 * 2.0 * math.pi / RATE / 1e-4), dtype=torch.float64)
    peak = AT.speeds[9]
    z = bristles(t, torch.sin(RATE * t)[:, None] * peak, torch.zeros(len(t)).double())[..., : len(DISTANCES)]
    rows = ((AT.level == 9) & (AT.qd[:, 0] > 0.0)).nonzero()[:, 0]
    history, phases = AT.history()[rows], AT.phases()[rows]
    for j in range(2):
        nearest = ((3.0 * 2.0 * math.pi + phases[:, j]) / RATE / 1e-4).round().long()
        torch.testing.assert_close(history[:, j, : len(DISTANCES)], z[nearest, j], rtol=0.0, atol=5e-3)


def planted(law: np.ndarray, noise: float, offset: float = 0.0, samples: int = 300) -> list[torch.Tensor]:
    """The arguments of `laws_of` for one law in both joints, with noise in place of a posterior."""
    generator = torch.Generator().manual_seed(0)
    sliding, memory = [], []
    v = AT.both
    for j in range(2):
        joint, shape = _Joint(AT, j), (law[3] / law[6] if law[6] else 0.0, law[4] / law[3], law[5])
        dry = law[3] * joint.direction(*(np.array([x]) for x in shape))[0]
        u = v[:, j]
        bare = law[3] * (1.0 + law[4] / law[3] * torch.exp(-((u / law[5]) ** 2))) * u.sign()
        sliding.append((law[0] + law[1] * u.abs() + law[2] * u**2) * u + bare - offset)
        memory.append(torch.from_numpy(dry)[len(dry) // 2 :] - bare[AT.index[len(dry) // 2 :]])
    parts = []
    for part in (sliding, memory):
        mean = torch.stack(part, dim=-1)
        shift = noise * torch.randn(samples, *mean.shape, generator=generator, dtype=torch.float64)
        parts.append(torch.cat([mean[None], mean + shift]))
    return parts


def test_a_law_is_found_with_its_standard_deviations() -> None:
    """The law and an offset, and the spread of its parameters is that of refitted samples."""
    sliding, memory = planted(LAW, 0.02, offset=0.4)
    found = laws_of(AT, sliding, memory)
    assert found.has_memory.all() and found.left.max() < 2e-3
    np.testing.assert_allclose(found.values[0, 0], LAW, rtol=0.03)
    again = [laws_of(AT, *(part[[k, *range(20)], :, :1] for part in (sliding, memory))) for k in range(1, 21)]
    refitted = np.stack([each.values[0, 0] for each in again])
    ratio = refitted.std(0) / found.values[1:, 0].std(0)
    assert (ratio > 0.5).all() and (ratio < 2.0).all()  # of 20 samples


def test_what_is_not_determined_is_zero() -> None:
    """Dry and viscous friction alone, and memory within the noise."""
    simple = np.array([0.3, 0.0, 0.0, 2.0, 0.0, 0.15, 80.0])
    sliding, memory = planted(simple, 0.02)
    with_memory = laws_of(AT, sliding, memory).values[0]
    np.testing.assert_allclose(with_memory[:, [0, 3, 6]], simple[[0, 3, 6]] + np.zeros((2, 3)), rtol=0.05)
    assert not with_memory[:, [1, 2, 4]].any()
    without = laws_of(AT, sliding, memory - 0.999 * memory[:1]).values[0]
    assert not without[:, [1, 2, 4, 6]].any()
    np.testing.assert_allclose(without[:, [0, 3]], simple[[0, 3]] + np.zeros((2, 2)), rtol=0.05)
    # Without memory, no file holds an excess of static friction.
    peaked = planted(np.array([0.3, 0.0, 0.0, 2.0, 0.8, 0.15, 0.0]), 0.02)[0]
    np.testing.assert_allclose(laws_of(AT, peaked).values[0, 0, 3:6], [2.0, 0.8, 0.15], rtol=0.05)
    assert not laws_of(AT, peaked, static=False).values[0, :, 4].any()


def test_damping_never_drives_a_joint() -> None:
    """Friction that falls with the speed, and samples around it."""
    v = AT.both
    falling = (1.0 - 0.9 * v.abs() / FASTEST) * v.sign() + 0.05 * v
    noise = 0.02 * torch.randn(50, *v.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found: Laws = laws_of(AT, torch.cat([falling[None], falling + noise]), static=False)
    d, b, c, f = (found.values[..., i] for i in range(4))
    size = np.linspace(0.0, 10.0, 500)[:, None, None]
    assert (d + b * size + c * size**2).min() > -1e-9 and f.min() >= 0.0
