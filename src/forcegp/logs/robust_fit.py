"""Least squares with outliers left out, and error bars that hold for residuals correlated in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from forcegp.logs.signals import Array
from forcegp.robust import robust_std

LEAST_POINTS = 20
"""Points that a fit needs."""
ROUNDING = 1e-9
"""Smallest scale of the residuals, in their unit, so that an exact fit has one."""
OUTLIER_STD = 4.0
"""Rows with residuals beyond so many deviations are outliers."""


@dataclass(frozen=True)
class Solution:
    """Parameters, their covariance, residuals of the rows used, and how many of these are independent."""

    x: Array
    covariance: Array
    residuals: Array
    effective: float


def robust_least_squares(residual: Callable[[Array], Array], start: Array) -> Solution:
    """A robust fit tells the outliers from the rest; least squares of the rest gives the error bars.

    Args:
        residual: of the parameters, `(n,)`.
        start: parameters `(k,)`.
    """
    robust = start
    for _ in range(2):
        scale = max(float(robust_std(residual(robust))), ROUNDING)
        found = least_squares(residual, robust, loss="soft_l1", f_scale=scale, x_scale="jac")
        robust = found.x
    first = residual(robust)
    inside = np.abs(first - np.median(first)) <= OUTLIER_STD * max(float(robust_std(first)), ROUNDING)
    final = least_squares(lambda x: residual(x)[inside], robust, x_scale="jac")
    residuals = residual(final.x)[inside]
    effective = len(residuals) / correlation_time(residuals)
    information = final.jac.T @ final.jac * (effective / len(residuals))
    scale = max(float(residuals.std()), ROUNDING)
    return Solution(final.x, scale**2 * np.linalg.pinv(information, hermitian=True), residuals, effective)


def correlation_time(values: Array) -> float:
    """1 + 2 Σ ρ_k up to the first negative ρ_k: the rows that count as one independent row (Sokal 1997).

    >>> 0.8 < correlation_time(np.random.default_rng(0).standard_normal(4000)) < 1.2
    True
    """
    x = values - values.mean()
    n = len(x)
    power = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    autocorrelation = np.fft.irfft(power)[:n]
    if not autocorrelation[0] > 0.0:
        return 1.0
    rho = autocorrelation / autocorrelation[0]
    first = int(np.argmax(rho < 0.0)) if (rho < 0.0).any() else n
    return float(min(max(1.0 + 2.0 * rho[1:first].sum(), 1.0), n / LEAST_POINTS if n > LEAST_POINTS else n))
