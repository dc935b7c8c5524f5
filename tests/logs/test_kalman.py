"""The smoother: against a dense Gaussian posterior, and its error bars against the truth."""

from __future__ import annotations

from math import factorial

import numpy as np

from forcegp.logs.smoothing import DIFFUSE, learn, smooth


def dense_posterior(q: np.ndarray, dt: float, rho: float) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (in σ²) of all states by one linear solve, in physical units.

    The textbook model, built from the integrals of the matrix exponential rather than from scaled constants.
    """
    n, m = len(q), 4
    A = np.array([[dt ** (j - i) / factorial(j - i) if j >= i else 0.0 for j in range(m)] for i in range(m)])
    snap = rho / dt**7
    nodes, weights = np.polynomial.legendre.leggauss(8)
    s, w = 0.5 * dt * (nodes + 1.0), 0.5 * dt * weights
    columns = np.array([[(dt - x) ** (3 - i) / factorial(3 - i) for i in range(m)] for x in s])
    Q = snap * (columns.T * w) @ columns
    prior = DIFFUSE * np.diag(dt ** (-2.0 * np.arange(m)))
    precision = np.zeros((n * m, n * m))
    precision[:m, :m] += np.linalg.inv(prior)
    mean0 = np.zeros(m)
    mean0[0] = q[0]
    right = np.zeros(n * m)
    right[:m] = np.linalg.solve(prior, mean0)
    inverse = np.linalg.inv(Q)
    for k in range(n - 1):
        D = np.hstack([-A, np.eye(m)])
        precision[k * m : k * m + 8, k * m : k * m + 8] += D.T @ inverse @ D
    for k in range(n):
        precision[k * m, k * m] += 1.0
        right[k * m] += q[k]
    covariance = np.linalg.inv(precision)
    return (covariance @ right).reshape(n, m), np.diag(covariance).reshape(n, m)


def test_the_smoother_is_the_posterior_of_its_model() -> None:
    n, dt = 25, 0.5
    t = np.arange(n) * dt
    q = np.sin(t) + 0.1 * np.random.default_rng(0).standard_normal(n)
    piece = np.zeros(n, dtype=np.int64)
    rho, sigma = learn(q, [slice(0, n)])
    mean, variance = dense_posterior(q, dt, rho)
    result = smooth(t, q, piece)
    # Conditioning of the dense precision, about 1e9, times rounding.
    np.testing.assert_allclose(result.position, mean[:, 0], atol=1e-6)
    np.testing.assert_allclose(result.velocity, mean[:, 1], atol=1e-5)
    np.testing.assert_allclose(result.acceleration, mean[:, 2], atol=1e-5)
    np.testing.assert_allclose(result.acceleration_std, sigma * np.sqrt(variance[:, 2]), rtol=1e-4)


def test_the_error_bars_hold_the_truth() -> None:
    """On draws of smooth motions ±2σ covers about 95 %, and the noise is found."""
    random = np.random.default_rng(1)
    dt, n, noise = 0.005, 1500, 1e-4
    t = np.arange(n) * dt
    errors = []
    for _ in range(4):
        rates, phases = random.uniform(1.0, 6.0, 4), random.uniform(0.0, 6.0, 4)
        x = t[:, None] * rates + phases
        result = smooth(t, np.sin(x).sum(1) + noise * random.standard_normal(n), np.zeros(n, np.int64))
        assert abs(result.noise_std / noise - 1.0) < 0.1  # 1500 residuals give the spread to 2 %
        errors.append((result.acceleration + (rates**2 * np.sin(x)).sum(1)) / result.acceleration_std)
    # A sum of sines is smoother than the model: the bars may be wide, but not narrow.
    inside = np.abs(np.concatenate(errors)) < 2.0
    assert 0.9 < inside.mean() <= 1.0


def test_pieces_do_not_see_each_other() -> None:
    t = np.arange(120) * 0.01
    q = np.sin(5.0 * t) + 1e-3 * np.random.default_rng(2).standard_normal(120)
    piece = (np.arange(120) >= 60).astype(np.int64)
    one = smooth(t, q, piece)
    q[60:] += 5.0
    other = smooth(t, q, piece)
    # ρ is learned from innovations, to which a shift of a whole piece adds nothing.
    np.testing.assert_allclose(one.acceleration, other.acceleration, atol=1e-6)


def test_the_other_column_passes_the_same_filter() -> None:
    t = np.arange(300) * 0.01
    q = np.sin(5.0 * t) + 1e-3 * np.random.default_rng(3).standard_normal(300)
    result = smooth(t, q, np.zeros(300, np.int64), also=q)
    assert result.also is not None
    np.testing.assert_array_equal(result.also, result.position)
