"""How well a hypothesis explains the torque: least squares on all blocks of a log but one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forcegp.checks.residual import projector
from forcegp.checks.statistics import Array

BLOCKS = 8
"""Contiguous parts of the log, each held out once."""
FLOOR = 0.03
"""Errors below this share of a joint's torque do not matter: robot files are no better."""


@dataclass(frozen=True)
class Problem:
    """Torques to be explained by known columns and by those of a hypothesis.

    Attributes:
        r: `(n, nq)` unexplained torque [N m, N].
        J: `(n, k, nq)` Jacobian of the touching points.
        nuisance: `(n, nq, p)` columns that every hypothesis may use: friction and offset.
        size: `(nq,)` size of the logged torque, which errors are compared with.
        scale: `(nq,)` size of the torque's noise, which weighs the joints.
    """

    r: Array
    J: Array
    nuisance: Array
    size: Array
    scale: Array


@dataclass(frozen=True)
class Fit:
    """A hypothesis fitted to a log.

    Attributes:
        error: `(blocks, nq)` root mean square of the held-out residual, over `scale`.
        theta: `(p,)` parameters of the hypothesis, from all blocks.
        spread: `(p,)` their standard deviation, by the jackknife over blocks.
        known: parameters of the nuisance columns.
        relative: `(nq,)` held-out error of the typical block over the size of the torque.
        score: `(blocks,)` Σ_j log(error_j / size_j), with a floor where errors do not matter.
    """

    error: Array
    theta: Array
    spread: Array
    known: Array
    relative: Array
    score: Array


def blocks_of(n: int) -> Array:
    """Number of the block of each row."""
    return np.minimum(np.arange(n) * BLOCKS // max(n, 1), BLOCKS - 1)


def cross_validate(
    problem: Problem, columns: Array | None = None, prior: Array | None = None, gains: tuple[int, ...] = ()
) -> Fit:
    """Fit the nuisance and the columns of a hypothesis, and test them on held-out blocks.

    Minimises |P(r − N η − Φ θ)/σ|² + |θ/s|², with P the projector that takes contact forces out.

    Args:
        problem: what is to be explained.
        columns: Φ `(n, nq, p)`, or `None` for the nuisance alone.
        prior: s `(p,)`, how large parameters may be.
        gains: joints whose torque the first parameters scale.
    """
    extra = columns if columns is not None else np.zeros((*problem.r.shape, 0))
    p = extra.shape[-1]
    A = np.concatenate([extra, problem.nuisance], axis=-1) / problem.scale[:, None]
    y = problem.r / problem.scale
    if problem.J.any():
        P = projector(problem.J, problem.scale)
        A, y = P @ A, (P @ y[..., None])[..., 0]
    block = blocks_of(len(y))
    unit = np.sqrt((A**2).sum(axis=(0, 1)))
    # A column that does nothing gets no parameter.
    unit = np.where(unit > 1e-12 * unit.max(), unit, np.inf)
    A = A / unit
    weight = np.full(A.shape[-1], 1e-10)
    weight[~np.isfinite(unit)] = 1.0
    if prior is not None:
        weight[:p] += 1.0 / (prior * unit[:p]) ** 2
    parts = [(A[block == k].reshape(-1, A.shape[-1]), y[block == k]) for k in range(BLOCKS)]
    grams = np.stack([a.T @ a for a, _ in parts])
    sides = np.stack([a.T @ b.ravel() for a, b in parts])
    whole = _solve(grams.sum(axis=0), sides.sum(axis=0), weight)
    thetas, errors = [], []
    for k, (a, b) in enumerate(parts):
        theta = _solve(grams.sum(axis=0) - grams[k], sides.sum(axis=0) - sides[k], weight)
        thetas.append(theta)
        errors.append(np.sqrt(((b - (a @ theta).reshape(b.shape)) ** 2).mean(axis=0)))
    # Jackknife: (K − 1)/K Σ (θ_k − mean)².
    spread = np.sqrt(BLOCKS - 1.0) * np.std(np.stack(thetas), axis=0)
    error = np.stack(errors)
    theta = (whole / unit)[:p]
    # An error counts in relation to the torque: a gain of zero explains a noisy torque, and nothing.
    size = problem.size * np.abs(1.0 + gains_of(theta, gains, len(problem.size))) + 1e-12
    relative = error * problem.scale / size
    score = 0.5 * np.log(relative**2 + FLOOR**2).sum(axis=1)
    return Fit(error, theta, (spread / unit)[:p], (whole / unit)[p:], np.median(relative, axis=0), score)


def gains_of(theta: Array, joints: tuple[int, ...], nq: int) -> Array:
    """Gain less one by joint, from the leading parameters of a hypothesis on gains."""
    gains = np.zeros(nq)
    gains[list(joints)] = theta[: len(joints)]
    return gains


def _solve(gram: Array, side: Array, weight: Array) -> Array:
    from scipy.linalg import cho_factor, cho_solve

    return cho_solve(cho_factor(gram + np.diag(weight + 1e-12 * np.trace(gram) / len(gram))), side)


def gain_of(better: Array, worse: Array) -> tuple[float, float]:
    """Mean drop of a score by block, and its standard error."""
    drop = worse - better
    return float(drop.mean()), float(drop.std(ddof=1) / np.sqrt(len(drop)))
