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
from forcegp.forces.inverse_dynamics import LEAST, Rows, Sums, free_rows, held_out, is_less, sums
from forcegp.forces.links import rigid_robot
from forcegp.forces.measurements import Training
from forcegp.forces.priors.base import ForceMean
from forcegp.forces.priors.joint_friction import JointFrictionPrior
from forcegp.robot.model import RobotModel

VOLUME_STATES = 60
"""States that log |M| is averaged over."""
LEAST_SQUARE = 1e-300
"""Mean square of a joint that does not move in a stretch, which has no error."""
TOLERATED = 0.02
"""Relative increase of the held-out torque error of a joint that is worth better accelerations."""
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
    identified = rigid_robot(robot, rows)
    if identified is not None:
        text = "held-out torques ask for other inertial parameters than the robot file's, now identified"
        return Inertia(identified, True, (text, *_told(robot, identified.armature - robot.armature)))
    drives = sums(rows, torch.diag_embed(rows.qdd))
    none = rows.qdd.new_zeros(robot.nq)
    before = held_out(drives, lambda _: none)
    every = drives.total()
    noise = every.error(none, every.friction(none)).clamp(min=1e-300).sqrt()
    M = mass_matrix(robot, rows.q)
    alone = held_out(drives, lambda given: _drives(given, noise, M, 0.0))
    armature = inertia_of_drives(rows, drives, noise, M, alone, is_less(log_ratio(alone, before).mean(-1)))
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


def log_ratio(after: Tensor, before: Tensor) -> Tensor:
    """Of the roots of mean squares; zero for a joint that does not move in a stretch."""
    return 0.5 * (after.clamp(min=LEAST_SQUARE) / before.clamp(min=LEAST_SQUARE)).log()


def is_harmless(after: Tensor, before: Tensor) -> bool:
    """Whether the errors of no joint are larger by more than is tolerated."""
    return bool((log_ratio(after, before).mean(0) <= TOLERATED).all())


def inertia_of_drives(
    rows: Rows, by_stretch: Sums, noise: Tensor, M: Tensor, alone: Tensor, helped: bool
) -> Tensor:
    """Inertia of drives beyond the file's `(nq,)`, zero where torques and accelerations do not need it.

    Args:
        rows, by_stretch: the samples.
        noise: of the torques `(nq,)`.
        M: mass matrix of the file at the samples.
        alone: held-out errors with v = 0.
        helped: whether these are significantly smaller than with the file's inertia.
    """

    def is_sane(armature: Tensor) -> bool:
        """Whether accelerations are predicted as well as by their mean, by the geometric mean of joints."""
        friction = by_stretch.total().friction(armature)
        left = rows.slides * (rows.residual - armature * rows.qdd - (rows.friction * friction).sum(-1))
        missed = torch.linalg.solve(M + torch.diag(armature), left[..., None])[..., 0]
        spread = rows.qdd - rows.qdd.mean(0)
        return float((missed.square().mean(0) / spread.square().mean(0)).log().mean()) <= 0.0

    found = torch.zeros_like(noise)
    if helped:
        found = _drives(by_stretch.total(), noise, M, 0.0)
    for weight in WEIGHTS:
        if is_sane(found):
            break
        if not is_harmless(held_out(by_stretch, lambda given, v=weight: _drives(given, noise, M, v)), alone):
            break
        found = _drives(by_stretch.total(), noise, M, weight)
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
