"""Derivatives of logs: exact on polynomials, with the noise that they say."""

from __future__ import annotations

import numpy as np
import pytest

from forcegp.data import SavitzkyGolay
from forcegp.data.derivative import differentiate
from forcegp.errors import DataError

DT = 1.0 / 240.0


def test_polynomials_are_differentiated_exactly_up_to_the_ends_of_each_segment() -> None:
    t = np.concatenate([np.arange(40), np.arange(30)]) * DT
    segment = np.repeat([0, 1], [40, 30])
    x = np.stack([1 + 2 * t - 3 * t**3, np.where(segment, t**2, -(t**2))], axis=-1)
    for degree, expected in (
        (1, np.stack([2 - 9 * t**2, np.where(segment, 2 * t, -2 * t)], axis=-1)),
        (2, np.stack([-18 * t, np.where(segment, 2.0, -2.0)], axis=-1)),
    ):
        result, std = differentiate(t, x, segment, SavitzkyGolay(9, 3), degree)
        # Rounding of x, 1e-16, over dt².
        np.testing.assert_allclose(result, expected, atol=1e-9)
        assert std.max() < 1e-9


@pytest.mark.parametrize("degree", [1, 2])
def test_the_noise_is_as_large_as_it_says(degree: int) -> None:
    n, sigma = 20_000, 1e-4
    noise = sigma * np.random.default_rng(0).standard_normal((n, 2))
    t = np.arange(n) * DT
    smooth = np.stack([np.sin(t), np.cos(2 * t)], axis=-1)
    segment = np.zeros(n, dtype=np.int64)
    exact, _ = differentiate(t, smooth, segment, SavitzkyGolay(15, 3), degree)
    noisy, std = differentiate(t, smooth + noise, segment, SavitzkyGolay(15, 3), degree)
    ratio = (noisy - exact)[20:-20].std(0) / std[n // 2]
    # Standard error of both spreads at 20,000 correlated samples is below 2 %.
    np.testing.assert_allclose(ratio, 1.0, atol=0.06)
    assert (std[0] > std[n // 2]).all() and np.allclose(std[0], std[-1])


def test_the_noise_at_the_ends_is_larger_by_the_factor_it_says() -> None:
    runs, n, sigma = 2000, 11, 1e-3
    noise = sigma * np.random.default_rng(1).standard_normal((runs * n, 1))
    segment = np.repeat(np.arange(runs), n)
    result, std = differentiate(np.tile(np.arange(n) * DT, runs), noise, segment, SavitzkyGolay(11, 3), 2)
    spread = result.reshape(runs, n).std(0)
    # 2000 runs give each spread to 1.6 %; the estimate of σ is shared by all positions.
    np.testing.assert_allclose(spread / std[:n, 0], 1.0, atol=0.07)


def test_uneven_time_and_short_segments_are_refused() -> None:
    t = np.arange(50) * DT
    t[30:] += 0.5 * DT
    zero = np.zeros(50, dtype=np.int64)
    with pytest.raises(DataError, match=r"uneven at row 30(?s:.*)0.00625 s(?s:.*)segment"):
        differentiate(t, np.zeros((50, 1)), zero, SavitzkyGolay(), 1)
    with pytest.raises(DataError, match=r"rows 0 to 4 is too short(?s:.*)at least 11"):
        differentiate(t[:5], np.zeros((5, 1)), zero[:5], SavitzkyGolay(), 1)


@pytest.mark.parametrize(("window", "order"), [(10, 3), (5, 5), (5, 1), (-3, 2)])
def test_filters_that_are_not_defined(window: int, order: int) -> None:
    with pytest.raises(DataError, match="not defined"):
        SavitzkyGolay(window, order)
