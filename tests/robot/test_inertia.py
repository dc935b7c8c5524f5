"""Pseudo-inertia and log-Cholesky coordinates: round trips, and physical whatever the coordinates."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import forcegp
from forcegp.errors import InertiaError
from forcegp.robot.inertia import (
    from_log_cholesky,
    from_pseudo_inertia,
    inertial_parameters,
    log_cholesky,
    pseudo_inertia,
)
from forcegp.robot.tree import Inertial, inertia_doubt, inertia_error

ROUND_TRIP = 1e-9  # coordinates up to 2 square the condition of J to some 1e6 or so
coordinates = arrays(np.float64, (3, 10), elements=st.floats(-1.5, 1.5))


@given(coordinates)
@settings(max_examples=60, deadline=None)
def test_every_coordinate_is_a_physical_body(theta: np.ndarray) -> None:
    mass, com, inertia = from_pseudo_inertia(from_log_cholesky(torch.from_numpy(theta)))
    for m, c, I in zip(mass, com, inertia, strict=True):
        body = Inertial(m.item(), c.numpy(), I.numpy())
        assert inertia_error(body) == inertia_doubt(body) == ""
        assert m > 0 and torch.linalg.eigvalsh(I)[0] > 0


@given(coordinates)
@settings(max_examples=60, deadline=None)
def test_round_trip(theta: np.ndarray) -> None:
    x = torch.from_numpy(theta)
    J = from_log_cholesky(x)
    torch.testing.assert_close(log_cholesky(J), x, rtol=0, atol=ROUND_TRIP)
    torch.testing.assert_close(pseudo_inertia(*from_pseudo_inertia(J)), J, rtol=ROUND_TRIP, atol=ROUND_TRIP)


def test_pseudo_inertia_of_points_is_the_sum_over_them() -> None:
    """J = Σ m_k [x; 1][x; 1]ᵀ, its definition; and π holds the moments about the origin."""
    random = np.random.default_rng(0)
    m, x = random.uniform(0.1, 2.0, 20), random.normal(size=(20, 3))
    mass, com = m.sum(), (m @ x) / m.sum()
    d = x - com
    inertia = sum(k * (e @ e * np.eye(3) - np.outer(e, e)) for k, e in zip(m, d, strict=True))
    body = [torch.as_tensor(value) for value in (mass, com, inertia)]
    h = np.hstack([x, np.ones((20, 1))])
    np.testing.assert_allclose(pseudo_inertia(*body), h.T @ (m[:, None] * h), rtol=1e-12, atol=1e-12)
    about_origin = sum(k * (e @ e * np.eye(3) - np.outer(e, e)) for k, e in zip(m, x, strict=True))
    expected = [mass, *(mass * com), *about_origin[np.triu_indices(3)]]
    np.testing.assert_allclose(inertial_parameters(*body), expected, rtol=1e-12)


def test_bundled_robots_have_a_log_cholesky_form() -> None:
    for name in ("kuka_iiwa", "franka_panda", "double_pendulum"):
        robot = forcegp.load_robot(name)
        theta = log_cholesky(pseudo_inertia(robot.mass, robot.com, robot.inertia))
        mass, com, inertia = from_pseudo_inertia(from_log_cholesky(theta))
        torch.testing.assert_close(mass, robot.mass, rtol=1e-12, atol=0)
        torch.testing.assert_close(com, robot.com, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(inertia, robot.inertia, rtol=1e-11, atol=1e-13)


def test_unphysical_body_has_none() -> None:
    body = torch.tensor(1.0), torch.zeros(3), torch.diag(torch.tensor([1.0, 1.0, 3.0]))
    with pytest.raises(InertiaError, match=r"triangle inequality strictly\n  got: smallest eigenvalue -0\.5"):
        log_cholesky(pseudo_inertia(*body))


@pytest.mark.parametrize(
    ("mass", "moments", "error", "doubt"),
    [
        (1.0, (1, 1, 1), "", ""),
        (1.0, (0, 0, 0), "", ""),
        (-1.0, (1, 1, 1), "mass -1 kg is negative", ""),
        (np.nan, (1, 1, 1), "not finite", ""),
        (1.0, (1, 1, -1e-5), "a principal moment is -1e-05", ""),
        (1.0, (1, 1, 2.001), "", "violate the triangle inequality (1 + 1 < 2.001"),
        (0.0, (1, 1, 1), "", "rotational inertia of 1 kg m² but no mass"),
    ],
)
def test_reasons(mass: float, moments: tuple[float, ...], error: str, doubt: str) -> None:
    inertia = np.diag(np.array(moments, dtype=float))
    body = Inertial(mass, np.zeros(3), inertia)
    reason = inertia_error(body)
    assert error in reason and bool(error) == bool(reason)
    if not error:
        assert doubt in inertia_doubt(body) and bool(doubt) == bool(inertia_doubt(body))
