"""Split-conformal widening: the factor by which bands must grow to cover as much as they claim."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forcegp.rollout.trajectory import Bands


def widening(values: Tensor, band: Bands, level: float) -> float:
    """Factor on the half-widths of bands so that they cover a share `level` of trajectories like these.

    The score of a trajectory is the factor that puts a share `level` of its values inside the band, from the
    ratios |value − median| / (half-width on that side); the factor is the ⌈(n + 1) level⌉-th smallest of n
    scores. Trajectories are exchangeable, unlike the values along one: with bands widened by it
    (`Bands.widened`), a further trajectory has a share `level` of its values inside with probability `level`
    or more, however wrong the model is.

    Args:
        values: `(n, …)` observed values of n trajectories, NaN where there is none.
        band: the band of each value.
        level: wanted coverage, between 0 and 1.

    Returns:
        The factor; infinite if it takes more trajectories (9 for a level of 0.9) or samples of the model.

    Source: Lei, G'Sell, Rinaldo, Tibshirani, Wasserman, *Distribution-free predictive inference for
    regression* (JASA 113, 2018), section 2.2.

    Example:
        >>> bands = Bands(torch.tensor([-1.0]), torch.tensor([1.0]), torch.tensor([0.0]))
        >>> widening(torch.tensor([[0.5], [-3.0], [2.0]]), bands, 0.5)
        2.0
    """
    apart = values - band.median
    half = torch.where(apart < 0.0, band.median - band.lower, band.upper - band.median)
    ratios = (apart.abs() / half).nan_to_num(torch.inf).flatten(1).sort(dim=1).values
    scores = ratios[:, math.ceil(ratios.shape[1] * level) - 1].sort().values
    rank = math.ceil((len(scores) + 1) * level)
    return float(scores[rank - 1]) if rank <= len(scores) else math.inf
