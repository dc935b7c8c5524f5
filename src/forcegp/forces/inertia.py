"""Which inertia a measured robot has: that of its file, of drives that the file lacks, or one to be learned.

In free motion τ + Q_C + Q_G + Q_D − M₀ q̈ = C δ + Φ w + ε, with friction Φ w of each joint on its own. Each
column of C is the torque of one unknown: the inertia of a drive, or an inertial parameter of a link.
Stretches of the log that an estimate has not seen say whether it predicts torques better than the file.

Torques do not settle everything. In a closed loop the noise of the torque sensor exceeds the torque
that accelerates a light joint; divided by the inertia of the file it predicts accelerations that are larger
than all that were measured. Where that is so, the drives get the inertia that maximises
−½ Σ ε²/s² + v Σ log |M|, with the smallest v ≤ 1 at which accelerations are predicted as well as by their
mean, as long as the error of no joint's torque on held-out stretches grows by more than 2 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import mass_matrix
from forcegp.forces.calibration import autocorrelation_time, stretches
from forcegp.forces.measurements import Training
from forcegp.forces.priors.base import ForceMean
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint_friction import JointFrictionPrior
from forcegp.identification import regressor
from forcegp.robot.model import RobotModel

LEAST, MOST = 200, 4000
"""Samples in free motion needed at least, and used at most, evenly spaced."""
SCATTER = 4.0
"""Ratio of mean squares of the torque at rest and in motion from which a joint sticks at rest."""
MOVES = 0.1
"""Share of the samples in which a joint moves at least, for its sticking to count."""
VOLUME_STATES = 60
"""States that log |M| is averaged over."""
SIGNIFICANT = 2.0
"""Standard errors, over stretches, beyond which a difference counts."""
TOLERATED = 0.02
"""Relative increase of the held-out torque error of a joint that is worth better accelerations."""
WEIGHTS = tuple(2.0 ** (-k / 2) for k in range(20, -1, -1))
"""Weights v of the volume, from 1/1024 to 1."""
RIDGE = 1e-8
"""Of the scaled friction columns, relative to the number of samples."""


@dataclass(frozen=True)
class Inertia:
    """What the log says of the inertia.

    Attributes:
        robot: with the inertia of drives that was found.
        learned: whether all inertial parameters are to be learned with the forces.
        doubts: what a user should know.
    """

    robot: RobotModel
    learned: bool = False
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Rows:
    """Samples in free motion.

    Attributes:
        q, qd, qdd: `(n, nq)`.
        residual: torque that the robot of the file leaves `(n, nq)`.
        friction: Φ, features of the friction of each joint and its offset `(n, nq, f)`.
        slides: `(n, nq)` bool, joints that move; the friction of one that sticks is whatever holds it, so its
            torque says nothing there.
        group: stretch of each sample `(n,)`, from 0 without gaps.
        segment: `(n,)`.
    """

    q: Tensor
    qd: Tensor
    qdd: Tensor
    residual: Tensor
    friction: Tensor
    slides: Tensor
    group: Tensor
    segment: Tensor


@dataclass(frozen=True)
class Sums:
    """Σ XᵀX `(..., nq, p + f, p + f)`, Σ Xᵀr, Σ r² and the numbers of samples, with X = (C, Φ) by joint."""

    gram: Tensor
    right: Tensor
    square: Tensor
    count: Tensor
    unknowns: int

    def total(self) -> Sums:
        """Over all stretches."""
        return self._each(lambda x: x.sum(0))

    def of(self, g: int) -> Sums:
        """One stretch."""
        return self._each(lambda x: x[g])

    def without(self, g: int) -> Sums:
        """All stretches but one."""
        return self._each(lambda x: x.sum(0) - x[g])

    def _each(self, part: Callable[[Tensor], Tensor]) -> Sums:
        return Sums(part(self.gram), part(self.right), part(self.square), part(self.count), self.unknowns)

    def friction(self, delta: Tensor) -> Tensor:
        """w `(nq, f)` that explains what δ leaves."""
        p = self.unknowns
        right = self.right[:, p:] - self.gram[:, p:, :p] @ delta
        return torch.linalg.solve(self._stiff(), right[..., None])[..., 0]

    def _stiff(self) -> Tensor:
        p = self.unknowns
        eye = torch.eye(self.gram.shape[-1] - p, dtype=self.gram.dtype, device=self.gram.device)
        return self.gram[:, p:, p:] + RIDGE * self.count[:, None, None] * eye

    def quadratic(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        """H and h with Σ_j |ε_j|²/s_j² = δᵀH δ − 2 hᵀδ + …, friction at its best."""
        p = self.unknowns
        share = torch.linalg.solve(self._stiff(), self.gram[:, p:, :p])
        H = self.gram[:, :p, :p] - self.gram[:, :p, p:] @ share
        h = self.right[:, :p] - (share.mT @ self.right[:, p:, None])[..., 0]
        weight = noise**-2
        return torch.einsum("j,jpq->pq", weight, H), weight @ h

    def error(self, delta: Tensor, friction: Tensor) -> Tensor:
        """Mean square of ε, `(nq,)`."""
        x = torch.cat([delta.expand(len(friction), -1), friction], dim=-1)
        fitted = 2.0 * (x * self.right).sum(-1) - torch.einsum("jp,jpq,jq->j", x, self.gram, x)
        return (self.square - fitted).clamp(min=1e-300) / self.count


Estimate = Callable[[Sums], Tensor]
"""δ from sums."""


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
    rows = _rows(system, friction, mean, training)
    if rows is None:
        return Inertia(robot)
    drives = sums(rows, torch.diag_embed(rows.qdd))
    none = rows.qdd.new_zeros(robot.nq)
    before = held_out(drives, lambda _: none)
    every = drives.total()
    noise = every.error(none, every.friction(none)).sqrt()
    M = mass_matrix(robot, rows.q)
    alone = held_out(drives, lambda given: _drives(given, noise, M, 0.0))
    helped = is_better(alone, before)
    if links_are_wrong(robot, rows, noise, alone if helped else before):
        text = (
            "held-out torques ask for other inertial parameters than the robot file's: they are learned too"
        )
        return Inertia(robot, learned=True, doubts=(text,))
    armature = inertia_of_drives(rows, drives, noise, M, alone, helped)
    if not bool(armature.any()):
        return Inertia(robot)
    pairs = zip(robot.joint_names, armature.tolist(), strict=True)
    found = ", ".join(f"{name} {a:.2g}" for name, a in pairs if a > 0.0)
    text = f"the drives have inertia that the robot file lacks [kg m², kg for sliding joints]: {found}"
    return Inertia(robot.replace(armature=robot.armature + armature), doubts=(text,))


def _rows(
    system: ConstrainedSystem, prior: JointFrictionPrior, mean: ForceMean, training: Training
) -> Rows | None:
    """The samples in free motion; `None` where there are too few."""
    for quantity, m in zip(training.quantities, training.measurements, strict=True):
        free = (~m.active.any(-1)).nonzero()[:, 0]
        if quantity != "qdd" or len(free) < LEAST:
            continue
        m = m[free[torch.linspace(0, len(free) - 1, min(MOST, len(free))).round().long().to(free.device)]]
        _, group = stretches(m.segment).unique(return_inverse=True)
        at = m.at(system)
        features = [*prior.features(system, at).values(), torch.ones_like(at.q)[..., None]]
        Phi = torch.cat(features, dim=-1)
        Phi = Phi / Phi.square().mean(0).sqrt().clamp(min=1e-12)
        residual = mean(system, at) - (at.eom.M @ m.values[..., None])[..., 0]
        slides = _slides(m.qd.abs() >= min(prior.speeds), Phi, residual)
        return Rows(m.q, m.qd, m.values, residual, Phi, slides, group, m.segment)
    return None


def _slides(moving: Tensor, Phi: Tensor, residual: Tensor) -> Tensor:
    """`(n, nq)` bool, without the joints that stick: that hardly move, and whose torque then scatters more.

    Args:
        moving: `(n, nq)` bool, faster than the sharpest dry friction.
        Phi: features of friction `(n, nq, f)`.
        residual: `(n, nq)` torque that the robot of the file leaves.
    """
    weighted = moving[..., None] * Phi
    w = torch.linalg.lstsq(weighted.transpose(0, 1), (moving * residual).mT[..., None]).solution[..., 0]
    left = (residual - (Phi * w).sum(-1)).square()
    at_rest, sliding = (
        (part * left).sum(0) / part.sum(0).clamp(min=1) for part in ((~moving).double(), moving.double())
    )
    sticks = (at_rest > SCATTER * sliding) & (moving.double().mean(0) >= MOVES)
    return moving | ~sticks


def sums(rows: Rows, columns: Tensor) -> Sums:
    """Sums by stretch, with C `(n, nq, p)`."""
    groups = int(rows.group.max()) + 1
    found = []
    for g in range(groups):
        own = rows.group == g
        slides = rows.slides[own]
        X = (slides[..., None] * torch.cat([columns[own], rows.friction[own]], dim=-1)).transpose(0, 1)
        r = (slides * rows.residual[own]).mT
        count = slides.sum(0).to(r.dtype).clamp(min=1.0)
        found.append((X.mT @ X, (X.mT @ r[..., None])[..., 0], r.square().sum(-1), count))
    gram, right, square, count = (torch.stack(parts) for parts in zip(*found, strict=True))
    return Sums(gram, right, square, count, columns.shape[-1])


def held_out(by_stretch: Sums, estimate: Estimate) -> Tensor:
    """Mean squares of torque errors on stretches that neither δ nor friction have seen, `(groups, nq)`."""
    errors = []
    for g in range(len(by_stretch.gram)):
        rest = by_stretch.without(g)
        delta = estimate(rest)
        errors.append(by_stretch.of(g).error(delta, rest.friction(delta)))
    return torch.stack(errors)


def difference(after: Tensor, before: Tensor) -> tuple[float, float]:
    """Mean log ratio of root mean squares `(groups, nq)`, and its standard error over the stretches."""
    ratio = 0.5 * (after / before).log().mean(-1)
    return float(ratio.mean()), float(ratio.std() / math.sqrt(len(ratio)))


def is_better(after: Tensor, before: Tensor) -> bool:
    """Whether errors are significantly smaller."""
    mean, error = difference(after, before)
    return mean < -SIGNIFICANT * error


def is_harmless(after: Tensor, before: Tensor) -> bool:
    """Whether the errors of no joint are larger by more than is tolerated."""
    return bool((0.5 * (after / before).log().mean(0) <= TOLERATED).all())


def links_are_wrong(robot: RobotModel, rows: Rows, noise: Tensor, before: Tensor) -> bool:
    """Whether learned inertial parameters predict held-out torques significantly better than what is known.

    They have to do so twice: as free parameters on held-out stretches, and as those of the consistent robot
    that `InertialPrior` moves to.
    """
    prior = InertialPrior()
    columns = regressor(robot, rows.q, rows.qd, rows.qdd) * prior.scale(robot)
    by_stretch = sums(rows, columns)
    power = _power(by_stretch, rows, columns, noise)

    def posterior(given: Sums) -> tuple[Tensor, Tensor]:
        H, h = given.quadratic(noise)
        precision = power * H + torch.eye(len(h), dtype=h.dtype, device=h.device)
        return torch.linalg.solve(precision, power * h), precision

    if not is_better(held_out(by_stretch, lambda given: posterior(given)[0]), before):
        return False
    weight = power * len(rows.q)
    states = rows.q[:: max(1, len(rows.q) // VOLUME_STATES)]

    def log_volume(of: RobotModel) -> Tensor:
        return weight * torch.logdet(mass_matrix(of, states)).mean()

    _, delta = prior.updated(robot, *posterior(by_stretch.total()), log_volume)
    return is_better(held_out(by_stretch, lambda _: delta), before)


def _power(by_stretch: Sums, rows: Rows, columns: Tensor, noise: Tensor) -> float:
    """κ = 1/τ̄ of the torque that friction leaves, as in `likelihood_power`."""
    every = by_stretch.total()
    none = rows.qdd.new_zeros(by_stretch.unknowns)
    left = rows.slides * (rows.residual - (rows.friction * every.friction(none)).sum(-1))
    return min(1.0, math.exp(-float(autocorrelation_time(left / noise, rows.segment).log().mean())))


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
    H, h = (H * scale[:, None] * scale / n).numpy(), (h * scale / n).numpy()
    relative = (M / (scale[:, None] * scale).sqrt()).numpy()

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
