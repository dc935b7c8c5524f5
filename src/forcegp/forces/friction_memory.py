"""Dry friction with memory, learned from the torque residuals of a fit.

If friction is modelled as a function of velocity, it jumps when a joint reverses. Real friction develops over
a distance δ. In Dahl's model, it is proportional to z with dz/dt = q̇/δ − |q̇| z/δ (Dahl 1976, *Solid
friction damping of mechanical vibrations*). Since force priors depend only on the state, their error near
reversals can be as large as the friction itself, which makes other learned forces less certain. For a log in
time order, z can be computed from the velocities. The torque residual is fitted by ridge regression on z for
several values of δ, functions of the velocity, and the gravity torques of the links. A joint is corrected
only if this reduces its residual on held-out blocks of the training log.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import scipy.optimize
import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.forces.calibration import CHUNK_STATES, autocorrelation_time, stretches
from forcegp.forces.inverse_dynamics import bristles
from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.noise import TORQUE_NOISE
from forcegp.forces.posterior import STICK_NOISE, STICKING, stick_variance
from forcegp.forces.priors.base import NOISE
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import SPEEDS
from forcegp.forces.problem import SHOWN, Problem, force_posterior
from forcegp.forces.quantities import affine_map
from forcegp.identification import regressor
from forcegp.robot.model import RobotModel

MEMORY = f"{NOISE}.memory."
WEIGHTS, SHARE, CORRELATION = (MEMORY + name for name in ("weights", "share", "correlation"))
"""Names under which the correction is stored among the hyperparameters."""
RIDGE = 1e-3
"""Ridge penalty for features of unit size, relative to the number of samples."""
LONGEST_STEP = 0.05
"""Longest interval between training samples over which velocities are interpolated [s]."""
LEAST_SHARE = 0.01
"""Lower bound on the fraction of the variance that remains after the correction."""


def _features(robot: RobotModel, log: Measurement | Dataset) -> Tensor:
    """Return features `(n, nq, f)`: z for each distance, memoryless friction, an offset, and gravity."""
    v = log.qd[..., None]
    friction = [bristles(log), *(torch.tanh(v / speed) for speed in SPEEDS), v, torch.ones_like(v)]
    return torch.cat([*friction, _weight(robot, log.q)], dim=-1)


def _weight(robot: RobotModel, q: Tensor) -> Tensor:
    """Return the gravity torque `(n, nq, 4 nq)` [N m, N] due to errors in the mass and first moment of each
    link. Each error is one standard deviation of `InertialPrior`.
    """
    columns, zero = torch.arange(10 * robot.nq).view(-1, 10)[:, :4].flatten(), torch.zeros_like(q)
    Y = regressor(robot, q, zero, zero)[..., columns]
    return Y * InertialPrior().scale(robot)[columns]


@dataclass(frozen=True)
class FrictionMemory:
    """Torque correction for a fit.

    Attributes:
        weights: weights of the features, `(nq, f)` [N m, N].
        share: remaining fractions `(nq, 2)` of the variances of torque noise and static friction.
        correlation: integral `(nq,)` of the autocorrelation of the residual over all lags [s].
    """

    weights: Tensor
    share: Tensor
    correlation: Tensor

    @classmethod
    def of(cls, hyperparameters: Mapping[str, Tensor]) -> FrictionMemory | None:
        """Return the correction learned by a fit, or `None` if the log did not determine it."""
        if WEIGHTS not in hyperparameters:
            return None
        return cls(*(hyperparameters[name] for name in (WEIGHTS, SHARE, CORRELATION)))

    def force(self, robot: RobotModel, log: Measurement | Dataset) -> Tensor:
        """Return the joint force `(n, nq)` of the correction, for a log in time order [N m, N]."""
        return (_features(robot, log) * self.weights).sum(-1)

    def less_noise(self, hyperparameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the hyperparameters with the remaining torque noise and static friction."""
        less = dict(zip((TORQUE_NOISE, STICK_NOISE), 0.5 * self.share.log().mT, strict=True))
        changed = {key: hyperparameters[key] + less[key] for key in less if key in hyperparameters}
        return {**hyperparameters, **changed}


