"""Velocities and accelerations that a log lacks, by trajectory and never across a contact switch.

The Kalman smoother of a joint gives position, velocity and acceleration with error bars. Its model is a
constant jerk disturbed by white snap of intensity s, seen in white noise of deviation σ: x = (q, q̇, q̈, q⃛),
dx = F x dt + e₄ √s dw, y = q + ε. In the scaled state z = (q, h q̇, h² q̈, h³ q⃛), h the time step, transition
and noise are constant matrices: z⁺ = A z + w, A_ij = 1/(j−i)!, Cov(w)_ij = ρ σ² W_ij with ρ = s h⁷/σ² and
W_ij = 1/((3−i)! (3−j)! (7−i−j)), i, j from 0. ρ is learned by evidence, σ in closed form (Rauch, Tung and
Striebel 1965; Särkkä, Bayesian Filtering and Smoothing, 2013, ch. 8 and 12).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from forcegp.data.derivative import SavitzkyGolay, differentiate
from forcegp.errors import DataError
from forcegp.logs.clock import make_even, unevenness
from forcegp.logs.mapping import DerivativesSection
from forcegp.logs.signals import Array, ImportReport, Signals, runs

STATES = 4
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

A = np.array([[1.0 / factorial(j - i) if j >= i else 0.0 for j in range(STATES)] for i in range(STATES)])
W = np.array(
    [
        [1.0 / (factorial(3 - i) * factorial(3 - j) * (7 - i - j)) for j in range(STATES)]
        for i in range(STATES)
    ]
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
class SmootherGains:
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
    mean, variance = np.empty((n, STATES)), np.empty((n, STATES))
    second = None if also is None else np.empty(n)
    tables: dict[int, SmootherGains] = {}
    for rows in stretches:
        count = rows.stop - rows.start
        gains = tables.setdefault(count, _gains(count, rho))
        scale = ((t[rows.stop - 1] - t[rows.start]) / (count - 1)) ** -np.arange(float(STATES))
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
    chosen, remaining = [], LEARNED_ROWS
    for rows in sorted(stretches, key=lambda s: s.start - s.stop):
        chosen.append(q[rows][:remaining])
        remaining -= len(chosen[-1])
        if remaining < SHORTEST:
            break
    longest = max(map(len, chosen))

    def cost(log_rho: float) -> tuple[float, float]:
        gains = _forward(longest, float(np.exp(log_rho)))[0:2]
        total, log_det, count = 0.0, 0.0, 0
        for values in chosen:
            e = _innovations(values, gains[0])[STATES:]
            S = gains[1][STATES : len(values)]
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
    gain, innovation = np.empty((n, STATES)), np.empty(n)
    predicted, filtered = np.empty((n, STATES, STATES)), np.empty((n, STATES, STATES))
    P = DIFFUSE * np.eye(STATES)
    for k in range(n):
        predicted[k], S = P, P[0, 0] + 1.0
        K = P[:, 0] / S
        # Joseph's form keeps the covariance symmetric and positive.
        J = np.eye(STATES)
        J[:, 0] -= K
        F = J @ P @ J.T + np.outer(K, K)
        gain[k], innovation[k], filtered[k] = K, S, F
        P = A @ F @ A.T + rho * W
        if k > STATES and np.abs(P - predicted[k]).max() <= SETTLED * np.abs(P).max():
            gain[k + 1 :], innovation[k + 1 :], predicted[k + 1 :], filtered[k + 1 :] = K, S, predicted[k], F
            break
    return gain, innovation, predicted, filtered


def _gains(n: int, rho: float) -> SmootherGains:
    gain, innovation, predicted, filtered = _forward(n, rho)
    back, covariance = np.empty((n, STATES, STATES)), np.empty((n, STATES, STATES))
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
    return SmootherGains(gain, innovation, back, covariance)


def _innovations(y: Array, gain: Array) -> Array:
    """What each row adds to what the rows before it predict."""
    z, e = np.zeros(STATES), np.empty(len(y))
    z[0] = y[0]
    for k in range(len(y)):
        e[k] = y[k] - z[0]
        z = A @ (z + gain[k] * e[k])
    return e


def _run(y: Array, gains: SmootherGains) -> Array:
    """Smoothed scaled states `(n, 4)`."""
    n = len(y)
    ahead, now = np.empty((n, STATES)), np.empty((n, STATES))
    z = np.zeros(STATES)
    z[0] = y[0]
    for k in range(n):
        ahead[k] = z
        now[k] = z + gains.gain[k] * (y[k] - z[0])
        z = A @ now[k]
    for k in range(n - 2, -1, -1):
        now[k] += gains.back[k] @ (now[k + 1] - ahead[k + 1])
    return now


UNEVEN = 0.02
"""Largest departure of a time step from the usual one, as a fraction, that passes for even."""


def even_clock(signals: Signals, period: float | None, report: ImportReport) -> None:
    """Make the clock even where it is not, or bring it to a period.

    Args:
        signals: the log.
        period: time step asked for [s].
        report: gets how uneven the clock was.
    """
    worst = unevenness(signals.t, signals.segment)
    if period is None and worst <= UNEVEN:
        return
    if worst > UNEVEN:
        report.find("uneven", f"time steps depart by up to {100.0 * worst:.3g} % from the usual step")
    make_even(signals, period, report)


def add_derivatives(signals: Signals, settings: DerivativesSection, report: ImportReport) -> Array | None:
    """Compute `qd` and `qdd` where the log has none, and pass the torque through the same filter.

    With the Savitzky–Golay filter each quantity is the derivative of the polynomial fitted to a window. The
    smoother's estimates are the means of a state-space model of each joint's position (`kalman.smooth`).

    Args:
        signals: the log, on an even clock; contact switches cut it into pieces.
        settings: method, and what to differentiate.
        report: gets the steps, and pieces that are too short.

    Returns:
        `(n, nq)` standard deviation of the computed q̈, or `None` where q̈ is logged.

    Raises:
        DataError: no piece is long enough.
    """
    logged = [name for name in ("qd", "qdd") if name in signals.vectors]
    if len(logged) == 2:
        return None
    least = settings.window if settings.method == "savitzky_golay" else SHORTEST
    piece = _pieces(signals, least, report)
    std = np.empty_like(signals.vectors["q"])
    for name in ("qd", "qdd"):
        if name not in logged:
            signals.vectors[name] = np.empty_like(std)
    for joint in range(len(signals.joint_names)):
        if settings.method == "savitzky_golay":
            _filter(signals, piece, joint, settings, std, logged)
        else:
            _smooth(signals, piece, joint, settings, std, logged)
    if "qdd" in logged:
        report.did(f"computed qd by {_named(settings)}")
        return None
    report.did(f"computed {'qdd' if logged else 'qd and qdd'} by {_named(settings)}")
    if settings.filter_torque:
        report.did("passed the torque through the same filter")
    return std


def _named(settings: DerivativesSection) -> str:
    if settings.method == "smoother":
        return "a Kalman (RTS) smoother with white snap"
    return f"a Savitzky-Golay filter of window {settings.window} and order {settings.order}"


def _pieces(signals: Signals, least: int, report: ImportReport) -> NDArray[np.int64]:
    """Number of the piece of each row; pieces too short for the filter are dropped."""
    flags = list(signals.contact.values())
    keep = np.ones(len(signals), dtype=bool)
    for rows in signals.runs(*flags):
        keep[rows] = rows.stop - rows.start >= least
    if not keep.any():
        raise DataError(
            "no stretch of the log is long enough to compute accelerations",
            expected=f"{least} rows without a contact switch",
            got=f"{len(signals)} rows, cut by the clock and by contact switches",
        )
    if not keep.all():
        message = f"{(~keep).sum()} rows in stretches shorter than {least} rows were dropped"
        report.find("short", message, signals.row[~keep])
        # What lies on two sides of dropped rows is not one trajectory.
        signals.segment = signals.segment + np.cumsum(np.concatenate([[False], keep[1:] & ~keep[:-1]]))
        signals.keep(keep)
    piece = np.zeros(len(signals), dtype=np.int64)
    for number, rows in enumerate(signals.runs(*signals.contact.values())):
        piece[rows] = number
    return piece


def _filter(
    signals: Signals,
    piece: NDArray[np.int64],
    joint: int,
    settings: DerivativesSection,
    std: Array,
    logged: list[str],
) -> None:
    """One joint by Savitzky–Golay."""
    method = SavitzkyGolay(settings.window, settings.order)
    vectors, one = signals.vectors, slice(joint, joint + 1)
    from_velocity = "qd" in logged and settings.source != "position"
    if "qd" not in logged:
        vectors["qd"][:, one], _ = differentiate(signals.t, vectors["q"][:, one], piece, method, 1)
    if "qdd" not in logged:
        of, degree = ("qd", 1) if from_velocity else ("q", 2)
        vectors["qdd"][:, one], std[:, one] = differentiate(
            signals.t, vectors[of][:, one], piece, method, degree
        )
        if settings.filter_torque:
            filtered(vectors["tau"][:, joint], piece, method)


def filtered(values: Array, piece: NDArray[np.int64], method: SavitzkyGolay) -> None:
    """Replace a column by its Savitzky–Golay fit, piece by piece."""
    from scipy.signal import savgol_filter

    for rows in runs(piece):
        values[rows] = savgol_filter(values[rows], method.window, method.order, mode="interp")


def _smooth(
    signals: Signals,
    piece: NDArray[np.int64],
    joint: int,
    settings: DerivativesSection,
    std: Array,
    logged: list[str],
) -> None:
    """One joint by the Kalman smoother, the torque by the same one."""
    vectors = signals.vectors
    also = vectors["tau"][:, joint] if settings.filter_torque and "qdd" not in logged else None
    result = smooth(signals.t, vectors["q"][:, joint], piece, also)
    if "qd" not in logged:
        vectors["qd"][:, joint] = result.velocity
    if "qdd" not in logged:
        vectors["qdd"][:, joint], std[:, joint] = result.acceleration, result.acceleration_std
        if result.also is not None:
            vectors["tau"][:, joint] = result.also


def impact_mask(signals: Signals, margin: float) -> dict[str, NDArray[np.bool_]]:
    """Rows near a switch of each contact, where accelerations are those of an impact or one-sided fits.

    Args:
        signals: the log.
        margin: time on either side of a switch [s].

    Returns:
        name → `(n,)` bool.
    """
    masks = {}
    for name, closed in signals.contact.items():
        mask = np.zeros(len(signals), dtype=bool)
        for rows in signals.runs():
            t, state = signals.t[rows], closed[rows]
            # The switch lies between the last row of one state and the first row of the other.
            for at in t[1:][state[1:] != state[:-1]]:
                mask[rows] |= np.abs(t - at) <= margin
        masks[name] = mask
    return masks
