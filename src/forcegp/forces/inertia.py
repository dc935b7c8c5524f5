"""Inertia of a measured robot: that of its file, with drives that the file lacks, or identified inertia.

Held-out stretches of the log decide whether an estimate predicts torques better than the file
(`inverse_dynamics.py`). With noisy accelerations, least squares underestimates inertia; with noisy torques in
closed loop, the likelihood of accelerations given torques overestimates it. The equations of motion a little
earlier and later are instruments without either bias. The unknowns are Gaussian around the robot file, each
link stays physically consistent, and the inertia of a drive is not negative.

Torque and motion are seldom read at the same instant, and milliseconds between them make the inertia of a
light joint wrong. So a delay is a further unknown.

Torques alone do not suffice. In a closed loop the noise of the torque sensor exceeds the torque that
accelerates a light joint; divided by the inertia of the file it predicts accelerations far larger than the
measured ones. From ten times their mean square on, the drives get the inertia that maximises
−½ Σ ε²/s² + v Σ log |M|, with the smallest v ≤ 1 at which accelerations are predicted as well as by their
mean, as long as the error of no joint's torque on held-out stretches grows by more than 2 %.

If an `InertialPrior` is given, the robot moves to the posterior mean of its inertial
parameters: one Gauss–Newton step, physically consistent.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import mass_matrix
from forcegp.forces.calibration import autocorrelation_time
from forcegp.forces.inverse_dynamics import (
    LATE,
    LEAST,
    Estimate,
    NormalEquations,
    Rows,
    acceleration_errors,
    averaged,
    free_rows,
    held_out,
    instrumental,
    is_harmless,
    is_less,
    products,
    sums,
)
from forcegp.forces.measurements import Training
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ForceMean
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.problem import Problem, force_posterior
from forcegp.gp.features import Block
from forcegp.identification import regressor
from forcegp.robot.model import RobotModel

PASSES = 3
"""Estimates of the unknowns, each with the noise that the one before left."""
WIDTHS = (0.0, 0.02, 0.05, 0.12)
"""Standard deviations of averages over time that are tried [s]; the narrowest posterior is taken."""


def rigid_robot(robot: RobotModel, rows: Rows) -> tuple[RobotModel, bool]:
    """The robot that predicts held-out torques best, and whether its links were identified.

    Candidates are the file, the file with drives that it lacks, and physically consistent links with drives.
    Each must be better by two standard errors over stretches of the log than those before it, and no joint's
    held-out acceleration error may grow.

    Args:
        robot: of the file.
        rows: samples in free motion.
    """
    prior, n = InertialPrior(), robot.nq
    M = mass_matrix(robot, rows.q)
    size = M.diagonal(dim1=-2, dim2=-1).mean(0)
    links = regressor(robot, rows.q, rows.qd, rows.qdd) * prior.scale(robot)
    inertial = torch.cat([size * torch.diag_embed(rows.qdd), links], dim=-1)
    C = with_delay(rows, inertial)
    regressions, judged = tuple(_over_widths(rows, inertial, M)), products(rows, C)
    single = regressions[0]
    found = max(regressions, key=lambda each: float(torch.logdet(each.normal()[1])))
    delay = torch.tensor([C.shape[-1] - 1])
    driving, everything = torch.cat([torch.arange(n), delay]), torch.arange(C.shape[-1])

    def compared(estimate: Estimate) -> Tensor:
        """Held-out errors of single samples in units of their noise; averages hardly show sharp friction."""
        return held_out(single.by_stretch, estimate, judged, found.by_stretch) / single.noise**2

    def estimated(kept: Tensor) -> Tensor:
        return compared(lambda rest: found.estimate(rest, kept, n))

    def accelerations(other: RobotModel, delta: Tensor) -> Tensor:
        return acceleration_errors(rows, single.by_stretch, C, delta, mass_matrix(other, rows.q))

    every = found.by_stretch.total()
    nothing, drives, delta = (found.estimate(every, kept, n) for kept in (delay, driving, everything))
    file, driven = estimated(delay), estimated(driving)
    before, known = accelerations(robot, nothing), min((file, driven), key=lambda error: float(error.mean()))
    if _is_better(estimated(everything), known):
        consistent, delta = _consistent(robot, prior, found, size)
        better = _is_better(compared(lambda _: delta), known)
        if better and is_harmless(accelerations(consistent, delta), before):
            return consistent, True
    with_drives = robot.replace(armature=robot.armature + size * drives[:n])
    better = _is_better(driven, file) and is_harmless(accelerations(with_drives, drives), before)
    return with_drives if better else robot, False


def _consistent(
    robot: RobotModel, prior: InertialPrior, found: _Regression, size: Tensor
) -> tuple[RobotModel, Tensor]:
    """The robot with consistent links and drives that are not negative, and the unknowns.

    Links are moved without knowledge of the drives, which adapt to them; a drive that would be negative then
    is left out.

    Args:
        size: unit of the inertia of each drive `(nq,)`.
    """
    every, n = found.by_stretch.total(), len(size)
    _, precision = found.normal()
    p = len(precision)
    links, last = torch.arange(n, p - 1), torch.tensor([p - 1])
    unknowns = found.estimate(every, torch.arange(p), n)
    while True:
        drives = (unknowns[:n] > 0.0).nonzero()[:, 0]
        others = torch.cat([drives, last])
        best = found.estimate(every, torch.cat([others, links]), n)
        moved, delta = prior.updated(robot, best[links], _marginal(precision, links, others))
        known = torch.zeros_like(best).index_put((links,), delta)
        unknowns = found.estimate(every, others, n, known)
        if bool((unknowns[drives] > 0.0).all()):
            return moved.replace(armature=robot.armature + size * unknowns[:n]), unknowns


def with_delay(rows: Rows, columns: Tensor) -> Tensor:
    """Columns of inertial parameters and, last, of the delay s of the torque: τ(t + s) ≈ τ(t) + s dτ/dt."""
    return torch.cat([columns, LATE * rows.rate[..., None]], dim=-1)


@dataclass(frozen=True)
class _Regression:
    """Unknowns by instrumental variables, with the noise `(nq,)` and the power κ that they leave."""

    by_stretch: NormalEquations
    noise: Tensor
    power: float

    def normal(self, given: NormalEquations | None = None) -> tuple[Tensor, Tensor]:
        """Linear term κ h and precision κ H + 1 of the unknowns, without directions of negative H."""
        H, h = (given or self.by_stretch.total()).quadratic(self.noise)
        values, vectors = torch.linalg.eigh(0.5 * (H + H.mT))
        shown = vectors * (values > 0.0)
        precision = self.power * (vectors * values.clamp(min=0.0)) @ vectors.mT
        eye = torch.eye(len(h), dtype=h.dtype, device=h.device)
        return self.power * shown @ (vectors.mT @ h), precision + eye

    def estimate(self, given: NormalEquations, kept: Tensor, n: int, known: Tensor | None = None) -> Tensor:
        """Most probable unknowns among those that are kept; the first n, drives, are not negative.

        Args:
            known: values of the others, zero by default.
        """
        h, precision = self.normal(given)
        known = torch.zeros_like(h) if known is None else known
        h = h - precision @ known
        L = torch.linalg.cholesky(precision[kept][:, kept])
        right = torch.linalg.solve_triangular(L, h[kept, None], upper=False)[:, 0]
        lower = torch.where(kept < n, 0.0, -math.inf)
        bounds = lower.numpy(), math.inf
        found = scipy.optimize.lsq_linear(L.mT.cpu().numpy(), right.cpu().numpy(), bounds, method="bvls")
        return known.index_put((kept,), torch.from_numpy(found.x).to(h))


def _marginal(precision: Tensor, kept: Tensor, others: Tensor) -> Tensor:
    """Precision of some unknowns without knowledge of others: a Schur complement."""
    across = precision[kept][:, others]
    return precision[kept][:, kept] - across @ torch.linalg.solve(precision[others][:, others], across.mT)


def _over_widths(rows: Rows, inertial: Tensor, M: Tensor) -> Iterator[_Regression]:
    """Regressions on equations that are averaged over time, by the width of the average.

    Args:
        inertial: columns of drives and links `(n, nq, p)`.
        M: mass matrix of the file.
    """
    accelerating, n = (M @ rows.qdd[..., None])[..., 0], M.shape[-1]
    for width in WIDTHS if rows.step else WIDTHS[:1]:
        used, columns = averaged(rows, inertial, accelerating, width) if rows.step else (rows, inertial)
        if width and (int(used.slides.sum(0).min()) < LEAST or int(used.group.max()) < int(rows.group.max())):
            break
        columns = with_delay(used, columns)
        by_stretch, kept = instrumental(used, columns), torch.arange(columns.shape[-1])
        every, mean = by_stretch.total(), columns.new_zeros(len(kept))
        found = _Regression(by_stretch, M.new_ones(n), 1.0)
        for _ in range(PASSES):
            left = used.residual - columns @ mean - (used.friction * every.friction(mean)).sum(-1)
            left = used.slides * left
            noise = (left.square().sum(0) / used.slides.sum(0).clamp(min=1)).sqrt().clamp(min=1e-300)
            found = _Regression(by_stretch, noise, _power(used, left / noise))
            mean = found.estimate(every, kept, n)
        yield found


def _power(rows: Rows, left: Tensor) -> float:
    """κ = 1/τ̄ of what nothing explains, as in `residual_times`."""
    times = autocorrelation_time(left[: rows.leading], rows.segment[: rows.leading])
    return min(1.0, math.exp(-float(times.log().mean())))


def _is_better(after: Tensor, before: Tensor) -> bool:
    """Whether errors `(groups, nq)` are significantly smaller, in the mean of the joints."""
    return is_less((after - before).mean(-1))


VOLUME_STATES = 100
"""States that log |M|, or the volume of the noise, is averaged over."""
FAR_LARGER = 10.0
"""Mean squared error of accelerations over that of their mean from which drives are damped."""
NEGLIGIBLE = 0.02
"""Inertia of a drive over its joint's that is left out: a gain of the torque sensor explains as much."""
WEIGHTS = tuple(2.0 ** (-k / 2) for k in range(20, -1, -1))
"""Weights v of the volume, from 1/1024 to 1."""


