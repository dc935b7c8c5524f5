"""Farthest points against brute force, and the two splits."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from forcegp.data import (
    complement,
    farthest_points,
    select_points,
    split_by_selection,
    split_by_stretches,
    standardized_inputs,
)
from forcegp.errors import DataError, UnknownNameError
from logs import random_log


def brute_force(x: torch.Tensor, count: int, start: int) -> list[int]:
    """The definition, with all distances in a table."""
    distance = (x[:, None] - x[None]).square().sum(-1).sqrt()
    chosen = [start]
    while len(chosen) < count:
        nearest = distance[:, chosen].amin(1).tolist()
        chosen.append(nearest.index(max(nearest)))
    return chosen


@given(st.integers(0, 10_000), st.integers(2, 60), st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_farthest_points_are_those_of_the_definition(seed: int, n: int, d: int) -> None:
    x = torch.randn(n, d, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    count = (n + 1) // 2
    assert farthest_points(x, count, start=0).tolist() == brute_force(x, count, 0)


def test_of_equal_distances_the_lowest_index_wins() -> None:
    # A grid: nearly all distances occur many times, and squares of integers have no rounding.
    side = torch.arange(7, dtype=torch.float64)
    x = torch.cartesian_prod(side, side)
    assert farthest_points(x, 30, start=24).tolist() == brute_force(x, 30, 24)


def test_the_first_point_is_the_one_next_to_the_mean_and_selections_are_nested() -> None:
    x = torch.randn(500, 21, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    chosen = farthest_points(x, 100)
    assert chosen[0] == (x - x.mean(0)).norm(dim=-1).argmin()
    assert torch.equal(farthest_points(x, 30), chosen[:30])
    assert len(set(chosen.tolist())) == 100


def test_too_many_points_are_refused() -> None:
    x = torch.zeros(10, 2, dtype=torch.float64)
    x[3] = 1.0
    with pytest.raises(DataError, match="cannot select 3 distinct points\n  expected: at most 2"):
        farthest_points(x, 3)
    with pytest.raises(DataError, match="1 to 10"):
        farthest_points(x, 11)
    with pytest.raises(DataError, match="no such starting point"):
        farthest_points(x, 1, start=10)


def test_inputs_are_standardized_and_constant_columns_are_zero() -> None:
    log = random_log(200)
    still = log.q.clone()
    still[:, 1] = 0.1  # has no exact binary form, so its mean is off by rounding
    x = standardized_inputs(log.replace(q=still))
    assert x.shape == (200, 9)
    assert bool((x[:, 1] == 0.0).all())
    moving = [0, 2, *range(3, 9)]
    # Rounding of sums of 200 numbers of order one.
    torch.testing.assert_close(x[:, moving].mean(0), torch.zeros(8).double(), atol=1e-13, rtol=0)
    torch.testing.assert_close(x[:, moving].square().mean(0), torch.ones(8).double(), atol=1e-12, rtol=0)


def test_the_papers_split_parts_the_log() -> None:
    log = random_log(100)
    split = split_by_selection(log, 20)
    assert sorted([*split.train.tolist(), *split.test.tolist()]) == list(range(100))
    assert torch.equal(split.test, complement(split.train, 100))
    assert torch.equal(split.train, select_points(log, 20))


@given(st.integers(0, 1000), st.integers(1, 4), st.floats(0.0, 0.05))
@settings(max_examples=30, deadline=None)
def test_stretches_are_held_out_whole_with_their_margin(seed: int, segments: int, margin: float) -> None:
    log = random_log(480, segments=segments)
    split = split_by_stretches(log, 30, stretch=0.1, fraction=0.25, margin=margin, seed=seed)
    held = [row for first, last in split.stretches for row in range(first, last)]
    assert split.test.tolist() == held
    assert len(split.train) == 30
    for row in split.train.tolist():
        same = log.segment[split.test] == log.segment[row]
        away = (log.t[split.test[same]] - log.t[row]).abs()
        assert len(away) == 0 or float(away.min()) > margin
    again = split_by_stretches(log, 30, stretch=0.1, fraction=0.25, margin=margin, seed=seed)
    assert torch.equal(again.train, split.train) and again.stretches == split.stretches


def test_stretches_cover_the_log_and_differ_with_the_seed() -> None:
    log = random_log(480)  # two seconds
    splits = [split_by_stretches(log, 10, stretch=0.1, fraction=0.2, seed=seed) for seed in range(40)]
    assert {len(split.stretches) for split in splits} == {4}
    assert len({split.stretches for split in splits}) > 30
    assert len({row for split in splits for row in split.test.tolist()}) > 460


@pytest.mark.parametrize(
    "options", [{"stretch": 10.0}, {"fraction": 0.0}, {"fraction": 1.0}, {"margin": -1.0}, {"stretch": 0.0}]
)
def test_splits_that_leave_nothing(options: dict[str, float]) -> None:
    with pytest.raises(DataError, match=r"cannot be split|duration of a stretch"):
        split_by_stretches(random_log(480), 10, **options)  # pyright: ignore[reportArgumentType]


def test_a_selection_cannot_be_cut_into_stretches() -> None:
    log = random_log(480)
    with pytest.raises(DataError, match="in time order"):
        split_by_stretches(log[[5, 3, 1]], 1)


def test_even_rows_keep_their_order_and_reach_both_ends() -> None:
    log = random_log(100)
    rows = select_points(log, 12, method="even")
    assert rows.tolist() == np.round(np.linspace(0, 99, 12)).astype(int).tolist()
    assert torch.equal(select_points(log, 100, method="even"), torch.arange(100))
    with pytest.raises(DataError, match="cannot select 101 of 100 points"):
        select_points(log, 101, method="even")


def test_random_choice_depends_on_the_seed_alone() -> None:
    log = random_log(100)
    a, b, c = (select_points(log, 20, method="random", seed=seed) for seed in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c)
    with pytest.raises(UnknownNameError, match="did you mean 'farthest'"):
        select_points(log, 3, method="fartest")
