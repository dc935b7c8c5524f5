"""Least-squares fit of a hypothesis to the torque, cross-validated over blocks of a log.

The torque left unexplained by the robot file is r = M q̈ − Q_C − Q_G − Q_D − Q_u. Without faults, r equals
Aᵀλ + Q_z = Jᵀ F in contact and zero elsewhere. Projection onto the null space of J removes any contact force,
normal or tangential, and the hypothesis explains the rest of r.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor

from forcegp import dynamics, kinematics
from forcegp.checks.log import Array, Log
from forcegp.constraints import ConstrainedSystem, Constraint, SurfaceContact

CHUNK = 8192
"""Number of rows for which the dynamics are held in memory at a time."""


def residual(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> tuple[Array, Array]:
    """Return the unexplained torque r (n, nq) [N m, N] and J (n, k, nq), which is zero for open contacts."""
    robot, r, J = system.robot, [], []
    with torch.no_grad():
        for part in np.array_split(rows, max(1, -(-len(rows) // CHUNK))):
            q, qd, qdd, tau = log.tensors(part, "q", "qd", "qdd", "tau")
            needed = dynamics.inverse_dynamics(robot, q, qd, qdd) - dynamics.damping_force(robot, qd)
            r.append((needed - tau).numpy())
            J.append(_contact_jacobian(system, log, part, q, qd))
    return np.concatenate(r), np.concatenate(J)


def labelled_contacts(system: ConstrainedSystem, log: Log) -> list[Constraint]:
    """Return the contacts for which the state is logged."""
    return [c for c in system.contacts if c.name in log.contact]


def takes_friction_out(system: ConstrainedSystem, log: Log) -> bool:
    """Return whether any torque remains after all components of the contact forces are removed."""
    return 3 * len(labelled_contacts(system, log)) < log.nq


def _contact_jacobian(system: ConstrainedSystem, log: Log, rows: np.ndarray, q: Tensor, qd: Tensor) -> Array:
    """Return J for all components of the contact forces, or only for the normals if no torque would remain.

    Additional rows represent unmeasured torques, which may have any value.
    """
    contacts, whole = labelled_contacts(system, log), takes_friction_out(system, log)
    free = np.broadcast_to(np.eye(log.nq)[log.unmeasured], (len(rows), len(log.unmeasured), log.nq))
    if not contacts or not len(rows):
        return free
    parts = []
    for c in contacts:
        if whole and isinstance(c, SurfaceContact):
            J = kinematics.point_jacobian(system.robot, q, c.frame, c.point).numpy()
        else:
            J = ConstrainedSystem(system.robot, [c]).equations(q, qd).A.numpy()
        parts.append(J * log.contact[c.name][rows][:, None, None])
    return np.concatenate([*parts, free], axis=1)


def projector(J: Array, scale: Array) -> Array:
    """Return the projector (n, nq, nq) that removes torques r/scale that contact forces can produce."""
    J = J * (1.0 / scale)
    eye = np.broadcast_to(np.eye(J.shape[-1]), (len(J), *2 * (J.shape[-1],))).copy()
    touching = (J != 0.0).any(axis=(1, 2))
    if touching.any():
        # Jᵀ = U S Vᵀ; directions beyond the rank are ignored.
        U, S, _ = np.linalg.svd(J[touching].transpose(0, 2, 1), full_matrices=False)
        U = U * (1e-9 * S[:, :1] < S)[:, None, :]
        eye[touching] -= U @ U.transpose(0, 2, 1)
    return eye


BLOCKS, REWEIGHTED = 8, 10
"""Number of contiguous blocks of the log, each held out once; number of iterations of the robust fit."""
FLOOR = 0.03
"""Error relative to a joint's torque that is negligible given the accuracy of robot files."""


