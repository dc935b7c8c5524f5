"""Split-conformal widening: the factor by which bands must grow to cover as much as they claim."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forcegp.rollout.trajectory import Bands


def widening(values: Tensor, band: Bands, level: float) -> float:
    """Factor on the half-widths of bands so that they cover a share `level` of values like these.

    The ⌈(n + 1) level⌉-th smallest of the n ratios |value − median| / (half-width on that side). Bands of
    exchangeable values, widened by it (`Bands.widened`), have that coverage, however wrong the model is.

    Args:
        values: observed values, any shape, NaN where there is none.
        band: the band of each value.
        level: wanted coverage, between 0 and 1.

    Returns:
        The factor; infinite where too few samples are left for a band.

    Source: Lei, G'Sell, Rinaldo, Tibshirani, Wasserman, *Distribution-free predictive inference for
    regression* (JASA 113, 2018), section 2.2.

    Example:
        >>> bands = Bands(torch.tensor([-1.0]), torch.tensor([1.0]), torch.tensor([0.0]))
        >>> widening(torch.tensor([0.5, -3.0, 2.0]), bands, 0.5)
        2.0
    """
    apart = values - band.median
    half = torch.where(apart < 0.0, band.median - band.lower, band.upper - band.median)
    ratio = (apart.abs() / half).nan_to_num(torch.inf).flatten().sort().values
    return float(ratio[min(math.ceil((len(ratio) + 1) * level), len(ratio)) - 1])
