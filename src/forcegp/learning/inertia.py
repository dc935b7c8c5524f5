"""Inertia of a real robot: that of the robot file, the same with added drive inertia, or identified inertia.

Identified links are accepted if they predict torques on held-out blocks of the log better than the robot
file does (`inverse_dynamics.py`), and drives if they are clearly above zero. With noisy accelerations, least
squares underestimates inertia. With noisy torques in closed loop, the likelihood of accelerations given
torques overestimates it. Using the equations of motion at slightly earlier and later times as instruments
avoids both biases. The unknowns have Gaussian priors centred on the robot file. Links stay physically
consistent, and drive inertia is nonnegative.

Torque and motion are seldom sampled at the same instant: a controller that holds each torque for a period
leads the motion by half of it. Milliseconds bias the inertia of a light joint and, since −dτ/dt resembles q̇
along periodic motions, viscous friction. The delay is therefore an additional unknown, and if links are
identified, the model is trained on torques shifted by it.

If an `InertialPrior` is given, the inertial parameters of the robot are set to their posterior mean in
physically consistent Gauss–Newton steps. Columns are at the most probable accelerations
(`accelerations.py`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import scipy
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import mass_matrix
from forcegp.forces.measurements import Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ForceMean
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.ripple import ripple_of
from forcegp.forces.problem import Problem, force_posterior
from forcegp.forces.term import JointState, JointTerm
from forcegp.gp.features import Block
from forcegp.gp.kernels import sub
from forcegp.identification import MASS_SHARE, regressor
from forcegp.learning.correlation import autocorrelation_time
from forcegp.learning.inverse_dynamics import (
    LATE,
    LEAST,
    TOLERATED,
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
    log_ratio,
    products,
    ridged,
)
from forcegp.robot.inertia import inertial_parameters
from forcegp.robot.model import RobotModel

PASSES = 3
"""Number of successive estimates of the unknowns, each using the residual noise of the previous estimate."""
WIDTHS = (0.0, 0.02, 0.05, 0.12)
"""Widths of the time averages to try (standard deviations) [s]; the narrowest posterior is used."""


def rigid_robot(robot: RobotModel, rows: Rows) -> Inertia:
    """Return the robot with the inertia that a log determines.

    The candidates are the robot file, the robot file with the drives that the evidence carries, and a robot
    with identified, physically consistent links and drives. The last must predict held-out torques better
    than the others by two standard errors over blocks of the log, without lower density of the accelerations.
    Drives alone may not increase the acceleration errors of any joint.

    Args:
        robot: robot from the robot file.
        rows: samples in free motion.
    """
    prior, n = InertialPrior(), robot.nq
    M, size = inertia_at(robot, rows.q), drive_scale(robot, rows.q)
    links = links_at(robot, rows) * prior.scale(robot)
    inertial = torch.cat([size * torch.diag_embed(rows.qdd), links], dim=-1)
    C = with_delay(rows, inertial)
    (single, *_), regression = _regressions(rows, inertial, M)
    judged = products(rows, C)
    delay = regression.clear_delay()
    everything = torch.cat([torch.arange(C.shape[-1] - 1), delay])
    gain = GAIN * M.diagonal(dim1=-2, dim2=-1).mean(0) / size
    kept = regression.carried_drives(gain, delay)

    def errors(estimate: Estimate) -> Tensor:
        """Return held-out errors of single samples. Averages would hide sharp friction."""
        return held_out(single.by_stretch, estimate, judged, regression.by_stretch)

    # Units of noise would let the joint with the largest errors decide for all.
    unit = errors(lambda rest: regression.estimate(rest, delay, n)).mean(0).maximum(single.noise**2)

    def compared(estimate: Estimate) -> Tensor:
        """Return held-out errors relative to those of the robot file."""
        return errors(estimate) / unit

    def estimated(kept: Tensor) -> Tensor:
        return compared(lambda rest: regression.estimate(rest, kept, n))

    def accelerations(other: RobotModel, delta: Tensor) -> Tensor:
        return acceleration_errors(rows, single.by_stretch, C, delta, inertia_at(other, rows.q))

    every, file, remaining = regression.by_stretch.total(), estimated(delay), _errors(robot, size)
    driving = torch.cat([kept, delay])
    nothing, drives, delta = (regression.estimate(every, kept, n) for kept in (delay, driving, everything))
    driven = estimated(driving)
    before, known = accelerations(robot, nothing), min((file, driven), key=lambda error: float(error.mean()))
    if _is_better(estimated(everything), known):
        consistent, delta, change = _consistent(robot, prior, regression, size, delay)
        better = _is_better(compared(lambda _: delta), known)
        if better and is_harmless(accelerations(consistent, delta), before):
            per_gain = tuple(map(tuple, change.tolist()))
            remaining = dataclasses.replace(remaining, per_gain=per_gain, delay=LATE * float(delta[-1]))
            return Inertia(consistent, remaining, (IDENTIFIED,))
    while len(kept):
        with_drives = robot.replace(armature=robot.armature + size * drives[:n])
        harm = log_ratio(accelerations(with_drives, drives), before).mean(0)
        if float(harm.max()) <= TOLERATED:
            return Inertia(with_drives, remaining)
        kept = kept[kept != kept[harm[kept].argmax()]]
        drives = regression.estimate(every, torch.cat([kept, delay]), n)
    return Inertia(robot, remaining)


FURTHER_ESTIMATES = 2
"""Number of further estimates of the scales for identified links, each with those of the previous one."""


def rescaled_robot(robot: RobotModel, rows: Rows, std: float) -> Inertia:
    """Return the robot with the inertia and the scales 1 + s of torques that a log determines.

    Nominal torques are wrong by an unknown factor for each drive. Only ratios of torques to inertia and
    friction are determined, so that the links of the file fix the scales, and the links may then change.

    Args:
        robot: robot from the robot file.
        rows: samples in free motion with nominal torques.
        std: stated standard deviation of s.
    """
    scale, spread, beyond = torque_scale(robot, rows, std)
    inertia = rigid_robot(robot, rows.scaled(scale))
    for _ in range(FURTHER_ESTIMATES if IDENTIFIED in inertia.doubts else 0):
        # Y π for the changed links
        before, after = (inertial_parameters(x.mass, x.com, x.inertia) for x in (robot, inertia.robot))
        change = (links_at(robot, rows) @ (after - before).flatten()[:, None])[..., 0]
        known = dataclasses.replace(rows, residual=rows.residual - change)
        scale, spread, later = torque_scale(robot, known, std)
        beyond = torch.where(beyond > 0.0, beyond, later)
        inertia = rigid_robot(robot, rows.scaled(scale))
    robot = inertia.robot.replace(torque_scale=scale)
    far = [(joint, x) for joint, x in zip(robot.joint_names, beyond.tolist(), strict=True) if x]
    listed = ", ".join(f"{joint} {x:.2g}" for joint, x in far)
    doubt = f"torques seem to be the nominal ones times {listed}, which is beyond what is stated of them"
    doubts = (f"{doubt}, so they stay nominal: correct the constants, or state larger errors",) if far else ()
    doubts = (*inertia.doubts, *doubts)
    return dataclasses.replace(inertia, robot=robot, spread=tuple(spread.tolist()), doubts=doubts)


def torque_scale(robot: RobotModel, rows: Rows, std: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the scales 1 + s `(nq,)` of torques for known links and unknown drives, σ(s), and the scales
    that are too far from 1 to be believed, or 0.

    With the known torque u of the links, τ = g (u + d q̈) + Φ w is linear in g = 1/(1 + s) and in g d. With
    the equivalent (1 + s) τ = u + d q̈ + Φ w, noise of τ would favour s = −1, where nothing of it is left.
    Where links hardly resist the motion, torques are the nominal ones, and d is relative to them.
    """
    n = robot.nq
    M, size = inertia_at(robot, rows.q), drive_scale(robot, rows.q)
    _, regression = _regressions(rows, size * torch.diag_embed(rows.qdd), M, std)
    drives, gains = torch.arange(n), torch.arange(n, 2 * n)
    spread = regression.read(2 * n, torch.cat([drives, gains]))[1][n:].sqrt()
    known = (spread < UNDETERMINED) & robot.driven
    every, rejected = regression.by_stretch.total(), torch.zeros_like(spread)
    while True:
        u = regression.estimate(every, torch.cat([drives, gains[known]]), n)[n : 2 * n]
        g = 1.0 + std * u
        beyond = (u.abs() > FARTHEST) | (g < LEAST_GAIN)
        if not bool(beyond.any()):
            break
        rejected = torch.where(beyond, 1.0 / g.clamp(min=LEAST_GAIN), rejected)
        known = known & ~beyond
    return 1.0 / g, std * torch.where(known, spread / g**2, 1.0).clamp(max=1.0), rejected


