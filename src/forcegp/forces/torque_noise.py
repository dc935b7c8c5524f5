"""White noise on the joint force: that of the torque sensor, and the friction of joints that stick.

Inside its static friction, the friction of a joint is whatever balances the other forces, and no function of
its velocity. A joint that hardly moves therefore has an unknown force of variance σ_s² e^{−(q̇/v_s)²} more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

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
