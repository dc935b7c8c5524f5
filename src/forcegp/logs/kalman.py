"""Position, velocity and acceleration of one joint with error bars, by a Kalman smoother.

The model is a constant jerk disturbed by white snap of intensity s, seen in white noise of deviation σ:
x = (q, q̇, q̈, q⃛), dx = F x dt + e₄ √s dw, y = q + ε. In the scaled state z = (q, h q̇, h² q̈, h³ q⃛), h the time
step, transition and noise are constant matrices: z⁺ = A z + w, A_ij = 1/(j−i)!, Cov(w)_ij = ρ σ² W_ij with
ρ = s h⁷/σ² and W_ij = 1/((3−i)! (3−j)! (7−i−j)), i, j from 0. ρ is learned by evidence, σ in closed form
(Rauch, Tung and Striebel 1965; Särkkä, Bayesian Filtering and Smoothing, 2013, ch. 8 and 12).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from forcegp.logs.signals import Array, runs

ORDER = 4
"""Size of the state: position to jerk."""
SHORTEST = 8
"""Rows that a piece needs: twice the size of the state."""
LEARNED_ROWS = 2000
"""Rows from which ρ is learned: the longest pieces, up to so many."""
LOG_RHO = (-30.0, 8.0)
"""Range of log ρ: from a parabola over any window to no smoothing at all."""
DIFFUSE = 1e8
"""Prior variance of the scaled state about the first row, in units of σ²: it says nothing."""
SETTLED = 1e-10
"""Relative change of the covariance from row to row below which it counts as stationary."""

A = np.array([[1.0 / factorial(j - i) if j >= i else 0.0 for j in range(ORDER)] for i in range(ORDER)])
W = np.array(
    [[1.0 / (factorial(3 - i) * factorial(3 - j) * (7 - i - j)) for j in range(ORDER)] for i in range(ORDER)]
)


@dataclass(frozen=True)
class Smoothed:
    """Estimates of one joint, `(n,)` each.

    Attributes:
        position, velocity, acceleration: means.
        velocity_std, acceleration_std: posterior standard deviations.
        also: another column through the same filter, as if it were a position.
        noise_std: σ, of the measured position.
    """

    position: Array
    velocity: Array
    acceleration: Array
    velocity_std: Array
    acceleration_std: Array
    also: Array | None
    noise_std: float


@dataclass(frozen=True)
class Gains:
    """What does not depend on the data: filter gains and covariances of n rows, in units of σ².

    Attributes:
        gain: `(n, 4)` Kalman gain of each row.
        innovation: `(n,)` variance of each innovation.
        back: `(n, 4, 4)` smoother gain from the next row to each row.
        covariance: `(n, 4, 4)` smoothed covariance of each row.
    """

    gain: Array
    innovation: Array
    back: Array
    covariance: Array


def smooth(t: Array, q: Array, piece: NDArray[np.int64], also: Array | None = None) -> Smoothed:
    """Smooth the positions of one joint, piece by piece, with one ρ and σ for all pieces.

    Args:
        t: `(n,)` time [s], evenly spaced within each piece.
        q: `(n,)` measured positions.
        piece: `(n,)` number of the piece of each row; at least `SHORTEST` rows each.
        also: `(n,)` another quantity, to be passed through the same filter.

    >>> t = np.arange(400) * 0.01
    >>> noise = 1e-3 * np.random.default_rng(0).standard_normal(400)
    >>> result = smooth(t, np.sin(t) + noise, np.zeros(400, dtype=np.int64))
    >>> bool(abs(result.acceleration + np.sin(t))[20:-20].max() < 0.2)
    True
    """
    stretches = runs(piece)
    rho, sigma = learn(q, stretches)
    n = len(q)
    mean, variance = np.empty((n, ORDER)), np.empty((n, ORDER))
    second = None if also is None else np.empty(n)
    tables: dict[int, Gains] = {}
    for rows in stretches:
        count = rows.stop - rows.start
        gains = tables.setdefault(count, _gains(count, rho))
        scale = ((t[rows.stop - 1] - t[rows.start]) / (count - 1)) ** -np.arange(float(ORDER))
        mean[rows] = _run(q[rows], gains) * scale
        variance[rows] = np.diagonal(gains.covariance, axis1=1, axis2=2) * (sigma * scale) ** 2
        if also is not None and second is not None:
            second[rows] = _run(also[rows], gains)[:, 0]
    std = np.sqrt(variance)
    return Smoothed(mean[:, 0], mean[:, 1], mean[:, 2], std[:, 1], std[:, 2], second, sigma)


def learn(q: Array, stretches: list[slice]) -> tuple[float, float]:
    """ρ and σ of greatest evidence on the longest pieces.

    Args:
        q: `(n,)` measured positions.
        stretches: the pieces.

    Returns:
        ρ, and σ in the unit of q.
    """
    chosen, left = [], LEARNED_ROWS
    for rows in sorted(stretches, key=lambda s: s.start - s.stop):
        chosen.append(q[rows][:left])
        left -= len(chosen[-1])
        if left < SHORTEST:
            break
    longest = max(map(len, chosen))

    def cost(log_rho: float) -> tuple[float, float]:
        gains = _forward(longest, float(np.exp(log_rho)))[0:2]
        total, log_det, count = 0.0, 0.0, 0
        for values in chosen:
            e = _innovations(values, gains[0])[ORDER:]
            S = gains[1][ORDER : len(values)]
            total, log_det, count = (
                total + float(np.sum(e**2 / S)),
                log_det + float(np.log(S).sum()),
                count + len(e),
            )
        variance = max(total / count, np.finfo(float).tiny)
        return count * np.log(variance) + log_det, variance

    best = minimize_scalar(lambda x: cost(x)[0], bounds=LOG_RHO, method="bounded", options={"xatol": 0.05})
    return float(np.exp(best.x)), float(np.sqrt(cost(best.x)[1]))


def _forward(n: int, rho: float) -> tuple[Array, Array, Array, Array]:
    """Gains, innovation variances, and predicted and filtered covariances of n rows."""
    gain, innovation = np.empty((n, ORDER)), np.empty(n)
    predicted, filtered = np.empty((n, ORDER, ORDER)), np.empty((n, ORDER, ORDER))
    P = DIFFUSE * np.eye(ORDER)
    for k in range(n):
        predicted[k], S = P, P[0, 0] + 1.0
        K = P[:, 0] / S
        # Joseph's form keeps the covariance symmetric and positive.
        J = np.eye(ORDER)
        J[:, 0] -= K
        F = J @ P @ J.T + np.outer(K, K)
        gain[k], innovation[k], filtered[k] = K, S, F
        P = A @ F @ A.T + rho * W
        if k > ORDER and np.abs(P - predicted[k]).max() <= SETTLED * np.abs(P).max():
            gain[k + 1 :], innovation[k + 1 :], predicted[k + 1 :], filtered[k + 1 :] = K, S, predicted[k], F
            break
    return gain, innovation, predicted, filtered


def _gains(n: int, rho: float) -> Gains:
    gain, innovation, predicted, filtered = _forward(n, rho)
    back, covariance = np.empty((n, ORDER, ORDER)), np.empty((n, ORDER, ORDER))
    covariance[-1], back[-1] = filtered[-1], 0.0
    settled = False
    for k in range(n - 2, -1, -1):
        same = settled and (filtered[k] == filtered[k + 1]).all()
        if same:
            back[k], covariance[k] = back[k + 1], covariance[k + 1]
            continue
        G = cho_solve(cho_factor(predicted[k + 1]), A @ filtered[k]).T
        back[k] = G
        covariance[k] = filtered[k] + G @ (covariance[k + 1] - predicted[k + 1]) @ G.T
        settled = bool(
            np.abs(covariance[k] - covariance[k + 1]).max() <= SETTLED * np.abs(covariance[k]).max()
        )
    return Gains(gain, innovation, back, covariance)


def _innovations(y: Array, gain: Array) -> Array:
    """What each row adds to what the rows before it predict."""
    z, e = np.zeros(ORDER), np.empty(len(y))
    z[0] = y[0]
    for k in range(len(y)):
        e[k] = y[k] - z[0]
        z = A @ (z + gain[k] * e[k])
    return e


def _run(y: Array, gains: Gains) -> Array:
    """Smoothed scaled states `(n, 4)`."""
    n = len(y)
    ahead, now = np.empty((n, ORDER)), np.empty((n, ORDER))
    z = np.zeros(ORDER)
    z[0] = y[0]
    for k in range(n):
        ahead[k] = z
        now[k] = z + gains.gain[k] * (y[k] - z[0])
        z = A @ now[k]
    for k in range(n - 2, -1, -1):
        now[k] += gains.back[k] @ (now[k + 1] - ahead[k + 1])
    return now
