"""What double precision resolves: a prior beside the noise, and a posterior variance beside the prior.

The covariance K of whitened rows has entries that are off by about ε K_ii with ε = 2.2e-16, where the noise
has unit variance. So standard deviations are off by some ε K_ii, and where data leave a fraction r of a prior
variance, by some ε/r: 0.1 % at K_ii = 1e12 and 0.5 % at r = 1e-13 beside a posterior in 80-bit arithmetic.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forcegp.errors import NumericalError

PRIOR_TO_NOISE = 1e6
"""Largest standard deviation of the prior of a row, in units of its noise."""
SMALLEST_FRACTION = 1e-13
"""Smallest fraction of a prior variance that a posterior variance is resolved to."""
NEGATIVE = 0.01
"""An eigenvalue below minus this fraction of the variances is no rounding of zero."""
ROUNDING = 1e-12
"""Variances below this fraction of the largest of a sample are compared with this fraction of it."""


def require_resolved_noise(prior: Tensor) -> None:
    """Refuse a prior so large that the noise is lost in rounding.

    Args:
        prior: variance of the prior of a row, in units of the noise variance `()`.

    Raises:
        NumericalError: it is more than `PRIOR_TO_NOISE` squared.
    """
    ratio = math.sqrt(float(prior))
    if ratio > PRIOR_TO_NOISE:
        raise NumericalError(
            "double precision does not resolve the noise beside the prior",
            expected=f"a prior standard deviation at most {PRIOR_TO_NOISE:g} times that of the noise",
            got=f"{ratio:.3g} times",
            hint=f"leave out outliers, or state a noise at least {ratio / PRIOR_TO_NOISE:.2g} times as large",
        )


def require_resolved_variance(covariance: Tensor, prior: Tensor) -> Tensor:
    """Return a posterior covariance `(n, d, d)` if all of its variances are resolved.

    Args:
        covariance: of the rows of each sample.
        prior: variance of each row before the data `(n, d)`.

    Raises:
        NumericalError: what is left of a prior variance is rounding.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    lost = variance < SMALLEST_FRACTION * prior
    if bool(lost.any()):
        least = float((variance[lost] / prior[lost]).min())
        raise NumericalError(
            f"double precision does not resolve {int(lost.sum())} of {lost.numel()} predicted variances",
            expected=f"at least {SMALLEST_FRACTION:g} of the variance before the data",
            got=f"{least:.2g} of it",
            hint="state a larger noise, or leave out outliers, which make the prior large",
        )
    return covariance


def require_semidefinite(covariance: Tensor) -> None:
    """Refuse covariances with a clearly negative eigenvalue, of variables in units of their own deviation.

    Args:
        covariance: `(*batch, d, d)`.

    Raises:
        NumericalError: a variance or an eigenvalue is below −`NEGATIVE`.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    if not variance.numel():
        return
    largest = variance.amax(-1, keepdim=True)
    scale = variance.clamp(min=ROUNDING * largest.clamp(min=0.0)).sqrt()
    scale = torch.where(scale > 0.0, scale, 1.0)
    shifted = covariance / scale[..., :, None] / scale[..., None, :]
    shifted.diagonal(dim1=-2, dim2=-1).add_(NEGATIVE)
    negative = torch.linalg.cholesky_ex(shifted).info != 0
    if bool(negative.any()):
        worst = float(torch.linalg.eigvalsh(covariance[negative]).min())
        raise NumericalError(
            f"{int(negative.sum())} of {negative.numel()} covariances of a prediction are not positive "
            "semidefinite",
            got=f"an eigenvalue of {worst:.2g}",
            hint="the posterior is rounding: state a larger noise, or leave out outliers",
        )
