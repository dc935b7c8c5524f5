"""Intervals and spikes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from forcegp.checks.log import spikes
from forcegp.robust import robust_std
from forcegp.rows import describe, intervals


@given(st.lists(st.booleans(), max_size=40))
def test_intervals_give_back_the_mask(values: list[bool]) -> None:
    mask, again = np.array(values, bool), np.zeros(len(values), bool)
    for start, stop in intervals(mask):
        assert stop > start
        again[start:stop] = True
    assert (again == mask).all()


def test_runs_that_are_close_are_joined() -> None:
    mask = np.array([1, 0, 1, 0, 0, 0, 1], bool)
    assert intervals(mask, join=1) == ((0, 3), (6, 7))
    assert describe(((0, 3), (6, 7))) == "rows 0 to 2, 6"
    assert describe(((6, 7),)) == "row 6"


def test_spikes_vanish_on_cubics_and_show_one_value() -> None:
    t = np.linspace(-1.0, 1.0, 41)[:, None]
    curve = 1.0 + t - 2.0 * t**2 + 3.0 * t**3
    own, around = spikes(curve)
    # Rounding of numbers of size one.
    assert np.abs(own).max() < 1e-13 and np.abs(around).max() < 1e-13
    curve[20] += 0.5
    own, around = spikes(curve)
    assert np.argmax(np.abs(own)) == 20 and abs(own[20, 0] - 0.5) < 1e-13 and around[20, 0] < 1e-13


def test_both_departures_have_the_spread_of_white_noise() -> None:
    noise = np.random.default_rng(0).normal(size=(200_000, 1))
    own, around = spikes(noise)
    # √70/6 for the middle value; the larger of two contrasts of about this spread, at most √2 of it.
    expected = np.sqrt(70.0) / 6.0
    assert abs(float(robust_std(own)[0]) / expected - 1.0) < 0.02
    assert expected < np.sqrt((around**2).mean()) < np.sqrt(2.0) * expected
