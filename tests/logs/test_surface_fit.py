"""Planes and spheres fitted to the path of the tip: exact without noise, with honest error bars with it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import forcegp
from forcegp.constraints import Plane, Sphere
from forcegp.errors import DataError
from forcegp.logs import surface_fit
from forcegp.logs.surface_fit import Tip, robust_least_squares, tip_of

UP = np.array([0.0, 0.0, 1.0])


def sharp(points: np.ndarray) -> Tip:
    return Tip(np.zeros_like(points), 0.0)


def on_plane(n: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, float]:
    """Points of a circle of 10 cm on a tilted plane; its normal and offset."""
    random = np.random.default_rng(seed)
    normal = np.array([0.05, -0.03, 1.0]) / np.linalg.norm([0.05, -0.03, 1.0])
    angle = np.linspace(0.0, 12.0, n)
    xy = np.column_stack([0.5 + 0.1 * np.cos(angle), 0.1 * np.sin(angle)])
    z = (0.2 - xy @ normal[:2]) / normal[2]
    return np.column_stack([xy, z]) + noise * random.standard_normal((n, 3)), normal, 0.2


def test_a_plane_without_noise_is_found_exactly() -> None:
    points, normal, offset = on_plane(500, 0.0)
    fit = surface_fit._plane("table", points, UP, sharp(points))
    assert isinstance(fit.surface, Plane)
    # Rounding, and the tolerance of the least squares, 1e-8 relative.
    np.testing.assert_allclose(fit.surface.normal, normal, atol=1e-8)
    assert fit.surface.offset == pytest.approx(offset, abs=1e-8)


def test_the_error_bars_of_a_plane_hold() -> None:
    errors = []
    for seed in range(40):
        points, normal, _ = on_plane(400, 2e-4, seed)
        points[::37] += 0.02  # rows that were labelled wrongly
        fit = surface_fit._plane("table", points, UP, sharp(points))
        plane = fit.surface
        assert isinstance(plane, Plane)
        tilt = np.linalg.norm(np.cross(plane.normal, normal))
        offset = np.array(plane.normal) @ points.mean(0) - plane.offset
        middle = points.mean(0) @ normal - 0.2
        errors.append((tilt / fit.std["tilt"], (offset - middle) / fit.std["offset"]))
    tilts, offsets = np.abs(np.array(errors)).T
    # Mean |x| of a normal is 0.8, over 40 draws ± 0.1; the tilt has two components.
    assert tilts.max() < 4.5 and offsets.max() < 4.0 and 0.5 < offsets.mean() < 1.2


def test_a_sphere_and_its_error_bars() -> None:
    random = np.random.default_rng(0)
    angle, height = np.linspace(0.0, 30.0, 800), np.linspace(0.0, 0.9, 800)
    directions = np.column_stack(
        [np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)]
    )
    center = np.array([0.6, 0.1, -0.2])
    points = center + 0.3 * directions + 1e-4 * random.standard_normal((800, 3))
    fit = surface_fit._sphere("ball", points, UP, sharp(points))
    assert isinstance(fit.surface, Sphere)
    assert np.abs(np.array(fit.surface.center) - center).max() < 4.0 * fit.std["center"] < 2e-4
    assert abs(fit.surface.radius - 0.3) < 4.0 * fit.std["radius"] < 2e-4


def test_paths_that_determine_no_surface() -> None:
    line = np.linspace(0.0, 1.0, 200)[:, None] * np.array([1.0, 2.0, 0.5])
    noisy = line + 1e-4 * np.random.default_rng(0).standard_normal((200, 3))
    with pytest.raises(DataError, match="nearly straight"):
        surface_fit._plane("table", noisy, UP, sharp(noisy))
    flat, _, _ = on_plane(300, 0.0)
    with pytest.raises(DataError, match="determine a sphere"):
        surface_fit._sphere("ball", flat, UP, sharp(flat))


def test_correlated_residuals_count_as_fewer() -> None:
    random = np.random.default_rng(0)
    x = np.zeros(20_000)
    for k in range(1, len(x)):
        x[k] = 0.9 * x[k - 1] + random.standard_normal()
    solution = robust_least_squares(lambda mean: x - mean[0], np.zeros(1))
    # (1 + φ)/(1 − φ) = 19 of a first-order process.
    assert len(solution.residuals) / solution.effective == pytest.approx(19.0, rel=0.2)


def test_from_a_log_to_a_line_of_the_scene() -> None:
    system = forcegp.load_scene("kuka_plane").system()
    robot = system.robot
    q = torch.tensor([0.1, 0.7, 0.0, -1.4, 0.0, 0.9, 0.0], dtype=torch.float64).repeat(200, 1)
    turn = torch.linspace(0, 9, 200, dtype=torch.float64)
    q[:, 0] += 0.2 * torch.sin(turn)
    q[:, 1] += 0.1 * torch.cos(turn)
    point = ("lbr_iiwa_link_7", (0.0, 0.0, 0.1))
    for _ in range(20):  # Newton's method onto the plane z = 0.3
        error = forcegp.kinematics.point_position(robot, q, *point)[:, 2:] - 0.3
        up = forcegp.kinematics.point_jacobian(robot, q, *point)[:, 2]
        q = q - up * error / (up**2).sum(1, keepdim=True)
    zero = torch.zeros_like(q)
    data = forcegp.Dataset(
        t=turn, q=q, qd=zero, tau=zero, qdd=zero, joint_names=robot.joint_names,
        contact={"table": torch.ones(200, dtype=torch.bool)},
    )  # fmt: skip
    fit = surface_fit.fit_surface(data, system, "table")
    assert fit.toml().startswith('surface = { type = "plane", normal = [') and "± " in fit.toml()
    assert isinstance(fit.surface, Plane) and len(fit.solution.residuals) + fit.solution.outliers == 200
    np.testing.assert_allclose(fit.surface.normal, (0.0, 0.0, 1.0), atol=1e-8)
    assert fit.surface.offset == pytest.approx(0.3, abs=1e-8)
    with pytest.raises(DataError, match="closed in too few rows"):
        surface_fit.fit_surface(data[:10], system, "table")


def rounded(n: int, lean: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """End points and axes of a ball-ended tool that slides on a tilted plane and leans up to an angle."""
    random = np.random.default_rng(1)
    touching, normal, _ = on_plane(n, 0.0)
    turns = np.linspace(0.0, 40.0, n)
    leaning = lean * np.column_stack([np.sin(turns), np.cos(1.7 * turns), np.zeros(n)])
    axes = -normal + leaning
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    centers = touching + RADIUS * normal
    return centers + RADIUS * axes + noise * random.standard_normal((n, 3)), axes, normal


RADIUS = 0.02


def test_a_rounded_tip_of_known_radius_touches_below_its_centre() -> None:
    points, axes, normal = rounded(500, 0.4)
    fit = surface_fit._plane("table", points, UP, Tip(axes, RADIUS))
    assert isinstance(fit.surface, Plane) and fit.tip_radius == RADIUS
    np.testing.assert_allclose(fit.surface.normal, normal, atol=1e-8)
    assert fit.surface.offset == pytest.approx(0.2, abs=1e-8)
    centers = points - RADIUS * axes
    of_centers = surface_fit._plane("table", centers, UP, Tip(0.0 * axes, RADIUS))
    assert isinstance(of_centers.surface, Plane)
    assert of_centers.surface.offset == pytest.approx(0.2, abs=1e-8)
    # A tip that is taken for a point seems to slide on another plane.
    of_points = surface_fit._plane("table", points, UP, sharp(points))
    assert isinstance(of_points.surface, Plane) and abs(of_points.surface.offset - 0.2) > 5e-4


def test_the_radius_of_a_tip_that_leans_is_fitted() -> None:
    points, axes, _ = rounded(800, 0.4, noise=1e-4)
    fit = surface_fit._plane("table", points, UP, Tip(axes, None))
    assert abs(fit.tip_radius - RADIUS) < 4.0 * fit.std["tip_radius"] < 1e-3
    assert isinstance(fit.surface, Plane)
    assert abs(fit.surface.offset - 0.2) < 4.0 * fit.std["offset"] + 0.6 * 4.0 * fit.std["tilt"]
    upright, axes, _ = rounded(800, 0.01, noise=1e-4)
    with pytest.raises(DataError, match="does not determine the radius of the tip"):
        surface_fit._plane("table", upright, UP, Tip(axes, None))


def test_a_ball_on_a_sphere() -> None:
    random = np.random.default_rng(0)
    angle, height = np.linspace(0.0, 30.0, 800), np.linspace(0.3, 1.2, 800)
    out = np.column_stack([np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)])
    axes = -out + 0.4 * random.standard_normal((800, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    center = np.array([0.6, 0.1, -0.2])
    points = center + (0.3 + RADIUS) * out + RADIUS * axes
    for tip in (Tip(axes, RADIUS), Tip(axes, None)):
        fit = surface_fit._sphere("ball", points, UP, tip)
        assert isinstance(fit.surface, Sphere)
        np.testing.assert_allclose(fit.surface.center, center, atol=1e-6)
        assert fit.surface.radius == pytest.approx(0.3, abs=1e-6)
        assert fit.tip_radius == pytest.approx(RADIUS, abs=1e-6)


def test_the_tip_is_that_of_the_scene_unless_it_is_a_point() -> None:
    system = forcegp.load_scene("panda_sphere").system()
    (ball,) = system.contacts
    assert isinstance(ball, forcegp.SurfaceContact)
    q = torch.zeros(3, 7, dtype=torch.float64)
    assert tip_of(system, ball, q, None).radius == ball.radius
    with pytest.raises(DataError, match="omit the radius"):
        tip_of(system, ball, q, 0.02)
    table = forcegp.SurfaceContact("table", "panda_link8", (0.0, 0.0, 0.1), Plane())
    tip = tip_of(system, table, q, "fit")
    rotation, _ = forcegp.kinematics.frame_pose(system.robot, q, "panda_link8")
    assert tip.radius is None
    np.testing.assert_allclose(tip.axes, rotation[..., 2])