@dataclass(frozen=True)
class TorqueProblem:
    """Data of a torque fit: unexplained torque r (n, nq) [N m, N], Jacobian J of the contact points (n, k,
    nq), columns common to all hypotheses (n, nq, p), size of the logged torque, and scale of its noise, by
    which the joints are weighted.
    """

    r: Array
    J: Array
    nuisance: Array
    size: Array
    scale: Array

    def at(self, rows: Array) -> TorqueProblem:
        """Return the problem with the torques of each joint only in the rows of a mask (n, nq)."""
        J, nuisance = self.J * rows[:, None, :], self.nuisance * rows[..., None]
        return replace(self, r=self.r * rows, J=J, nuisance=nuisance)

    def without_contact(self, x: Array) -> Array:
        """Return P x/scale for columns x of shape (n, nq, p), without contact forces."""
        x = x / self.scale[:, None]
        return projector(self.J, self.scale) @ x if self.J.any() else x


@dataclass(frozen=True)
class TorqueFit:
    """A hypothesis that was fitted to a log and tested on held-out blocks.

    `error` and `shares`, both (blocks, nq), are RMS held-out residuals relative to `scale` and to `size`.
    `theta` and `nuisance`, both (p,), are parameters. `spread` contains their jackknife standard errors, and
    `nuisance_without` (blocks, p) the nuisance parameters fitted without each block.
    """

    error: Array
    theta: Array
    spread: Array
    nuisance: Array
    nuisance_without: Array
    shares: Array
    score: Array

    @property
    def nuisance_spread(self) -> Array:
        """Jackknife standard errors of the nuisance parameters (p,)."""
        return jackknife(self.nuisance_without)


