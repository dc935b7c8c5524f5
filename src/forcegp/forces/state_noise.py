"""Noise of the measured state, carried to measured quantities to first order.

At a measured state x + δ, with δ ~ N(0, Σ_x), the model predicts z(x + δ) ≈ z(x) + G δ, so a sample's rows
have the noise G Σ_x Gᵀ more, with G = ∂z/∂(q, q̇) (McHutchon and Rasmussen, *Gaussian process training with
input noise*, 2011). G is that of the robot file's equations of motion under the measured torque, or, once
forces have been learned, that of q̈ = L b + H F̄ with their posterior mean F̄ (`forces/slopes.py`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.linearization import linearize_field
from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.observations import NoiseStd
from forcegp.forces.quantities import States
from forcegp.robot.model import RobotModel

ForceField = Callable[[ConstrainedSystem, States], Tensor]
"""The impressed force Q̄ at states, `(n, nq)`."""


def state_jacobian(
    system: ConstrainedSystem, m: Measurement, force: ForceField | None = None
) -> Tensor | None:
    """G = dz/d(q, q̇) `(n, d, 2 nq)` of measured accelerations or multipliers; `None` for other quantities.

    Args:
        system: robot and contacts.
        m: the measurement.
        force: all impressed forces; by default those of the robot file and the measured torque.
    """
    if m.quantity not in ("qdd", "multiplier"):
        return None
    if force is None:
        at = system.linearize(m.q, m.qd, m.tau, m.active)
    else:
        at = linearize_field(force, system, m.q, m.qd, m.tau, m.active)
    pair = (at.dq, at.dqd) if m.quantity == "qdd" else (at.multiplier_dq, at.multiplier_dqd)
    return torch.cat(pair, dim=-1)


def learned_slopes(training: Training, system: ConstrainedSystem, force: ForceField) -> Training:
    """Training data with G of a force field at each sample."""
    slopes = tuple(state_jacobian(system, m, force) for m in training.measurements)
    return dataclasses.replace(training, slopes=slopes)


def state_std_of(given: Sequence[NoiseStd] | None, robot: RobotModel) -> Tensor | None:
    """Standard deviation of the noise of q and q̇ as one vector `(2 nq,)`; `None` for none.

    Raises:
        ModelError: these are no two standard deviations, each one number or one per joint, 0 or above.
    """
    if given is None:
        return None
    try:
        std = [torch.as_tensor(x, dtype=robot.dtype, device=robot.device).expand(robot.nq) for x in given]
        valid = len(std) == 2 and all(bool(((x >= 0.0) & torch.isfinite(x)).all()) for x in std)
    except (TypeError, ValueError, RuntimeError):
        valid, std = False, []
    if not valid:
        raise ModelError(
            "the noise of the state is not valid",
            expected=f"two standard deviations, of q and q̇, each one number or {robot.nq}, 0 or above",
            got=given,
        )
    return torch.cat(std)
