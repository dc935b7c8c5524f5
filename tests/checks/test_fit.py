"""Least squares on held-out blocks, and instruments where columns hold errors."""

from __future__ import annotations

import numpy as np

from forcegp.checks.fit import TorqueProblem, cross_validate
from forcegp.checks.mechanics import ONE_SIGMA, _upper_spread
from forcegp.robust import robust_std


def test_instruments_give_the_gain_of_a_torque_that_is_mostly_unmodelled() -> None:
    """The logged torque is a third of what the motion needs and of friction that no column describes."""
    random, n, factor = np.random.default_rng(0), 4000, 3.0
    needed, friction = random.normal(size=(n, 1)), 2.0 * random.normal(size=(n, 1))
    logged = (needed + friction) / factor
    one = np.ones(1)
    problem = TorqueProblem(needed - logged, np.zeros((n, 0, 1)), np.ones((n, 1, 1)), one, one)
    columns, prior = logged[..., None], np.full(1, 100.0)
    least = cross_validate(problem, columns, prior, (0,))
    told = cross_validate(problem, columns, prior, (0,), needed[..., None])
    # Least squares shrinks the factor by the share of the needed torque in the variance, 1/5.
    assert abs(1.0 + least.theta[0] - factor / 5.0) < 0.1
    assert abs(1.0 + told.theta[0] - factor) < 3.0 * told.spread[0] < 0.6
    assert told.score.mean() < least.score.mean()


def test_instruments_that_are_the_columns_are_least_squares() -> None:
    random, n = np.random.default_rng(1), 200
    columns, nuisance = random.normal(size=(n, 2, 2)), random.normal(size=(n, 2, 1))
    size = np.array([1.0, 2.0])
    problem = TorqueProblem(random.normal(size=(n, 2)), random.normal(size=(n, 1, 2)), nuisance, size, size)
    one = cross_validate(problem, columns, np.ones(2))
    other = cross_validate(problem, columns, np.ones(2), instruments=columns)
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-8)
    np.testing.assert_allclose(one.error, other.error, rtol=1e-8)


def test_the_spread_of_a_level_is_that_of_its_upper_side() -> None:
    normal = np.random.default_rng(2).normal(size=(100_000, 1))
    assert abs(_upper_spread(normal[:, 0]) - 1.0) < 0.02
    level = np.log(normal[:, 0] ** 2)
    upper = np.percentile(level, ONE_SIGMA) - np.median(level)
    assert _upper_spread(level) == upper < 0.9 * float(robust_std(level))
    assert _upper_spread(-level) == float(robust_std(-level))