def blocks_of(n: int) -> list[np.ndarray]:
    """Return the mask of the rows in each block."""
    block = np.minimum(np.arange(n) * BLOCKS // max(n, 1), BLOCKS - 1)
    return [block == k for k in range(BLOCKS)]


def cross_validate(
    problem: TorqueProblem,
    columns: Array | None = None,
    prior: Array | None = None,
    gains: tuple[int, ...] = (),
    instruments: Array | None = None,
) -> TorqueFit:
    """Fit nuisance columns N and the columns Φ of a hypothesis, and test the fit on held-out blocks.

    The fit minimises |P(r − N η − Φ θ)/σ|² + |θ/s|², where P removes contact forces. `columns` contains Φ (n,
    nq, p), which is empty by default. The prior s (p,) bounds the parameters. The first parameters scale the
    torques of the joints `gains`. If instruments Z are given, the fit solves Zᵀ P (r − N η − Φ θ) = 0, which
    allows for errors in the columns (Wooldridge, *Introductory Econometrics*, ch. 15).
    """
    p = columns.shape[-1] if columns is not None else 0
    A, y, unit, weight = _equations(problem, columns, prior)
    Z = None
    if instruments is not None:  # replace the leading columns, normalised in the same way
        Z = problem.without_contact(instruments)
        size = np.sqrt((Z**2).sum(axis=(0, 1)))
        Z = np.concatenate([Z / np.where(size > 0.0, size, np.inf), A[..., Z.shape[-1] :]], axis=-1)
    rest, thetas, whole = _held_out(A, y, weight, Z)
    error = np.stack([np.sqrt((rest[rows] ** 2).mean(axis=0)) for rows in blocks_of(len(y))])
    theta = (whole / unit)[:p]
    # Errors are relative to the scaled torque: a gain of zero would fit a noisy torque but explain nothing.
    factor = np.ones(len(problem.size))
    factor[list(gains)] += theta[: len(gains)]
    shares = error * problem.scale / (problem.size * np.abs(factor) + 1e-12)
    without = thetas / unit
    spread, rest = jackknife(without[:, :p]), (whole / unit)[p:]
    return TorqueFit(error, theta, spread, rest, without[:, p:], shares, score_of(shares))


def jackknife(without: Array) -> Array:
    """Return the standard errors √((K − 1)/K Σ (θ_k − mean)²) of values fitted without each of K blocks."""
    return np.sqrt(BLOCKS - 1.0) * np.std(without, axis=0)


def _equations(
    problem: TorqueProblem, columns: Array | None, prior: Array | None
) -> tuple[Array, Array, Array, Array]:
    """Return normalised columns and right-hand side without contact forces, their units and the weights."""
    extra = columns if columns is not None else np.zeros((*problem.r.shape, 0))
    p = extra.shape[-1]
    every = problem.without_contact(np.concatenate([problem.r[..., None], extra, problem.nuisance], axis=-1))
    y, A = every[..., 0], every[..., 1:]
    unit = np.sqrt((A**2).sum(axis=(0, 1)))
    # A column without effect gets no parameter.
    unit = np.where(unit > 1e-12 * unit.max(), unit, np.inf)
    weight = np.where(np.isfinite(unit), 1e-10, 1.0)
    if prior is not None:
        weight[:p] += 1.0 / (prior * unit[:p]) ** 2
    return A / unit, y, unit, weight


def robust_parameters(problem: TorqueProblem, columns: Array, prior: Array) -> Array:
    """Fit with Huber weights min(1, k/|r|), k twice the median |r| (*Robust Statistics*, 1981, ch. 7)."""
    A, y, unit, weight = _equations(problem, columns, prior)
    w, theta = np.ones(len(y)), np.zeros(A.shape[-1])
    for _ in range(REWEIGHTED):
        flat = (A * w[:, None, None]).reshape(-1, A.shape[-1])
        theta = _solve(A.reshape(flat.shape).T @ flat, flat.T @ y.ravel(), weight)
        size = np.sqrt(((y - A @ theta) ** 2).mean(axis=1))
        w = np.minimum(1.0, 2.0 * np.median(size) / np.maximum(size, 1e-300))
    return theta / unit


def _held_out(A: Array, y: Array, weight: Array, Z: Array | None = None) -> tuple[Array, Array, Array]:
    """Return held-out residuals, parameters fitted without each block, and those fitted to all blocks."""
    blocks, rest, symmetric = blocks_of(len(y)), np.zeros_like(y), Z is None
    Z = A if Z is None else Z
    grams, sides, thetas = [], [], []
    for rows in blocks:
        a, z = (x[rows].reshape(-1, A.shape[-1]) for x in (A, Z))
        grams.append(z.T @ a)
        sides.append(z.T @ y[rows].ravel())
    gram, side = np.sum(grams, axis=0), np.sum(sides, axis=0)
    for k, rows in enumerate(blocks):
        thetas.append(_solve(gram - grams[k], side - sides[k], weight, symmetric))
        rest[rows] = y[rows] - A[rows] @ thetas[-1]
    return rest, np.stack(thetas), _solve(gram, side, weight, symmetric)


def held_out(problem: TorqueProblem, columns: Array, prior: Array) -> Array:
    """Return the held-out residuals (n, nq) relative to the torque. They are linear in `problem.r`."""
    A, y, _, weight = _equations(problem, columns, prior)
    return _held_out(A, y, weight)[0] * problem.scale / problem.size


def _solve(gram: Array, side: Array, weight: Array, symmetric: bool = True) -> Array:
    """Solve the normal equations, or the equations with instruments, whose `gram` is not symmetric."""
    gram = gram + np.diag(weight + 1e-12 * np.trace(gram) / len(gram))
    return cho_solve(cho_factor(gram), side) if symmetric else np.linalg.solve(gram, side)


def score_of(shares: Array) -> Array:
    """Return Σ_j log error_j (blocks,) for errors (blocks, nq), with a floor for negligible errors."""
    return 0.5 * np.log(shares**2 + FLOOR**2).sum(axis=1)


def gain_of(better: Array, worse: Array) -> tuple[float, float]:
    """Return the mean decrease in a score over all blocks, and its standard error."""
    drop = worse - better
    return float(drop.mean()), float(drop.std(ddof=1) / np.sqrt(len(drop)))


def pooled_gain_of(better: Array, worse: Array) -> tuple[float, float]:
    """Return the decrease in Σ_j log error over all blocks, and its jackknife standard error.

    Errors have shape (blocks, nq). Unlike the mean over blocks, this decrease does not depend on the
    excitation in individual blocks (Cochran, *Sampling Techniques*, ch. 6).
    """

    def drop(rows: Array) -> float:
        square = [(shares[rows] ** 2).mean(axis=0) + FLOOR**2 for shares in (worse, better)]
        return float(0.5 * np.log(square[0] / square[1]).sum())

    every = np.arange(len(better))
    without = np.array([drop(every[every != k]) for k in every])
    return drop(every), float(np.sqrt(len(every) - 1.0) * without.std())
