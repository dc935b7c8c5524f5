"""Split-conformal widening against its textbook quantile, and its coverage on exchangeable values."""

from __future__ import annotations

import math

import numpy as np
import torch

from forcegp.rollout.comparison import widening
from forcegp.rollout.trajectory import Bands


def _bands(n: int) -> Bands:
    one = torch.ones(n, dtype=torch.float64)
    return Bands(-0.5 * one, 0.25 * one, 0.0 * one)


def test_the_factor_is_the_conformal_quantile() -> None:
    values = torch.from_numpy(np.random.default_rng(0).normal(size=57))
    scores = np.where(values.numpy() < 0.0, -values.numpy() / 0.5, values.numpy() / 0.25)
    expected = np.sort(scores)[math.ceil(58 * 0.9) - 1]
    bands = _bands(57)
    bands = Bands(*(x[:, None] for x in (bands.lower, bands.upper, bands.median)))
    assert widening(values[:, None], bands, 0.9) == expected


def test_widened_bands_cover_trajectories_whose_values_err_together() -> None:
    generator = torch.Generator().manual_seed(0)
    covered = []
    for _ in range(400):
        # The error of a trajectory is one number, with little beside it.
        common = torch.randn(2, 19, 1, dtype=torch.float64, generator=generator)
        past, new = common + 0.01 * torch.randn(2, 19, 40, dtype=torch.float64, generator=generator)
        wide = _bands(40).widened(widening(past, _bands(40), 0.8))
        inside = ((new >= wide.lower) & (new <= wide.upper)).double().mean(-1)
        covered.append((inside >= 0.8).double().mean())
    # The expected share lies between 0.8 and 0.8 + 1/20; the mean of 400 runs is known to 0.006.
    assert 0.8 - 0.015 < float(torch.stack(covered).mean()) < 0.8 + 1 / 20 + 0.015


def test_too_few_trajectories_give_an_infinite_factor() -> None:
    values = torch.zeros(8, 1000, dtype=torch.float64)
    assert widening(values, _bands(1000), 0.9) == math.inf
    assert widening(torch.zeros(9, 1000, dtype=torch.float64), _bands(1000), 0.9) == 0.0


def test_too_few_samples_for_a_band_give_an_infinite_factor() -> None:
    nothing = torch.full((20, 3), math.nan, dtype=torch.float64)
    assert widening(nothing, Bands(nothing, nothing, nothing), 0.9) == math.inf