@dataclass(frozen=True)
class Inertia:
    """Inertia that the log determines.

    Attributes:
        robot: that of the file, with the identified inertia.
        identified: whether inertial parameters of links were identified, so that some uncertainty remains.
        doubts: warnings for the user.
    """

    robot: RobotModel
    identified: bool = False
    doubts: tuple[str, ...] = ()


@torch.no_grad()
def inertia_of(
    system: ConstrainedSystem, friction: JointFrictionPrior, mean: ForceMean, training: Training
) -> Inertia:
    """Identify the inertia of a measured robot from samples in free motion.

    Args:
        system: robot and contacts of the robot file.
        friction: inputs of the friction of a joint.
        mean: prior mean of Q, with the motor torque.
        training: samples in motion, `LEAST` of them free.
    """
    robot = system.robot
    rows = free_rows(system, friction, mean, training)
    better, has_links = rigid_robot(robot, rows.with_memory())
    if has_links:
        text = "held-out torques favour other inertial parameters than the robot file's, now identified"
        return Inertia(better, True, (text, *_told(robot, better.armature - robot.armature)))
    M = mass_matrix(robot, rows.q)
    armature = _damped(rows, M, better.armature - robot.armature)
    armature = armature * (armature > NEGLIGIBLE * M.diagonal(dim1=-2, dim2=-1).mean(0))
    if not bool(armature.any()):
        return Inertia(robot)
    return Inertia(robot.replace(armature=robot.armature + armature), doubts=_told(robot, armature))


