"""Laws of the reference motion: displacement, bounds, rest at the ends, and the surface below."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from forcegp import Plane
from forcegp.constraints import Cylinder, ImplicitSurface, Sphere
from forcegp.constraints.surface import Surface
from forcegp.control.trajectory import Chart, Reference, draw_waypoints, project, straight_lines, trapezoid
from forcegp.errors import ForceGPError

ROUNDING = 1e-12
"""A handful of additions of numbers near one in float64."""
DT = 1e-3
SECOND_ORDER = 1e-4
"""Central differences with step DT of motions whose third derivative is below 100 m/s³, off the corners."""
SURFACES = {
    "free": None,
    "plane": Plane((0.2, -0.1, 1.0), 0.05),
    "sphere": Sphere((0.5, 0.0, -0.5), 0.6),
    "cylinder": Cylinder((0.5, 0.0, -0.3), (0.1, 1.0, 0.0), 0.4),
    "implicit": ImplicitSurface(lambda p: p[2] - 0.1 * torch.sin(3.0 * p[0]) - 0.05 * p[1] ** 2),
}

lengths = st.floats(0.0, 2.0)
times = st.floats(0.05, 5.0)
accelerations = st.floats(0.1, 50.0)


@settings(deadline=None, max_examples=60)
@given(lengths, times, accelerations)
def test_the_speed_adds_up_to_the_displacement(length: float, T: float, a: float) -> None:
    profile = trapezoid(torch.tensor(length, dtype=torch.float64), T, a)
    corners = torch.stack(
        [
            torch.zeros(()),
            profile.blend_time,
            profile.travel_time - profile.blend_time,
            profile.travel_time,
        ]
    ).double()
    distance, speed, _ = profile.at(corners)
    travelled = torch.cumulative_trapezoid(speed, corners)  # exact: the speed is linear between corners
    # The square root in the blend time loses half the digits where T² is about 4 d/a.
    torch.testing.assert_close(travelled, distance[1:], rtol=1e-7, atol=1e-7)
    assert abs(float(distance[-1]) - length) < ROUNDING
    assert float(speed[0]) == 0.0
    assert abs(float(speed[-1])) < ROUNDING


@settings(deadline=None, max_examples=60)
@given(lengths, times, accelerations)
def test_the_acceleration_keeps_its_bound_and_time_is_lengthened_only_as_needed(
    length: float, T: float, a: float
) -> None:
    profile = trapezoid(torch.tensor(length, dtype=torch.float64), T, a)
    t = torch.linspace(-0.1, 1.1 * float(profile.travel_time), 500, dtype=torch.float64)
    distance, speed, rate = profile.at(t)
    assert float(rate.abs().max()) <= a
    assert bool((distance.diff() >= -ROUNDING).all())
    step = float(t[1] - t[0])
    assert float(speed.diff().abs().max()) <= a * step + 1e-7
    needed = 2.0 * (length / a) ** 0.5
    assert float(profile.travel_time) == pytest.approx(max(T, needed), abs=ROUNDING)


@pytest.mark.parametrize(
    ("T", "a", "name"), [(0.0, 1.0, "travel_time"), (1.0, float("nan"), "max_acceleration")]
)
def test_a_time_or_acceleration_that_is_not_positive_is_refused(T: float, a: float, name: str) -> None:
    with pytest.raises(ForceGPError, match=name):
        trapezoid(torch.tensor(1.0), T, a)


def _reference(surface: Surface | None, seed: int = 0) -> tuple[Chart, Reference]:
    chart = Chart.about(torch.tensor([0.5, 0.0, 0.1], dtype=torch.float64), surface)
    generator = torch.Generator().manual_seed(seed)
    waypoints = draw_waypoints(6, (0.3, 0.4), (0.02, 0.1), 0.4, generator)
    t = torch.arange(5000, dtype=torch.float64) * DT
    return chart, straight_lines(chart, waypoints, t, 1.0, 4.0)


@pytest.mark.parametrize("name", SURFACES)
def test_velocity_and_acceleration_are_the_derivatives_of_the_position(name: str) -> None:
    _, reference = _reference(SURFACES[name])
    smooth = (reference.acceleration[2:] - reference.acceleration[:-2]).abs().amax(-1) < 0.1
    for value, rate in (
        (reference.position, reference.velocity),
        (reference.velocity, reference.acceleration),
    ):
        difference = (value[2:] - value[:-2]) / (2.0 * DT) - rate[1:-1]
        assert float(difference[smooth].abs().max()) < SECOND_ORDER
    assert float(smooth.double().mean()) > 0.9


@pytest.mark.parametrize("name", [name for name in SURFACES if name != "free"])
def test_lines_between_points_of_the_surface_stay_on_it(name: str) -> None:
    surface = SURFACES[name]
    assert surface is not None
    _, reference = _reference(surface)
    height = surface.value(reference.position)
    assert bool(reference.on_surface.any()) and bool((~reference.on_surface).any())
    assert float(height[reference.on_surface].abs().max()) < ROUNDING
    assert float(height[~reference.on_surface].max()) > 0.01
    assert float(height.min()) > -ROUNDING


def test_the_motion_joins_the_waypoints_at_rest() -> None:
    _, reference = _reference(SURFACES["sphere"])
    ends = reference.travel_time.cumsum(0)
    at_ends = torch.searchsorted(reference.t, ends - 0.5 * DT)
    inside = at_ends < len(reference.t)
    position = reference.position[at_ends[inside]]
    torch.testing.assert_close(position, reference.waypoints[1:][inside], atol=1e-5, rtol=0.0)
    assert float(reference.velocity[at_ends[inside]].abs().max()) <= 4.0 * DT


def test_points_are_uniform_in_the_rectangle_and_the_seed_decides() -> None:
    def draw(seed: int) -> torch.Tensor:
        return draw_waypoints(4000, (0.3, 0.6), (0.0, 0.1), 0.25, torch.Generator().manual_seed(seed))

    points = draw(1)
    assert torch.equal(points, draw(1)) and not torch.equal(points, draw(2))
    for column, side in ((0, 0.3), (1, 0.6)):
        share = torch.histc(points[:, column], bins=10, min=-side / 2, max=side / 2) / len(points)
        # A bin of 4000 uniform draws has a standard deviation of 0.0047.
        assert float((share - 0.1).abs().max()) < 5 * 0.0047
    lifted = float((points[:, 2] > 0.0).double().mean())
    assert abs(lifted - 0.25) < 5 * 0.0069


@pytest.mark.parametrize("name", ["plane", "sphere", "cylinder", "implicit"])
def test_projection_ends_on_the_surface(name: str) -> None:
    surface = SURFACES[name]
    assert surface is not None
    p = 0.1 * torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    on = project(surface, p + torch.tensor([0.5, 0.0, 0.1], dtype=torch.float64))
    assert float(surface.value(on).abs().max()) < ROUNDING


def test_too_little_acceleration_lengthens_the_travel_time_and_is_reported() -> None:
    chart = Chart.about(torch.zeros(3, dtype=torch.float64), None)
    waypoints = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.1, 0, 0]], dtype=torch.float64)
    reference = straight_lines(chart, waypoints, torch.arange(10).double(), 1.0, 1.0)
    assert reference.lengthened == 1
    torch.testing.assert_close(reference.travel_time, torch.tensor([2.0, 1.0], dtype=torch.float64))
    assert torch.equal(reference.position[-1], reference.waypoints[-1])
