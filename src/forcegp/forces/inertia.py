"""Which inertia a measured robot has: that of its file, with drives that the file lacks, or another one.

Stretches of the log that an estimate has not seen say whether it predicts torques better than the file
(`inverse_dynamics.py`). Where other inertial parameters of the links do, the robot gets them (`links.py`).

Torques do not settle everything. In a closed loop the noise of the torque sensor exceeds the torque
that accelerates a light joint; divided by the inertia of the file it predicts accelerations that are larger
than all that were measured. Where that is so, the drives get the inertia that maximises
−½ Σ ε²/s² + v Σ log |M|, with the smallest v ≤ 1 at which accelerations are predicted as well as by their
mean, as long as the error of no joint's torque on held-out stretches grows by more than 2 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import mass_matrix
from forcegp.forces.inverse_dynamics import (
    LEAST,
    Rows,
    Sums,
    acceleration_errors,
    free_rows,
    held_out,
    is_harmless,
    is_less,
    log_ratio,
    sums,
)
from forcegp.forces.links import rigid_robot
from forcegp.forces.measurements import Training
from forcegp.forces.priors.base import ForceMean
from forcegp.forces.priors.joint_friction import JointFrictionPrior
from forcegp.robot.model import RobotModel

VOLUME_STATES = 60
"""States that log |M| is averaged over."""
NEGLIGIBLE = 0.02
"""Inertia of a drive over its joint's that is left out: a gain of the torque sensor explains as much."""
WEIGHTS = tuple(2.0 ** (-k / 2) for k in range(20, -1, -1))
"""Weights v of the volume, from 1/1024 to 1."""


@dataclass(frozen=True)
class Inertia:
    """What the log says of the inertia.

    Attributes:
        robot: that of the file, with the inertia that was found.
        identified: whether inertial parameters of links were, of which some uncertainty remains.
        doubts: what a user should know.
    """

    robot: RobotModel
    identified: bool = False
    doubts: tuple[str, ...] = ()


@torch.no_grad()
def inertia_of(
    system: ConstrainedSystem, friction: JointFrictionPrior, mean: ForceMean, training: Training
) -> Inertia:
    """What the samples in free motion say of the inertia of a measured robot.

    Args:
        system: robot and contacts of the robot file.
        friction: what the friction of a joint depends on.
        mean: prior mean of Q, with the motor torque.
        training: samples in motion.
    """
    robot = system.robot
    rows = free_rows(system, friction, mean, training)
    if rows is None:
        return Inertia(robot, doubts=_unchecked(training))
    remembering = rows.with_memory()
    identified = rigid_robot(robot, remembering)
    if identified is not None:
        text = "held-out torques ask for other inertial parameters than the robot file's, now identified"
        return Inertia(identified, True, (text, *_told(robot, identified.armature - robot.armature)))
    M = mass_matrix(robot, rows.q)
    armature = _damped(rows, M, _lacking(remembering, M))
    armature = armature * (armature > NEGLIGIBLE * M.diagonal(dim1=-2, dim2=-1).mean(0))
    if not bool(armature.any()):
        return Inertia(robot)
    return Inertia(robot.replace(armature=robot.armature + armature), doubts=_told(robot, armature))


def _unchecked(training: Training) -> tuple[str, ...]:
    """The warning for a log in contact with neither free motion nor a measured force."""
    closed = sum(int(m.active.any(-1).sum()) for m in training.measurements)
    if not closed or set(training.quantities) != {"qdd"}:
        return ()
    free = max(int((~m.active.any(-1)).sum()) for m in training.measurements)
    return (
        f"{free} samples in free motion are too few to check the masses of the robot file (expected: {LEAST} "
        "or more), and any error of the masses biases the multiplier: add a few seconds of free motion to "
        "the log, or measure the contact force",
    )


def _told(robot: RobotModel, armature: Tensor) -> tuple[str, ...]:
    """What a user is told of drives whose inertia was found `(nq,)`."""
    pairs = zip(robot.joint_names, armature.tolist(), strict=True)
    found = ", ".join(f"{name} {a:.2g}" for name, a in pairs if a > 0.0)
    lacks = "the drives have inertia that the robot file lacks [kg m², kg for sliding joints]"
    return (f"{lacks}: {found}",) if found else ()