def _told(robot: RobotModel, armature: Tensor) -> tuple[str, ...]:
    """Message on drives with identified inertia `(nq,)`."""
    pairs = zip(robot.joint_names, armature.tolist(), strict=True)
    found = ", ".join(f"{name} {a:.2g}" for name, a in pairs if a > 0.0)
    lacks = "the drives have inertia that the robot file lacks [kg m², kg for sliding joints]"
    return (f"{lacks}: {found}",) if found else ()


def _noise(every: NormalEquations) -> Tensor:
    """Root mean square of the torque that the file and friction leave `(nq,)`."""
    none = every.gram.new_zeros(every.unknowns)
    return every.error(none, every.friction(none)).clamp(min=1e-300).sqrt()


def _excess(rows: Rows, every: NormalEquations, M: Tensor, armature: Tensor) -> float:
    """Logarithm of the squared acceleration error over that of the mean acceleration, mean of the joints."""
    friction = every.friction(armature)
    left = rows.slides * (rows.residual - armature * rows.qdd - (rows.friction * friction).sum(-1))
    missed = torch.linalg.solve(M + torch.diag(armature), left[..., None])[..., 0]
    spread = rows.qdd - rows.qdd.mean(0)
    return float((missed.square().mean(0) / spread.square().mean(0)).log().mean())


