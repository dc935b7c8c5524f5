"""Unknown torques that are no function of the state: noise of the sensor, sticking, and what lies beyond
the trained region.

Inside its static friction, the friction of a joint is whatever balances the other forces, and no function of
its velocity. A joint that hardly moves therefore has an unknown force of variance σ_s² e^{−(q̇/v_s)²} more.

Noise learned where nothing moves says little about a jump. Beyond the range of speeds and torques that a
joint was trained on, its force has a standard deviation g D more, with D the distance from that range in
training standard deviations. `calibration.growth` estimates g.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forcegp.forces.priors.base import NOISE
from forcegp.forces.quantities import States

TORQUE_NOISE = f"{NOISE}.torque.log_noise_std"
"""Name of the learned noise of the motor torque."""
STICK_NOISE, STICK_SPEED = f"{NOISE}.stick.log_noise_std", f"{NOISE}.stick.log_speed"
"""Names of the learned σ_s and v_s of each joint."""
STICKING = 0.02
"""v_s where learning begins [rad/s, m/s]."""
REGION = f"{NOISE}.region."
LOW, HIGH, SPREAD, GROWTH = (REGION + name for name in ("low", "high", "spread", "growth"))
"""Names of the trained region: limits and standard deviation of the speed and torque of each joint `(2, nq)`,
and g `(nq,)` [N m, N]."""
OUTERMOST = 0.01
"""Share of the training samples that lies beyond either limit of the region."""
RELATIVE = 0.05
"""Growth g over the typical load of a joint that is expected before the log says more: torque constants and
friction that depends on load are uncertain by some 5 %."""
FAR = 3.0
"""Distance beyond the trained region from which a prediction warns."""


def initial_torque_noise(residual: Tensor) -> dict[str, Tensor]:
    """Where learning begins, from the root mean square of unexplained torque `(nq,)` [N m, N]."""
    std = (0.5 * residual).clamp(min=1e-4).log().double()
    return {
        TORQUE_NOISE: std,
        STICK_NOISE: std.clone(),
        STICK_SPEED: torch.full_like(std, math.log(STICKING)),
    }


def stick_variance(tensors: Mapping[str, Tensor], at: States) -> Tensor:
    """Variance of the friction of joints that stick, `(n, nq)`; zero where it is not learned."""
    if STICK_NOISE not in tensors:
        return torch.zeros_like(at.q)
    std, speed = tensors[STICK_NOISE].exp(), tensors[STICK_SPEED].exp()
    return std**2 * torch.exp(-((at.qd / speed) ** 2))


def trained_region(qd: Tensor, tau: Tensor, load: Tensor) -> dict[str, Tensor]:
    """The region of the training samples `(n, nq)`, by the names of `LOW`, `HIGH` and `SPREAD`.

    Args:
        qd, tau: of samples in motion.
        load: typical torque of each joint `(nq,)`, a fraction of which is the least spread of its torque.
    """
    x = torch.stack([qd, tau], dim=1)
    low, high = x.quantile(torch.tensor([OUTERMOST, 1.0 - OUTERMOST]).to(x), dim=0)
    least = torch.stack([torch.full_like(load, STICKING), RELATIVE * load])
    return {LOW: low, HIGH: high, SPREAD: x.std(0, correction=0).maximum(least)}


def distance_beyond(tensors: Mapping[str, Tensor], qd: Tensor, tau: Tensor) -> Tensor:
    """D of each joint `(*batch, nq)` in training standard deviations; zero inside the trained region, or
    where none is known."""
    if LOW not in tensors:
        return torch.zeros_like(qd)
    x = torch.stack([qd, tau], dim=-2)
    beyond = (tensors[LOW] - x).maximum(x - tensors[HIGH]).clamp(min=0.0)
    return (beyond / tensors[SPREAD]).norm(dim=-2)


def warnings_beyond(distance: Tensor, joints: Sequence[str]) -> tuple[str, ...]:
    """A warning where states lie far beyond the trained region.

    Args:
        distance: D `(*batch, nq)`.
        joints: their names.
    """
    rows = distance.reshape(-1, distance.shape[-1])
    far = int((rows > FAR).any(-1).sum())
    if not far:
        return ()
    most, joint = rows.amax(0).max(0)
    return (
        f"{far} of {len(rows)} states lie beyond the trained speeds and torques, by up to {float(most):.3g} "
        f"training standard deviations ({joints[int(joint)]}); their error bars are a guess: train on such "
        "motion",
    )


def unknown_variance(tensors: Mapping[str, Tensor], at: States) -> Tensor:
    """Variance of forces that only a prediction has: of joints that stick, and beyond the trained region
    `(n, nq)`."""
    variance = stick_variance(tensors, at)
    if GROWTH not in tensors:
        return variance
    return variance + (tensors[GROWTH] * distance_beyond(tensors, at.qd, at.tau)).square()