def _regressions(
    rows: Rows, inertial: Tensor, M: Tensor, scale_std: float | None = None
) -> tuple[tuple[_Regression, ...], _Regression]:
    """Return the regressions over all widths, and the one with the narrowest posterior."""
    each = tuple(over_widths(rows, inertial, M, scale_std))
    return each, max(each, key=lambda one: float(torch.logdet(one.normal()[1])))


def _consistent(
    robot: RobotModel, prior: InertialPrior, regression: _Regression, size: Tensor, delay: Tensor
) -> tuple[RobotModel, Tensor, Tensor]:
    """Return the robot with physically consistent links and nonnegative drive inertia, the unknowns, and
    the change of the links' parameters and drives per relative error of each torque sensor's gain.

    The links are updated with the drives marginalised, and the drives are then updated given the links.
    Drives whose inertia would be negative are removed. To first order, these steps minimise
    ½ (u − û)ᵀ P (u − û) + V(u) with the divergence V of the links, so ∂u/∂g = (P + V″)⁻¹ P ∂û/∂g.
    """
    every, n = regression.by_stretch.total(), len(size)
    _, precision, per_gain = regression.normal()
    links = torch.arange(n, len(precision) - 1)
    unknowns = regression.estimate(every, torch.cat([torch.arange(n), links, delay]), n)
    while True:
        drives = (unknowns[:n] > 0.0).nonzero()[:, 0]
        others = torch.cat([drives, delay])
        best = regression.estimate(every, torch.cat([others, links]), n)
        moved, delta = prior.updated(robot, best[links], _marginal(precision, links, others), weight=STATED)
        known = torch.zeros_like(best).index_put((links,), delta)
        unknowns = regression.estimate(every, others, n, known)
        if bool((unknowns[drives] > 0.0).all()):
            break
    curvature = prior.around(robot).curvature(moved, STATED)
    free = torch.cat([others, links[curvature.diagonal() > 0.0]])
    precision[links[:, None], links] += curvature
    change = torch.zeros_like(per_gain)
    change[free] = torch.linalg.solve(precision[free][:, free], per_gain[free])
    change = torch.cat([prior.scale(robot)[:, None] * change[links], size[:, None] * change[:n]])
    return moved.replace(armature=robot.armature + size * unknowns[:n]), unknowns, change


