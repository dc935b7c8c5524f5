"""Computation of missing velocities and accelerations within trajectories, never across a contact switch.

For each joint, a Kalman smoother returns position, velocity and acceleration with error bars. The model is
constant jerk disturbed by white snap of intensity s, and the position is measured with white noise ε of
deviation σ: x = (q, q̇, q̈, q⃛), dx = F x dt + e₄ √s dw, y = q + ε. For time step h and scaled state z = (q,
h q̇, h² q̈, h³ q⃛), the transition and noise matrices are constant: z⁺ = A z + w, A_ij = 1/(j−i)!, Cov(w)_ij
= ρ σ² W_ij with ρ = s h⁷/σ² and W_ij = 1/((3−i)! (3−j)! (7−i−j)), i, j from 0. ρ maximises the evidence; σ
has a closed form (Rauch et al. 1965; Särkkä, Bayesian Filtering and Smoothing, 2013, ch. 8 and 12).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from forcegp.data.derivative import SavitzkyGolay, differentiate
from forcegp.errors import DataError
from forcegp.logs.mapping import DerivativesSection
from forcegp.logs.table import Array, ImportReport, Signals
from forcegp.rows import runs

STATES, SHORTEST = 4, 8
"""Size of the state, from position to jerk, and minimum number of rows per piece."""
LEARNED_ROWS, LOG_RHO = 2000, (-30.0, 8.0)
"""Number of rows (from the longest pieces) used to learn ρ; range of log ρ, from cubics to no smoothing."""
DIFFUSE, SETTLED = 1e8, 1e-10
"""Uninformative prior variance of the first scaled state [σ²]; relative change of a stationary covariance."""

A = np.array([[1.0 / factorial(j - i) if j >= i else 0.0 for j in range(STATES)] for i in range(STATES)])
TAYLOR = np.array([1.0 / factorial(3 - i) for i in range(STATES)])
W = np.outer(TAYLOR, TAYLOR) / (7.0 - np.add.outer(np.arange(STATES), np.arange(STATES)))


@dataclass(frozen=True)
class Smoothed:
    """Estimates (n,) for a joint, a second column filtered in the same way, and σ of measured positions."""

    position: Array
    velocity: Array
    acceleration: Array
    acceleration_std: Array
    also: Array | None
    noise_std: float


def smooth(t: Array, q: Array, piece: NDArray[np.int64], also: Array | None = None) -> Smoothed:
    """Smooth the positions of a joint piece by piece, with the same ρ and σ for all pieces.

    All arguments have shape `(n,)`: times `t`, evenly spaced within each piece [s]; positions `q`; the piece
    number of each row (at least `SHORTEST` rows per piece); and `also`, a second quantity to filter as well.

    >>> t = np.arange(400) * 0.01
    >>> noise = 1e-3 * np.random.default_rng(0).standard_normal(400)
    >>> result = smooth(t, np.sin(t) + noise, np.zeros(400, dtype=np.int64))
    >>> bool(abs(result.acceleration + np.sin(t))[20:-20].max() < 0.2)
    True
    """
    stretches = runs(piece)
    rho, sigma = learn(q, stretches)
    n = len(q)
    mean, variance = np.empty((n, STATES)), np.empty(n)
    second = None if also is None else np.empty(n)
    gains_of = cache(lambda count: _gains(count, rho))
    for rows in stretches:
        count = rows.stop - rows.start
        gain, back, covariance = gains_of(count)
        scale = ((t[rows.stop - 1] - t[rows.start]) / (count - 1)) ** -np.arange(float(STATES))
        mean[rows] = _run(q[rows], gain, back) * scale
        variance[rows] = covariance[:, 2, 2] * (sigma * scale[2]) ** 2
        if also is not None and second is not None:
            second[rows] = _run(also[rows], gain, back)[:, 0]
    return Smoothed(mean[:, 0], mean[:, 1], mean[:, 2], np.sqrt(variance), second, sigma)


def learn(q: Array, stretches: list[slice]) -> tuple[float, float]:
    """Return ρ and σ (in the unit of q) that maximise the evidence on the longest pieces of q `(n,)`."""
    chosen, remaining = [], LEARNED_ROWS
    for rows in sorted(stretches, key=lambda s: s.start - s.stop):
        chosen.append(q[rows][:remaining])
        remaining -= len(chosen[-1])
        if remaining < SHORTEST:
            break
    longest = max(map(len, chosen))

    def cost(log_rho: float) -> tuple[float, float]:
        gain, innovation, *_ = _forward(longest, float(np.exp(log_rho)))
        e = np.concatenate([_ahead(values, gain)[0][STATES:] for values in chosen])
        S = np.concatenate([innovation[STATES : len(values)] for values in chosen])
        variance = max(float(np.mean(e**2 / S)), np.finfo(float).tiny)
        return len(e) * np.log(variance) + float(np.log(S).sum()), variance

    best = minimize_scalar(lambda x: cost(x)[0], bounds=LOG_RHO, method="bounded", options={"xatol": 0.05})
    return float(np.exp(best.x)), float(np.sqrt(cost(best.x)[1]))


def _forward(n: int, rho: float) -> tuple[Array, Array, Array, Array]:
    """Return gains, innovation variances, and predicted and filtered covariances for n rows."""
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


def _gains(n: int, rho: float) -> tuple[Array, Array, Array]:
    """Return filter gains (n, 4), and smoother gains and covariances divided by σ², each (n, 4, 4)."""
    gain, _, predicted, filtered = _forward(n, rho)
    back, covariance = np.zeros((n, STATES, STATES)), filtered.copy()
    settled = False
    for k in range(n - 2, -1, -1):
        if settled and (filtered[k] == filtered[k + 1]).all():
            back[k], covariance[k] = back[k + 1], covariance[k + 1]
            continue
        G = cho_solve(cho_factor(predicted[k + 1]), A @ filtered[k]).T
        back[k] = G
        covariance[k] = filtered[k] + G @ (covariance[k + 1] - predicted[k + 1]) @ G.T
        change = np.abs(covariance[k] - covariance[k + 1]).max()
        settled = bool(change <= SETTLED * np.abs(covariance[k]).max())
    return gain, back, covariance


def _ahead(y: Array, gain: Array) -> tuple[Array, Array]:
    """Return the innovations `(n,)` and the predicted scaled states `(n, 4)` of all rows."""
    e, ahead = np.empty(len(y)), np.empty((len(y), STATES))
    z = np.array([y[0], *[0.0] * (STATES - 1)])
    for k in range(len(y)):
        e[k], ahead[k] = y[k] - z[0], z
        z = A @ (z + gain[k] * e[k])
    return e, ahead


def _run(y: Array, gain: Array, back: Array) -> Array:
    """Return the smoothed scaled states `(n, 4)`."""
    e, ahead = _ahead(y, gain)
    now = ahead + gain[: len(y)] * e[:, None]
    for k in range(len(y) - 2, -1, -1):
        now[k] += back[k] @ (now[k + 1] - ahead[k + 1])
    return now


def add_derivatives(signals: Signals, settings: DerivativesSection, report: ImportReport) -> Array | None:
    """Compute missing `qd` and `qdd` piece by piece between contact switches, and filter the torque as well.
    If q̈ is logged in some joints only, it is filtered too.

    Return σ of the computed q̈ `(n, nq)`, or `None` if q̈ is logged.
    """
    missing = [name for name in ("qd", "qdd") if signals.lacking(name).any()]
    if not missing:
        return None
    golay = settings.method == "savitzky_golay"
    piece = _pieces(signals, settings.window if golay else SHORTEST, report)
    std = (_filter if golay else _smooth)(signals, piece, settings)
    how = "a Kalman (RTS) smoother with white snap"
    if golay:
        how = f"a Savitzky-Golay filter of window {settings.window} and order {settings.order}"
    report.steps.append(f"computed {' and '.join(missing)} by {how}")
    if "qdd" in missing and settings.filter_torque:
        report.steps.append("passed the torque through the same filter")
    return std if std is None else above_zero(std, report)


LEAST_STD = 1e-3
"""Smallest standard deviation of an acceleration, relative to the root mean square of all in the log. A joint
that rests throughout a log of a real Kinova has none otherwise, which a fit rejects."""


def above_zero(std: Array, report: ImportReport) -> Array:
    """Raise σ of q̈ where a joint at rest shows no noise because its readings do not change by one step."""
    least = LEAST_STD * np.sqrt(np.mean(std**2))
    raised = int((std < least).sum())
    if raised:
        report.steps.append(f"raised the noise of {raised} accelerations at rest to {least:.2g}")
    return np.maximum(std, least)


def _pieces(signals: Signals, least: int, report: ImportReport) -> NDArray[np.int64]:
    """Drop pieces that are too short for the filter, and return the piece number of each remaining row."""
    lengths = np.array([rows.stop - rows.start for rows in signals.runs(*signals.contact.values())], int)
    length = np.repeat(lengths, lengths)
    if not (keep := length >= least).any():
        text = "no stretch of the log is long enough to compute accelerations"
        text = next((finding.message for finding in report.findings if finding.kind == "bursts"), text)
        expected = f"{least} rows without a gap in time{' or a contact switch' * bool(signals.contact)}"
        raise DataError(text, expected=expected, got=f"{len(signals)} rows in {len(lengths)} stretches")
    if not keep.all():
        message = f"{(~keep).sum()} rows in stretches shorter than {least} rows were dropped"
        report.find("short", message, signals.row[~keep])
        signals.keep(keep, split=True)
    return np.repeat(np.arange(len(lengths)), lengths * (lengths >= least))


def _filter(signals: Signals, piece: NDArray[np.int64], settings: DerivativesSection) -> Array | None:
    """Fit polynomials to a moving window (Savitzky and Golay) to compute derivatives; return σ of q̈."""
    from scipy.signal import savgol_filter

    method, vectors = SavitzkyGolay(settings.window, settings.order), signals.vectors
    no_qd, no_qdd = _unlogged(signals)
    if no_qd.any():
        vectors["qd"][:, no_qd], _ = differentiate(signals.t, vectors["q"][:, no_qd], piece, method, 1)
    if not no_qdd.any():
        return None
    std = np.empty_like(vectors["q"])
    of_qd = no_qdd & ~no_qd & (settings.source != "position")
    for of, degree, joints in (("qd", 1, of_qd), ("q", 2, no_qdd & ~of_qd), ("qdd", 0, ~no_qdd)):
        if joints.any():
            x = vectors[of][:, joints]
            vectors["qdd"][:, joints], std[:, joints] = differentiate(signals.t, x, piece, method, degree)
    if settings.filter_torque:
        for rows in runs(piece):
            tau = vectors["tau"][rows]
            vectors["tau"][rows] = savgol_filter(tau, settings.window, settings.order, axis=0, mode="interp")
    return std


def _smooth(signals: Signals, piece: NDArray[np.int64], settings: DerivativesSection) -> Array | None:
    """Apply the Kalman smoother to each joint, and to the torque if requested; return σ of q̈."""
    no_qd, no_qdd = _unlogged(signals)
    vectors, std = signals.vectors, np.empty_like(signals.vectors["q"])
    for joint in range(len(signals.joint_names)):
        tau = vectors["tau"][:, joint] if no_qdd.any() and settings.filter_torque else None
        result = smooth(signals.t, vectors["q"][:, joint], piece, tau)
        std[:, joint] = result.acceleration_std
        if no_qd[joint]:
            vectors["qd"][:, joint] = result.velocity
        if no_qdd[joint]:
            vectors["qdd"][:, joint] = result.acceleration
        elif no_qdd.any():
            logged, sigma = filtered(signals.t, vectors["qdd"][:, [joint]], piece, settings)
            vectors["qdd"][:, joint], std[:, joint] = logged[:, 0], sigma[:, 0]
        if result.also is not None:
            vectors["tau"][:, joint] = result.also
    return std if no_qdd.any() else None


def _unlogged(signals: Signals) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the masks (nq,) of joints without logged q̇ and q̈, and make space for these vectors."""
    masks = signals.lacking("qd"), signals.lacking("qdd")
    for name in ("qd", "qdd"):
        if name not in signals.vectors:
            signals.vectors[name] = np.empty_like(signals.vectors["q"])
    return masks


def filtered(
    t: Array, x: Array, piece: NDArray[np.int64], settings: DerivativesSection
) -> tuple[Array, Array]:
    """Return logged accelerations x (n, d) after the filter for derivatives, and σ of their noise (n, d).

    For the smoother, this is σ before the filter, an upper bound.
    """
    if settings.method == "savitzky_golay":
        return differentiate(t, x, piece, SavitzkyGolay(settings.window, settings.order), 0)
    results = [smooth(t, column, piece) for column in x.T]
    values = np.stack([result.position for result in results], axis=1)
    return values, np.broadcast_to([result.noise_std for result in results], values.shape)


def impact_mask(signals: Signals, margin: float) -> dict[str, Array]:
    """Return a mask for each contact that is 1 within `margin` [s] of a switch, and 0 elsewhere."""
    masks = {}
    for name, closed in signals.contact.items():
        masks[name] = np.zeros(len(signals))
        for rows in signals.runs():
            t, state = signals.t[rows], closed[rows]
            # The switch lies between the last row of one state and the first row of the other.
            for at in t[1:][state[1:] != state[:-1]]:
                masks[name][rows][np.abs(t - at) <= margin] = 1.0
    return masks