def _damped(rows: Rows, M: Tensor, found: Tensor) -> Tensor:
    """Inertia of drives beyond the file's `(nq,)`, raised where accelerations are below the noise of torques.

    They are if torques and friction with memory predict them far worse than their mean does: what that
    friction explains is no noise. Drives are then raised until both are equal.

    Args:
        M: mass matrix of the file at the samples.
        found: inertia of drives identified from torques.
    """
    remembering, C = rows.with_memory(), torch.diag_embed(rows.qdd)
    if _excess(remembering, sums(remembering, C).total(), M, found) <= math.log(FAR_LARGER):
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


def _drives(given: NormalEquations, noise: Tensor, M: Tensor, weight: float) -> Tensor:
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


@torch.no_grad()
def with_updated_robot(problem: Problem, values: Mapping[str, Tensor]) -> Problem:
    """The problem with the robot at the posterior mean of its inertial parameters (a Gauss–Newton step)."""
    for p, prior in enumerate(problem.priors):
        moves = prior.name not in problem.pinned and problem.parameters is None
        if isinstance(prior, InertialPrior) and moves and not prior.drives:
            posterior = force_posterior(problem, values)
            features = one_row(posterior, problem)
            mean = posterior.latent.latent_mean(p, features[p])[0]
            precision = latent_precision(posterior, features, p, problem.system.robot)
            volume = _log_volume(problem, values)
            robot, moved = prior.updated(problem.system.robot, mean, precision, volume)
            # The prior keeps the scale of the file's parameters, not that of the updated ones.
            return dataclasses.replace(
                problem,
                system=problem.system.with_robot(robot),
                priors=tuple(prior.around(problem.system.robot) if q is prior else q for q in problem.priors),
                pinned={prior.name: moved},
            )
    return problem


def _log_volume(problem: Problem, values: Mapping[str, Tensor]) -> Callable[[RobotModel], Tensor]:
    """κ Σ_i log |M (Σ_τ + M Σ_q̈ Mᵀ)^−½| at the samples in free motion, as a function of the robot.

    With it, the density of the torque's error is that of the acceleration's. Without it, a robot that has
    next to no inertia explains small torques best, whatever it does to the accelerations.
    """
    terms = []
    std = problem.system.robot.mass.new_zeros(problem.system.robot.nq)
    if TORQUE_NOISE in values:
        std = values[TORQUE_NOISE].exp()
    elif problem.torque_std is not None:
        std = problem.torque_std
    for i in (i for i, quantity in enumerate(problem.training.quantities) if quantity == "qdd"):
        m = problem.training.measurements[i]
        free = (~m.active.any(-1)).nonzero()[:, 0]
        if not len(free):
            continue
        q = m.q[free[torch.linspace(0, len(free) - 1, min(VOLUME_STATES, len(free))).round().long()]]
        noise = problem.noise_at(values, i)
        spread = (noise if noise.ndim == 1 else noise.square().mean(0).sqrt()).detach() ** 2
        terms.append((q, problem.power * len(free) / len(q), spread))

    def volume(robot: RobotModel) -> Tensor:
        total = robot.mass.new_zeros(())
        for q, weight, spread in terms:
            M = mass_matrix(robot, q)
            C = torch.diag(std**2) + (M * spread) @ M.mT
            total = total + weight * (torch.logdet(M) - 0.5 * torch.logdet(C)).sum()
        return total

    return volume


def one_row(posterior: ForcePosterior, problem: Problem) -> list[dict[str, Tensor]]:
    """Kernel inputs of every prior at the first sample; constants have the same value everywhere."""
    m = problem.training.measurements[0]
    at = m[torch.zeros(1, dtype=torch.int64, device=m.q.device)].at(problem.system)
    return [posterior.process.features(p, problem.system, at) for p in range(len(problem.priors))]


def latent_precision(
    posterior: ForcePosterior, features: list[dict[str, Tensor]], p: int, robot: RobotModel
) -> Tensor:
    """Inverse posterior covariance of the components of prior p, all others marginalised."""
    widths = [prior.outputs(robot) for prior in posterior.priors]
    eye = torch.eye(widths[p], dtype=robot.dtype, device=robot.device)
    operators = [eye[None] if q == p else eye.new_zeros(1, widths[p], w) for q, w in enumerate(widths)]
    block = Block(tuple(features), tuple(operators), eye[:1])
    return torch.linalg.inv(posterior.latent.covariance(block)[0])