def _lacking(rows: Rows, M: Tensor) -> Tensor:
    """Inertia of drives `(nq,)` that predicts held-out torques significantly better than none, or zero.

    No joint's acceleration error may grow.
    """
    C = torch.diag_embed(rows.qdd)
    drives, none = sums(rows, C), torch.zeros_like(M[0, 0])
    every = drives.total()
    noise = _noise(every)
    alone = held_out(drives, lambda given: _drives(given, noise, M, 0.0))
    if not is_less(log_ratio(alone, held_out(drives, lambda _: none)).mean(-1)):
        return none
    found = _drives(every, noise, M, 0.0)
    before = acceleration_errors(rows, drives, C, none, M)
    after = acceleration_errors(rows, drives, C, found, M + torch.diag(found))
    return found if is_harmless(after, before) else none


def _noise(every: Sums) -> Tensor:
    """Root mean square of the torque that the file and friction leave `(nq,)`."""
    none = every.gram.new_zeros(every.unknowns)
    return every.error(none, every.friction(none)).clamp(min=1e-300).sqrt()


def _excess(rows: Rows, every: Sums, M: Tensor, armature: Tensor) -> float:
    """Logarithm of the squared acceleration error over that of the mean acceleration, mean of the joints."""
    friction = every.friction(armature)
    left = rows.slides * (rows.residual - armature * rows.qdd - (rows.friction * friction).sum(-1))
    missed = torch.linalg.solve(M + torch.diag(armature), left[..., None])[..., 0]
    spread = rows.qdd - rows.qdd.mean(0)
    return float((missed.square().mean(0) / spread.square().mean(0)).log().mean())


def _damped(rows: Rows, M: Tensor, found: Tensor) -> Tensor:
    """Inertia of drives beyond the file's `(nq,)`, raised where accelerations are below the noise of torques.

    They are if their mean predicts them better than the torques and friction with memory do: what that
    friction explains is no noise.

    Args:
        rows: the samples.
        M: mass matrix of the file at the samples.
        found: inertia of drives that torques ask for.
    """
    remembering, C = rows.with_memory(), torch.diag_embed(rows.qdd)
    if _excess(remembering, sums(remembering, C).total(), M, found) <= 0.0:
        return found
    by_stretch = sums(rows, C)
    every = by_stretch.total()
    noise = _noise(every)
    alone = held_out(by_stretch, lambda given: _drives(given, noise, M, 0.0))
    for weight in WEIGHTS:
        if _excess(rows, every, M, found) <= 0.0:
            break
        if not is_harmless(held_out(by_stretch, lambda given, v=weight: _drives(given, noise, M, v)), alone):
            break
        found = _drives(every, noise, M, weight)
    return found


def _drives(given: Sums, noise: Tensor, M: Tensor, weight: float) -> Tensor:
    """a ≥ 0 that minimises ½ Σ ε²/s² − v Σ log |M + diag a|, both over all samples."""
    H, h = given.quadratic(noise)
    n, M = float(given.count.max()), M[:: max(1, len(M) // VOLUME_STATES)]
    scale = M.diagonal(dim1=-2, dim2=-1).mean(0)
    H, h = (H * scale[:, None] * scale / n).cpu().numpy(), (h * scale / n).cpu().numpy()
    relative = (M / (scale[:, None] * scale).sqrt()).cpu().numpy()

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        moved = relative + np.diag(x)
        value = 0.5 * x @ H @ x - h @ x - weight * np.linalg.slogdet(moved)[1].mean()
        slope = np.linalg.inv(moved).diagonal(axis1=-2, axis2=-1).mean(0)
        return float(value), H @ x - h - weight * slope

    start = np.zeros(len(h))
    found = scipy.optimize.minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * len(h)
    )
    return torch.from_numpy(found.x).to(scale) * scale