def _errors(robot: RobotModel, size: Tensor) -> InertialPrior:
    """Return the prior on what remains unknown of links and of drives of the given size."""
    return InertialPrior(is_error=True).around(robot).with_drives(size)


def with_delay(rows: Rows, columns: Tensor) -> Tensor:
    """Append a column for the torque delay s, with τ(t + s) ≈ τ(t) + s dτ/dt."""
    return torch.cat([columns, LATE * rows.rate[..., None]], dim=-1)


@dataclass(frozen=True)
class _Regression:
    """A regression with instrumental variables on all samples and on the faster half of each joint's samples,
    with its residual noise `(nq,)` and its likelihood exponent κ."""

    by_stretch: NormalEquations
    faster: NormalEquations
    noise: Tensor
    power: float

    def normal(self, equations: NormalEquations | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the linear term κ h, the precision κ H + 1, and the change of κ h per relative error of each
        gain `(p, nq)`, ignoring directions of negative H.
        """
        H, h, per_gain = (equations or self.by_stretch.total()).quadratic(self.noise)
        values, vectors = torch.linalg.eigh(0.5 * (H + H.mT))
        shown = vectors * (values > 0.0)
        precision = self.power * (vectors * values.clamp(min=0.0)) @ vectors.mT
        eye = torch.eye(len(h), dtype=h.dtype, device=h.device)
        h, per_gain = (self.power * shown @ (vectors.mT @ x) for x in (h, per_gain))
        return h, precision + eye, per_gain

    def clear_delay(self) -> Tensor:
        """Return the index of the delay if it is clear, or no index.

        A delay of the torque is common to all joints, and other errors, such as those of friction, are not.
        Its standard error therefore includes the scatter of the delays that each joint alone would have
        (Birge ratio), given the most probable links and drives.
        """
        H, h, _ = self.by_stretch.total().by_joint(self.noise)
        last = H.shape[-1] - 1
        x = self.estimate(self.by_stretch.total(), torch.arange(last + 1), len(h))
        weight, missed = self.power * H[:, last, last], self.power * (h - H @ x)[:, last]
        total, shown = float(weight.sum()), weight > 0.0
        if total <= 0.0:
            return torch.arange(0)
        each, weight = x[last] + missed[shown] / weight[shown], weight[shown]
        mean = float((weight / weight.sum()) @ each)
        scatter = float(weight @ (each - mean).square()) / max(1, len(each) - 1)
        clear = abs(mean) > CLEAR * math.sqrt(max(1.0, scatter) / total)
        return torch.full((int(clear),), last)

    def carried_drives(self, gain: Tensor, delay: Tensor) -> Tensor:
        """Return the indices of the drives that the evidence carries.

        A drive must be significant with links at the file. With links unknown, a drive u ~ N(û, V) with prior
        N(0, 1) is worth ½ û²/V + ½ log V nats, and this evidence must not be clearly against it.

        Args:
            gain: standard deviation `(nq,)` due to gains of torque sensors, which no log determines.
            delay: index of the delay, if it is an unknown.
        """
        n, last = len(gain), self.by_stretch.unknowns - 1
        (u, V), (v, W) = (self.read(n, torch.cat([torch.arange(stop), delay])) for stop in (n, last))
        clear = u > CLEAR * (V + gain**2).sqrt()
        worth = 0.5 * v.square() / W + 0.5 * W.log()
        return (clear & (v > 0.0) & (worth > -AGAINST)).nonzero()[:, 0]

    def read(self, n: int, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Return the estimates `(n,)` of the first n unknowns to consider, and their variances.

        Variances are at least those of a jackknife over blocks of time, between which friction varies, and
        the squared change of the estimate if only the faster half of each joint's samples is used. A joint
        that creeps, as with the soft friction of a simulator, resists acceleration like a drive.
        """

        def at(equations: NormalEquations) -> tuple[Tensor, Tensor]:
            h, precision, _ = self.normal(equations)
            V = torch.linalg.inv(precision[unknowns][:, unknowns])
            return (V @ h[unknowns])[:n], V.diagonal()[:n]

        blocks = range(len(self.by_stretch.gram))
        u, V = at(self.by_stretch.total())
        others = torch.stack([at(self.by_stretch.without(g))[0] for g in blocks])
        change = (at(self.faster.total())[0] - u).square()
        return u, V.maximum((len(blocks) - 1) * others.var(0, correction=0)).maximum(change)

    def estimate(
        self, equations: NormalEquations, kept: Tensor, n: int, known: Tensor | None = None
    ) -> Tensor:
        """Return the most probable values of the unknowns `kept`, with nonnegative drives (the first n)."""
        h, precision, _ = self.normal(equations)
        known = torch.zeros_like(h) if known is None else known
        h = h - precision @ known
        L = torch.linalg.cholesky(precision[kept][:, kept])
        right = torch.linalg.solve_triangular(L, h[kept, None], upper=False)[:, 0]
        lower = torch.where(kept < n, 0.0, -math.inf)
        bounds = lower.numpy(), math.inf
        solution = scipy.optimize.lsq_linear(L.mT.cpu().numpy(), right.cpu().numpy(), bounds, method="bvls")
        return known.index_put((kept,), torch.from_numpy(solution.x).to(h))


def _marginal(precision: Tensor, kept: Tensor, others: Tensor) -> Tensor:
    """Return the precision of the kept unknowns, marginalising the others (a Schur complement)."""
    across = precision[kept][:, others]
    return precision[kept][:, kept] - across @ torch.linalg.solve(precision[others][:, others], across.mT)


def over_widths(
    rows: Rows, inertial: Tensor, M: Tensor, scale_std: float | None = None
) -> Iterator[_Regression]:
    """Yield, for each averaging width, a regression on equations averaged over time.

    Args:
        inertial: columns of the inertia.
        M: inertia of the robot file.
        scale_std: standard deviation of the relative scale of each torque, if it is an unknown.
    """
    accelerating, n = (M @ rows.qdd[..., None])[..., 0], M.shape[-1]
    for width in WIDTHS if rows.step else WIDTHS[:1]:
        used, columns = averaged(rows, inertial, accelerating, width) if rows.step else (rows, inertial)
        if width and (int(used.weight.sum(0).min()) < LEAST or int(used.group.max()) < int(rows.group.max())):
            break
        if scale_std is not None:
            file = torch.diag_embed(used.tau - used.residual)
            columns = torch.cat([columns, scale_std * file], dim=-1)
        columns = with_delay(used, columns)
        speed = used.qd.abs()
        fast = dataclasses.replace(used, weight=used.weight * (speed >= speed.median(0).values))
        by_stretch, faster = instrumental(used, columns), instrumental(fast, columns)
        kept = torch.arange(columns.shape[-1])
        every, mean = by_stretch.total(), columns.new_zeros(len(kept))
        regression = _Regression(by_stretch, faster, M.new_ones(n), 1.0)
        for _ in range(PASSES):
            residual = used.residual - columns @ mean - (used.friction * every.friction(mean)).sum(-1)
            residual = used.weight * residual
            noise = (
                (residual.square().sum(0) / used.weight.square().sum(0).clamp(min=1)).sqrt().clamp(min=1e-300)
            )
            regression = _Regression(by_stretch, faster, noise, _power(used, residual / noise))
            mean = regression.estimate(every, kept, n)
        yield regression


def _power(rows: Rows, residual: Tensor) -> float:
    """Return κ = 1/τ̄ for the unexplained residual, as in `residual_times`."""
    times = autocorrelation_time(residual[: rows.leading], rows.segment[: rows.leading])
    return min(1.0, math.exp(-float(times.log().mean())))


def _is_better(after: Tensor, before: Tensor) -> bool:
    """Return whether errors `(groups, nq)`, averaged over the joints, are significantly smaller."""
    return is_less((after - before).mean(-1))


STATED = 0.25 / MASS_SHARE**2
"""Weight γ of this divergence. That of a mass (1 + s) m is 4 γ (s − log (1 + s)) ≈ 2 γ s², so `MASS_SHARE` is
the standard deviation of s. With γ = 0.01 instead, acceleration errors on held-out blocks of six logs of
five real arms are 1.36 times as large in the geometric mean, and torque errors the same within 1 %."""
IDENTIFIED = "identified inertia replaces that of the robot file, since it predicts held-out torques better"
UNDETERMINED = 0.5
"""Standard deviation of a scale, over the stated one, from which on the torque is the nominal one."""
LEAST_GAIN, FARTHEST = 0.1, 3.0
"""Least g, and stated standard deviations beyond which a scale stays nominal, as the torque of the links is
too small to show it. Without this, one of 104 simulated torques from currents becomes ten times as large."""
GAIN = 0.02
"""Relative standard deviation of the gain of a torque sensor, up to 2 % in data sheets of strain gauges."""
CLEAR = 3.0
"""Number of standard deviations above which a drive counts as identified. At 2, half of the iiwa's `motion_b`
yields a drive of 2.9 ± 2 kg m² at joint 2."""
AGAINST = math.log(3.0)
"""Evidence that is positive [nats] (Kass and Raftery, *Bayes Factors*, 1995). The drive of the first joint
cannot be told from links, and has little evidence: −1 to 0 for simulated UR10s and pendulums with drives.
In wipes of a UR5 without drives, it is −5 to −3 where drives seem significant with links at the file."""
GEARED = 0.3
"""Smallest prior standard deviation of a drive, relative to the largest joint inertia. With 0.03, drives of a
simulated xArm7 are up to 23 % too large; with 0.1 and 0.3, they are within 6 %. A simulated UR5 without
drives gets none with any of these, nor with 1."""


@dataclass(frozen=True)
class Inertia:
    """Inertia determined from a log.

    Attributes:
        robot: robot from the robot file, with the identified inertia.
        errors: prior on the remaining errors of links and drives, or `None` if they are not considered. Their
            mean is zero, so that predictions follow the robot, and they widen all error bars.
        doubts: warnings for the user.
        spread: standard deviation of the scale of each torque over blocks of the log, if it is unknown.
    """

    robot: RobotModel
    errors: InertialPrior | None = None
    doubts: tuple[str, ...] = ()
    spread: tuple[float, ...] = ()


@torch.no_grad()
def inertia_of(
    system: ConstrainedSystem,
    laws: Sequence[JointTerm],
    mean: ForceMean,
    training: Training,
    scale_std: float | None = None,
    links: bool = True,
) -> Inertia:
    """Identify the inertia of a real robot from samples in free motion.

    With fewer than `LEAST` such samples, links and drives stay at the robot file. In either case, their
    remaining errors are unknown. If the base is free, their posterior mean is learned with all other forces,
    also from samples in contact: the six equations of the base have no friction and no noise of torques.

    Args:
        system: robot and contacts of the robot file.
        laws: friction of joints, and offsets of recordings.
        mean: prior mean of Q, including the motor torque.
        training: samples in motion.
        scale_std: standard deviation of the relative scale of torques that are not measured.
        links: whether links and drives may differ from the robot file, or only such scales.
    """
    if training.free_motions < LEAST:
        size = drive_scale(system.robot, torch.cat([m.q for m in training.measurements]))
        spread = () if scale_std is None else (scale_std,) * system.robot.nq
        unknown = dataclasses.replace(_errors(system.robot, size), is_error=bool(system.robot.driven.all()))
        return Inertia(system.robot, unknown if links else None, (), spread)
    rows = free_rows(system, laws, mean, training).with_memory()
    rows = with_ripple(system.robot, rows)
    if scale_std is None:
        return rigid_robot(system.robot, rows)
    if not links:
        scale, spread, _ = torque_scale(system.robot, rows, scale_std)
        return Inertia(system.robot.replace(torque_scale=scale), spread=tuple(spread.tolist()))
    return rescaled_robot(system.robot, rows, scale_std)


def with_ripple(robot: RobotModel, rows: Rows) -> Rows:
    """Add the features of ripple to Φ. Without them, ripple of 2 % of the torque moves M by up to 8 %."""
    eye = torch.eye(robot.nq).to(rows.q)
    X = [links_at(robot, rows), rows.qdd[..., None] * eye, rows.friction]
    X = torch.cat(X, dim=-1).transpose(0, 1)
    X = X / X.square().mean(1, keepdim=True).sqrt().clamp(min=1e-300)
    residual = rows.residual - (X @ ridged(X, rows.residual.T)[..., None])[..., 0].T
    n = rows.leading
    turned = robot.drive_motion(rows.q)
    ripple = ripple_of(turned[:n], residual[:n])
    if ripple is None:
        return rows
    waves = torch.stack([*ripple.columns(JointState(turned, rows.qd, rows.qd)).values()], dim=-1)
    return dataclasses.replace(rows, friction=torch.cat([rows.friction, waves], dim=-1))


def inertia_at(robot: RobotModel, q: Tensor) -> Tensor:
    """Return the inertia `(n, nq, nq)` in the coordinates of the drives, C⁻ᵀ M C⁻¹."""
    return robot.drive_torque(robot.drive_torque(mass_matrix(robot, q)).mT)


def links_at(robot: RobotModel, rows: Rows) -> Tensor:
    """Return the torques C⁻ᵀ Y `(n, nq, 10 nq)` of the drives per inertial parameter of the links."""
    qd, qdd = robot.joint_motion(rows.qd), robot.joint_motion(rows.qdd)
    return robot.drive_torque(regressor(robot, rows.q, qd, qdd).mT).mT


def drive_scale(robot: RobotModel, q: Tensor) -> Tensor:
    """Return the prior deviation `(nq,)` of drive inertia, gear ratio² times rotor inertia [kg m², kg].

    It is the mean inertia of the joint in the robot file, and at least `GEARED` of the largest among joints
    of the same type. A geared drive of a wrist exceeds its links by far (12 to 2500 times on a UR10e).
    """
    M = robot.driven * inertia_at(robot, q).diagonal(dim1=-2, dim2=-1).mean(0)
    scale = M.clone()
    for alike in (robot.driven & (robot.revolute > 0.0), robot.driven & (robot.revolute == 0.0)):
        if bool(alike.any()):
            scale[alike] = M[alike].clamp(min=GEARED * float(M[alike].max()))
    return scale


@torch.no_grad()
def with_updated_robot(problem: Problem, values: Mapping[str, Tensor], file: RobotModel) -> Problem:
    """Return the problem with the inertial parameters at their posterior mean (one Gauss–Newton step).

    Args:
        problem: the problem, whose robot is the start of this step.
        values: its hyperparameters.
        file: the robot of the file, on which the prior is centred.
    """
    for p, prior in enumerate(problem.priors):
        moves = not prior.is_error and problem.parameters is None
        if isinstance(prior, InertialPrior) and moves:
            posterior = force_posterior(problem, values)
            features = one_row(posterior, problem)
            mean = posterior.latent.latent_mean(p, features[p])[0]
            precision = latent_precision(posterior, features, p, file)
            # N(δ̂, P⁻¹) for the prior N(0, Λ⁻¹) of δ − δ₀ is N(δ₀ + δ̂ − P⁻¹ Λ δ₀, P⁻¹) for that of δ.
            start = prior.difference(file, problem.system.robot)
            variance = prior.kernel.variance(sub(values, prior.prefix))(features[p])[:, 0].to(mean)
            mean = start + mean - torch.linalg.solve(precision, start / variance)
            robot = _moved(file, prior, mean, precision)
            # The prior keeps the scale of the parameters in the file, not of the updated ones.
            errors = dataclasses.replace(prior.around(file), is_error=True)
            moved = problem.without_priors([prior.name]).with_priors([errors], problem)
            return dataclasses.replace(moved, system=problem.system.with_robot(robot))
    return problem


def _moved(
    robot: RobotModel,
    prior: InertialPrior,
    mean: Tensor,
    precision: Tensor,
) -> RobotModel:
    """Return the robot with physically consistent links and then, given these, nonnegative drive inertia."""
    count = len(mean) - len(prior.drives)
    links, drives = torch.arange(count), torch.arange(count, len(mean))
    moved, delta = prior.updated(
        robot, mean[links], _marginal(precision, links, drives), STATED if prior.drives else None
    )
    if not prior.drives:
        return moved
    # ½ (u − û)ᵀ P (u − û) over the drives u ≥ −d₀, given the links
    size = robot.mass.new_tensor(prior.drives)
    L = torch.linalg.cholesky(precision[drives][:, drives])
    h = precision[drives] @ mean - precision[drives][:, links] @ delta
    right = torch.linalg.solve_triangular(L, h[:, None], upper=False)[:, 0]
    lower = torch.where(size > 0.0, -robot.armature / size.clamp(min=1e-300), -math.inf)
    bounds = lower.cpu().numpy(), math.inf
    u = scipy.optimize.lsq_linear(L.mT.cpu().numpy(), right.cpu().numpy(), bounds, method="bvls").x
    return moved.replace(armature=(robot.armature + size * torch.from_numpy(u).to(size)).clamp(min=0.0))


def one_row(posterior: ForcePosterior, problem: Problem) -> list[dict[str, Tensor]]:
    """Return the kernel inputs of every prior at the first sample, which is sufficient for constants."""
    m = problem.training.measurements[0]
    at = m[torch.zeros(1, dtype=torch.int64, device=m.q.device)].at(problem.system)
    return [posterior.process.features(p, problem.system, at) for p in range(len(problem.priors))]


def latent_precision(
    posterior: ForcePosterior, features: list[dict[str, Tensor]], p: int, robot: RobotModel
) -> Tensor:
    """Return the inverse posterior covariance of the components of prior p, marginalising all others."""
    widths = [prior.outputs(robot) for prior in posterior.priors]
    eye = torch.eye(widths[p], dtype=robot.dtype, device=robot.device)
    operators = [eye[None] if q == p else eye.new_zeros(1, widths[p], w) for q, w in enumerate(widths)]
    block = Block(tuple(features), tuple(operators), eye[:1])
    return torch.linalg.inv(posterior.latent.covariance(block)[0])
