"""Estimates of an external wrench without learning or error bars, to compare with.

- Quasi-static: w = −J⁺ᵀ (τ + Q_G), which leaves out friction and motion.
- The generalized-momentum observer (De Luca and Mattone, *Sensorless robot collision detection and hybrid
  force/motion control*, ICRA 2005): the residual ρ̇ = K (ṗ − u − ρ) with p = M q̇ is a low-pass filter of the
  external joint force, ρ → Jᵀ w, from which `wrench_of` gives w. Here u = Q − Q_C + ½ ∂(q̇ᵀM q̇)/∂q of the
  robot file, or of a robot and its friction that least squares has identified
  (`forcegp.evaluation.least_squares`).
- Equations of motion with friction, offset and gain of each joint by least squares (`identified_losses`),
  from free motion, or from a log with a force sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.data import Dataset
from forcegp.forces.external_wrench import WrenchFrame, momentum_force
from forcegp.robot.model import RobotModel

DRY_SPEED = 0.05
"""Speed over which dry friction changes sign [rad/s, m/s]."""
TERMS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "offset": lambda qd, tau: torch.ones_like(qd),
    "gain": lambda qd, tau: tau,
    "viscous": lambda qd, tau: qd,
    "Coulomb": lambda qd, tau: torch.tanh(qd / DRY_SPEED),
    "load": lambda qd, tau: tau.abs() * torch.tanh(qd / DRY_SPEED),
}
"""Torques that a robot file lacks, of each joint, up to a factor."""


def identified_losses(
    left: Tensor, qd: Tensor, tau: Tensor, terms: Sequence[str] = tuple(TERMS)
) -> Callable[[Tensor, Tensor], Tensor]:
    """Torque that each joint lacks, as a function of q̇ and τ `(n, nq)`, by least squares of some of `TERMS`.

    Args:
        left: M q̈ − Q − τ − Jᵀw `(n, nq)`, with the wrench of a sensor, or of free motion.
        qd, tau: velocities and torques `(n, nq)`.
    """

    def columns(qd: Tensor, tau: Tensor) -> Tensor:
        return torch.stack([TERMS[name](qd, tau) for name in terms], dim=-1)

    weights = torch.linalg.lstsq(columns(qd, tau).transpose(0, 1), left.T[..., None]).solution[..., 0]
    return lambda qd, tau: (columns(qd, tau) * weights).sum(-1)


def wrench_of(J: Tensor, force: Tensor, damping: float = 0.0) -> Tensor:
    """w = (J Jᵀ + δ²)⁺ J force, which has the least |force − Jᵀ w|² + δ² |w|², `(n, k)`.

    Args:
        J: `(n, k, nq)`.
        force: `(n, nq)` external joint force.
        damping: δ, which keeps w finite near singular poses [m].
    """
    eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    if not damping:
        return (torch.linalg.pinv(J.mT) @ force[..., None])[..., 0]
    return torch.linalg.solve(J @ J.mT + damping**2 * eye, J @ force[..., None])[..., 0]


def quasi_static(robot: RobotModel, data: Dataset, frame: WrenchFrame) -> Tensor:
    """w = −J⁺ᵀ (τ + Q_G) at each sample, `(n, k)` [N, N m]."""
    return wrench_of(frame.jacobian(robot, data.q), -data.tau - dynamics.gravity_force(robot, data.q))


def momentum_residual(
    robot: RobotModel, data: Dataset, gain: float, losses: Callable[[Tensor], Tensor] | None = None
) -> Tensor:
    """External joint force by the momentum observer `(n, nq)` [N m, N]; it starts at zero in each trajectory.

    Args:
        robot: whose M, Q_C, Q_G and Q_D count.
        data: a log in order of time; accelerations are not used.
        gain: K, the inverse of the filter's time constant [1/s].
        losses: torque that further friction takes away, at velocities `(n, nq)`.
    """
    M, added = momentum_force(robot, data.q, data.qd)
    p = (M @ data.qd[..., None])[..., 0]
    u = data.tau + dynamics.gravity_force(robot, data.q) + dynamics.damping_force(robot, data.qd) + added
    u = u if losses is None else u - losses(data.qd)
    rho = torch.zeros_like(p)
    for i in range(1, len(p)):
        h = float(data.t[i] - data.t[i - 1])
        if data.segment[i] != data.segment[i - 1]:
            continue
        keep = math.exp(-gain * h)
        # The exact solution of ρ̇ = K (ṗ − u − ρ) over a step
        rho[i] = keep * rho[i - 1] + (1.0 - keep) * ((p[i] - p[i - 1]) / h - 0.5 * (u[i] + u[i - 1]))
    return rho
