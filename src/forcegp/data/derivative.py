"""Velocities and accelerations computed from logged positions or velocities, with their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from forcegp.errors import DataError
from forcegp.robust import MAD_TO_STD
from forcegp.rows import runs

WINDOWS = (5, 7, 9, 11, 15, 21, 31, 41, 61, 81, 101, 121, 151, 201)
"""Window lengths that cross-validation tries, in samples."""
UNIFORM_TOLERANCE = 0.02
"""Maximum relative deviation of a time step from the median, which allows for jitter but not for gaps."""


@dataclass(frozen=True)
class SavitzkyGolay:
    """Differentiation of a polynomial fitted by least squares in a moving window.

    A wider window reduces the noise and increases the bias. A higher order has the opposite effect. The noise
    of the results is correlated over about one window, which a likelihood with white noise ignores.

    Args:
        window: number of samples, which must be odd.
        order: degree of the polynomial, at least 2 and less than `window`.

    Raises:
        DataError: a parameter is out of range.
    """

    window: int = 11
    order: int = 3

    def __post_init__(self) -> None:
        if self.window % 2 == 0 or not 2 <= self.order < self.window:
            text = "the Savitzky-Golay filter is not defined"
            got = f"window {self.window}, order {self.order}"
            raise DataError(text, expected="an odd window, and 2 ≤ order < window", got=got)


def cross_validated_window(
    signals: Sequence[NDArray[np.float64]], order: int = 3, most: int | None = None
) -> int:
    """Return the window length that best predicts each sample of the noisiest signal from the others.

    If a sample has weight h in its own fit, its leave-one-out error is (x − x̂)/(1 − h). For each column, the
    window with the smallest mean squared error is determined. The widest of these windows is returned, so
    that all signals have the same bandwidth.

    Args:
        signals: logged values, each `(n, d)`, evenly spaced in time.
        order: degree of the polynomial.
        most: maximum window length. The default is the number of samples.

    Raises:
        DataError: a signal has fewer samples than the narrowest window.

    Example:
        >>> import numpy as np
        >>> t = np.linspace(0.0, 4.0, 1000)[:, None]
        >>> noise = np.random.default_rng(0).normal(size=(1000, 1))
        >>> [cross_validated_window([np.sin(t) + size * noise]) for size in (1e-6, 1e-2)]
        [41, 151]
    """
    from scipy.signal import savgol_coeffs, savgol_filter

    best = []
    if any(len(x) <= WINDOWS[0] for x in signals):
        text = "the signal is too short for a filter"
        raise DataError(text, expected=f"more than {WINDOWS[0]} samples", got=min(map(len, signals)))
    for x in signals:
        windows = [w for w in WINDOWS if order < w < len(x) and w <= max(most or w, WINDOWS[0])]
        weights = [savgol_coeffs(w, order)[w // 2] for w in windows]
        fits = [np.asarray(savgol_filter(x, w, order, axis=0)) for w in windows]
        errors = [np.square((x - fit) / (1.0 - h)).mean(0) for fit, h in zip(fits, weights, strict=True)]
        best += [windows[i] for i in np.argmin(errors, axis=0)]
    return max(best)


def differentiate(
    t: NDArray[np.float64],
    x: NDArray[np.float64],
    segment: NDArray[np.int64],
    method: SavitzkyGolay,
    degree: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the `degree`-th time derivative of x and the standard deviation of its noise, each `(n, d)`.

    The derivative is Σ_k w_k x_{i+k}, so that white noise of standard deviation σ on x causes noise of σ |w|.
    For each column, σ is estimated from the median absolute residual of the fit. The residual has standard
    deviation σ √(1 − h) if a sample has weight h in its own fit. At the ends of each segment, the outermost
    fits are used, which have larger noise. The time t, `(n,)` [s], must be evenly spaced within each segment.
    Windows do not cross segments.

    Raises:
        DataError: a segment is shorter than the window, or its time steps are uneven.
    """
    from scipy.signal import savgol_coeffs, savgol_filter

    window, order = method.window, method.order
    result, gain = np.empty_like(x), np.empty((len(x), 1))
    half, residuals = window // 2, []
    # Norm of the weights at each position in the window, for a unit time step.
    norms = [np.linalg.norm(savgol_coeffs(window, order, deriv=degree, pos=place)) for place in range(window)]
    for rows in runs(segment):
        dt = _time_step(t, rows, window)
        samples = x[rows]
        result[rows] = savgol_filter(samples, window, order, deriv=degree, delta=dt, axis=0, mode="interp")
        places = np.full(len(samples), half)
        places[:half], places[-half:] = np.arange(half), np.arange(half + 1, window)
        gain[rows, 0] = np.take(norms, places) / dt**degree
        smooth = np.asarray(savgol_filter(samples, window, order, axis=0))
        residuals.append((samples - smooth)[half:-half])
    centre_weight = savgol_coeffs(window, order)[half]
    spread = MAD_TO_STD * np.median(np.abs(np.concatenate(residuals)), axis=0)
    return result, gain * (spread / np.sqrt(1.0 - centre_weight))


def _time_step(t: NDArray[np.float64], rows: slice, window: int) -> float:
    steps = np.diff(t[rows])
    if len(steps) + 1 < window:
        text = f"the trajectory in rows {rows.start} to {rows.stop - 1} is too short to differentiate"
        got = f"{len(steps) + 1}"
        raise DataError(text, expected=f"at least {window} samples, the filter's window", got=got)
    dt = float(np.median(steps))
    uneven = np.flatnonzero(~(np.abs(steps - dt) <= UNIFORM_TOLERANCE * dt))
    if len(uneven) or not dt > 0.0:
        row = rows.start + int(uneven[0] if len(uneven) else 0) + 1
        text = f"the time steps are uneven at row {row} and the log cannot be differentiated"
        hint = "resample the log, or number its parts without gaps in a column 'segment'"
        raise DataError(text, expected=f"steps of {dt:.6g} s", got=f"{t[row] - t[row - 1]:.6g} s", hint=hint)
    return dt
