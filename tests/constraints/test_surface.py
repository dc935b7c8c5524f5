"""Surfaces against the same surfaces differentiated automatically, and the geometry that they stand for."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.compiled.expression import Graph
from forcegp.constraints import Cylinder, ImplicitSurface, Plane, Sphere, Surface
from forcegp.errors import ForceGPError

ROUNDING = 1e-12
"""Distances, gradients and curvatures of order one to ten."""

NORMAL = torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64)
CENTER = torch.tensor([0.5, 0.1, -1.0], dtype=torch.float64)
AXIS = torch.tensor([0.1, 1.0, 0.3], dtype=torch.float64)


def plane_function(p: Tensor) -> Tensor:
    return p @ NORMAL / NORMAL.norm() - 0.1


def sphere_function(p: Tensor) -> Tensor:
    return ((p - CENTER) ** 2).sum().sqrt() - 0.4


def cylinder_function(p: Tensor) -> Tensor:
    return torch.linalg.cross(p - CENTER, AXIS / AXIS.norm()).norm() - 0.4


PAIRS = [
    (Plane(tuple(NORMAL.tolist()), 0.1), plane_function),
    (Sphere(tuple(CENTER.tolist()), 0.4), sphere_function),
    (Cylinder(tuple(CENTER.tolist()), tuple(AXIS.tolist()), 0.4), cylinder_function),
]
surfaces = pytest.mark.parametrize(("surface", "function"), PAIRS, ids=["plane", "sphere", "cylinder"])


def points(*batch: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    return tuple(torch.randn(*batch, 3, generator=generator, dtype=torch.float64) for _ in range(2))  # type: ignore[return-value]


@surfaces
@pytest.mark.parametrize("batch", [(), (1,), (7,), (2, 3)])
def test_closed_forms_are_the_automatic_derivatives(
    surface: Surface, function, batch: tuple[int, ...]
) -> None:
    automatic, (p, v) = ImplicitSurface(function), points(*batch)
    for ours, theirs in (
        (surface.value(p), automatic.value(p)),
        (surface.gradient(p), automatic.gradient(p)),
        (surface.curvature(p, v), automatic.curvature(p, v)),
    ):
        assert ours.shape == theirs.shape
        assert torch.allclose(ours, theirs, rtol=ROUNDING, atol=ROUNDING)
    assert surface.value(p).shape == batch
    assert surface.gradient(p).shape == (*batch, 3)


@surfaces
def test_scalars_of_a_program_have_the_values_of_tensors(surface: Surface, function) -> None:
    p, v = points()
    graph = Graph()
    c, normal, curvature = surface.scalars(graph.constants(p.numpy()), graph.constants(v.numpy()))
    found = torch.tensor([x.value for x in (c, *normal, curvature)], dtype=torch.float64)
    expected = torch.stack([surface.value(p), *surface.gradient(p), surface.curvature(p, v)])
    assert surface.has_scalars
    assert torch.allclose(found, expected, rtol=ROUNDING, atol=ROUNDING)


def test_a_surface_with_its_own_value_does_not_inherit_scalars() -> None:
    class Raised(Plane):
        def value(self, p: Tensor) -> Tensor:
            return super().value(p) - 0.1

    assert not Raised().has_scalars and not ImplicitSurface(plane_function).has_scalars


@surfaces
def test_gradient_has_unit_length_and_points_out(surface: Surface, function) -> None:
    p, _ = points(50)
    n = surface.gradient(p)
    assert torch.allclose(n.norm(dim=-1), torch.ones(50, dtype=torch.float64), atol=ROUNDING)
    assert bool((surface.value(p + 0.01 * n) > surface.value(p)).all())


@surfaces
def test_value_is_the_signed_distance(surface: Surface, function) -> None:
    p, _ = points(50)
    foot = p - surface.value(p)[:, None] * surface.gradient(p)
    outside = surface.value(p) > 0.0
    assert bool(outside.any())
    assert float(surface.value(foot)[outside].abs().max()) < ROUNDING


@surfaces
def test_curvature_is_the_second_difference_of_the_value(surface: Surface, function) -> None:
    p, v = points(20)
    h = 1e-4
    second = (surface.value(p + h * v) - 2 * surface.value(p) + surface.value(p - h * v)) / h**2
    truncation = 1e-5  # h² times fourth derivatives, and rounding of 1e-16 / h²
    assert torch.allclose(second, surface.curvature(p, v), atol=truncation, rtol=truncation)


def test_a_sphere_bends_by_its_radius_and_a_cylinder_only_across_its_axis() -> None:
    top = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)
    x, y, z = torch.eye(3, dtype=torch.float64)
    sphere, cylinder = Sphere((0, 0, 0), 0.5), Cylinder((0, 0, 0), (0, 3, 0), 0.5)
    assert [float(sphere.curvature(top, v)) for v in (x, y, z)] == pytest.approx([2.0, 2.0, 0.0])
    assert [float(cylinder.curvature(top, v)) for v in (x, y, z)] == pytest.approx([2.0, 0.0, 0.0])


def test_an_implicit_surface_need_not_be_a_distance() -> None:
    """A hill z = ¼ x², whose gradient has no unit length."""
    hill, (p, v) = ImplicitSurface(lambda p: p[2] - 0.25 * p[0] ** 2), points(5)
    assert torch.allclose(hill.value(p), p[:, 2] - 0.25 * p[:, 0] ** 2)
    assert torch.allclose(hill.gradient(p)[:, 0], -0.5 * p[:, 0])
    assert torch.allclose(hill.curvature(p, v), -0.5 * v[:, 0] ** 2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane((0.0, 0.0, 0.0)), r"the plane's normal has no direction\n  expected: three finite"),
        (lambda: Plane((0.0, 1.0)), "the plane's normal has no direction"),
        (lambda: Plane((0.0, 0.0, float("nan"))), "the plane's normal has no direction"),
        (lambda: Plane((0.0, 0.0, 1.0), float("inf")), "the plane's offset is not a valid distance"),
        (lambda: Sphere((0.0, 0.0, 0.0), 0.0), r"the sphere's radius is not a valid length\n.*positive"),
        (lambda: Sphere((0.0, 0.0), 1.0), "the sphere's center is not a point"),
        (lambda: Cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0), "the cylinder's axis has no direction"),
        (
            lambda: Cylinder((0.0, 0.0, float("nan")), (0.0, 0.0, 1.0), 1.0),
            "the cylinder's center is not a point",
        ),
        (
            lambda: Cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), -1.0),
            "the cylinder's radius is not a valid length",
        ),
    ],
)
def test_surfaces_that_are_none_are_refused(make, message: str) -> None:
    with pytest.raises(ForceGPError, match=message):
        make()


def test_the_normal_is_scaled_to_unit_length() -> None:
    plane = forcegp.Plane((0, 0, 4), 0.2)
    assert plane.normal == (0.0, 0.0, 1.0)
    assert float(plane.value(torch.tensor([9.0, 9.0, 0.5], dtype=torch.float64))) == pytest.approx(0.3)


def test_a_subclass_with_its_own_value_does_not_keep_the_geometry_of_its_parent() -> None:
    class Floor(Plane):
        def value(self, p: Tensor) -> Tensor:
            return super().value(p) - 0.1

    floor = Floor((0.0, 0.0, 1.0), 0.0)
    assert Plane((0.0, 0.0, 1.0), 0.0).solid() is not None
    assert floor.solid() is None and not floor.has_scalars
    with pytest.raises(ForceGPError, match="cannot be offset"):
        floor.raised(0.1)