@torch.no_grad()
def memory_of(
    problem: Problem, hyperparameters: Mapping[str, Tensor], training: Training
) -> dict[str, Tensor]:
    """Learn the correction from samples in free motion and return it as hyperparameters.

    The result is empty if the samples are too far apart or not in time order.

    Args:
        training: samples whose residuals the correction explains.
    """
    if not training.period:
        return {}
    i = training.quantities.index("qdd")
    m = training.measurements[i]
    free = (~m.active.any(-1)).nonzero()[:, 0]
    std = dataclasses.replace(problem, training=training).noise_at(hyperparameters, i).expand_as(m.values)
    posterior, parts = force_posterior(problem, hyperparameters), []
    torque = hyperparameters[TORQUE_NOISE].exp().square()
    for rows in free.split(CHUNK_STATES):
        part = m[rows]
        at = part.at(problem.system)
        M, z = at.eom.M, affine_map(problem.system, at, "total_force")
        mean, S = posterior.read(problem.system, at, z)
        stick = stick_variance(hyperparameters, at)
        noise = torch.stack([torque.expand_as(stick), stick], dim=-1)
        # Contribution of the noise of q̈ to the residual: diag(M Σ Mᵀ)
        white = (M.square() @ std[rows].square()[..., None])[..., 0]
        residual = (M @ part.values[..., None])[..., 0] - mean
        parts.append((residual, white, S.diagonal(dim1=-2, dim2=-1), noise))
    columns = (torch.cat(column) for column in zip(*parts, strict=True))
    memory = learn_memory(problem.system.robot, m[free], *columns)
    if memory is None:
        return {}
    return {WEIGHTS: memory.weights, SHARE: memory.share, CORRELATION: memory.correlation}


def learn_memory(
    robot: RobotModel,
    motion: Measurement | Dataset,
    residual: Tensor,
    white: Tensor,
    forces: Tensor,
    noise: Tensor,
) -> FrictionMemory | None:
    """Learn the correction from training samples in free motion.

    Args:
        residual: unexplained joint force M q̈ − E Q̄ `(n, nq)`.
        white: contribution `(n, nq)` of acceleration noise to the variance of the residual.
        forces: contribution `(n, nq)` of the learned forces to this variance.
        noise: contributions `(n, nq, 2)` of torque noise and static friction to this variance.

    Returns:
        The correction, or `None` if the samples are too far apart or not in time order.
    """
    steps = motion.t.diff()[motion.segment[1:] == motion.segment[:-1]]
    if not len(steps) or not 0.0 < float(steps.median()) <= LONGEST_STEP or float(steps.min()) <= 0.0:
        return None
    X, group = _features(robot, motion), stretches(motion.segment)
    grams, rights = [], []
    for g in group.unique():
        x = X[group == g].transpose(0, 1)
        grams.append(x.mT @ x)
        rights.append((x.mT @ residual[group == g].mT[..., None])[..., 0])
    gram, right = torch.stack(grams), torch.stack(rights)
    ridge = RIDGE * len(X) * torch.eye(X.shape[-1]).to(X)
    remaining = residual.clone()
    for i, g in enumerate(group.unique()):
        w = torch.linalg.solve(gram.sum(0) - gram[i] + ridge, right.sum(0) - right[i])
        remaining[group == g] -= (X[group == g] * w).sum(-1)
    better = remaining.square().sum(0) < residual.square().sum(0)
    left = torch.where(better, remaining, residual)
    times = autocorrelation_time(left, motion.segment, white.mean(0))
    moving = (motion.qd.abs() > STICKING).sum(0) / times
    total, share = white + forces + noise.sum(-1), torch.ones_like(noise[0])
    for j in better.nonzero()[:, 0].tolist():
        # r² − white − forces ≈ share · noise, weighted by the variance of r²
        rows = noise[:, j] / total[:, j, None]
        target = (remaining[:, j].square() - white[:, j] - forces[:, j]) / total[:, j]
        found = torch.from_numpy(scipy.optimize.nnls(rows.cpu().numpy(), target.cpu().numpy())[0])
        share[j] = found.to(share).clamp(min=LEAST_SHARE, max=1.0)
        if moving[j] < SHOWN:
            # Friction of a joint at rest does not determine the torque noise in motion.
            share[j, 0] = 1.0
        # A new motion is like another block, so its variance scatters as much as theirs does.
        square = remaining[:, j].square() / (white[:, j] + forces[:, j] + noise[:, j] @ share[j])
        by_stretch = torch.stack([square[group == g].mean() for g in group.unique()])
        share[j] *= (by_stretch.mean() + by_stretch.std()).clamp(min=1.0)
    weights = torch.linalg.solve(gram.sum(0) + ridge, right.sum(0)) * better[:, None]
    return FrictionMemory(weights, share, steps.median() * times)
