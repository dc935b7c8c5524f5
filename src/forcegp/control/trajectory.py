"""Reference motions of the end-effector: random points joined by straight lines (section 5.2 of the paper).

Points are drawn in a chart (u, v, h). The coordinates u and v run along the sides of a rectangle that touches
the surface at its centre, and h is the height above the surface. A line in the chart is traversed with a
trapezoidal velocity profile (Siciliano et al., *Robotics*, section 4.2.1) and mapped onto the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints.surface import Plane, Surface
from forcegp.errors import ForceGPError

PROJECTION_STEPS = 8
"""Number of Newton steps onto a surface. One is exact for a signed distance. Others double the digits."""


class Trapezoid(NamedTuple):
    """Trapezoidal velocity profiles, one per segment, at rest at both ends.

    Attributes:
        length: distance travelled, `(*batch,)` [m].
        travel_time: travel time, `(*batch,)` [s].
        blend_time: duration of acceleration and of deceleration, `(*batch,)` [s].
        acceleration: acceleration during the blends, `(*batch,)` [m/s²].
    """

    length: Tensor
    travel_time: Tensor
    blend_time: Tensor
    acceleration: Tensor

    def at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return distance, speed and acceleration at time t after the start. The motion ends at rest."""
        t = torch.minimum(t.clamp(min=0.0), self.travel_time)
        remaining = self.travel_time - t
        a, blend = self.acceleration, self.blend_time
        starting, stopping = t < blend, remaining < blend

        def pick(start: Tensor, stop: Tensor, between: Tensor) -> Tensor:
            return torch.where(starting, start, torch.where(stopping, stop, between))

        cruise = a * blend
        distance = pick(0.5 * a * t**2, self.length - 0.5 * a * remaining**2, cruise * (t - 0.5 * blend))
        speed = pick(a * t, a * remaining, cruise)
        return distance, speed, pick(a, -a, torch.zeros_like(a))


def trapezoid(length: Tensor, travel_time: float, max_acceleration: float) -> Trapezoid:
    """Return the profiles for lengths d `(*batch,)` [m], with travel time T and maximum acceleration a.

    The blend time is t_c = T/2 − ½ √(T² − 4 d/a). If the acceleration a is too small to cover d in time T,
    the `travel_time` of the result is 2 √(d/a). Source: Siciliano et al., eqs. 4.7 and 4.8.

    Raises:
        ForceGPError: the time or the acceleration is not positive.
    """
    for name, value in (("travel_time", travel_time), ("max_acceleration", max_acceleration)):
        if not 0.0 < value < float("inf"):
            raise ForceGPError(f"{name} must be positive", expected="a positive finite number", got=value)
    needed = length / max_acceleration
    T = torch.maximum(torch.full_like(length, travel_time), 2.0 * needed.sqrt())
    blend = 0.5 * (T - (T**2 - 4.0 * needed).clamp(min=0.0).sqrt())
    return Trapezoid(length, T, blend, torch.full_like(length, max_acceleration))


@dataclass(frozen=True)
class Chart:
    """Coordinates (u, v, h) about a point, with u and v along the surface and the height h above it.

    Args:
        center: origin, `(3,)` [m], which is on the surface if there is one.
        axes: matrix `(3, 3)` with the directions of u and v and the normal at the centre as its rows.
        surface: the curved surface under u and v, or `None` for a linear chart (a plane or free space).
    """

    center: Tensor
    axes: Tensor
    surface: Surface | None

    @staticmethod
    def about(center: Tensor, surface: Surface | None) -> Chart:
        """Return the chart about the surface point closest to `center`, with u along the world x axis.

        In free space, the normal is the world z axis.
        """
        normal = torch.eye(3, dtype=center.dtype)[2]
        if surface is not None:
            center = project(surface, center)
            normal = torch.nn.functional.normalize(surface.gradient(center), dim=-1)
        ahead = torch.eye(3, dtype=center.dtype)[int(normal[0].abs() > 0.9)]
        u = torch.nn.functional.normalize(ahead - (ahead @ normal) * normal, dim=-1)
        axes = torch.stack([u, torch.linalg.cross(normal, u), normal])
        return Chart(center, axes, None if isinstance(surface, Plane) else surface)

    def point(self, w: Tensor) -> Tensor:
        """Return the world position `(*batch, 3)` of chart coordinates w `(*batch, 3)`."""
        if self.surface is None:
            return self.center + w @ self.axes
        foot = project(self.surface, self.center + w[..., :2] @ self.axes[:2])
        normal = torch.nn.functional.normalize(self.surface.gradient(foot), dim=-1)
        return foot + w[..., 2:] * normal

    def motion(self, w: Tensor, wd: Tensor, wdd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the world position, velocity and acceleration of a motion in the chart, each `(n, 3)`."""
        if self.surface is None:
            return self.point(w), wd @ self.axes, wdd @ self.axes

        def at(s: Tensor) -> Tensor:
            return self.point(w + s * wd + 0.5 * s**2 * wdd)

        def rate(s: Tensor) -> Tensor:
            return torch.func.jvp(at, (s,), (torch.ones_like(s),))[1]

        now = torch.zeros(len(w), 1, dtype=w.dtype)
        position = self.point(w)
        velocity, acceleration = torch.func.jvp(rate, (now,), (torch.ones_like(now),))[:2]
        return position, velocity, acceleration


def project(surface: Surface, p: Tensor) -> Tensor:
    """Project p `(*batch, 3)` onto a surface along the gradient, p ← p − c ∇c/|∇c|²."""
    for _ in range(PROJECTION_STEPS):
        gradient = surface.gradient(p)
        p = p - (surface.value(p) / (gradient * gradient).sum(-1))[..., None] * gradient
    return p


@dataclass(frozen=True)
class Reference:
    """A sampled reference motion of the end-effector.

    Attributes:
        t: time, `(n,)` [s].
        position, velocity, acceleration: motion in the world, `(n, 3)` [m], [m/s], [m/s²].
        segment: index of the current line, `(n,)`.
        on_surface: mask `(n,)` that is true if the line is on the surface.
        waypoints: end points of the lines in the world, `(segments + 1, 3)` [m].
        travel_time: travel time of each line, `(segments,)` [s].
        lengthened: number of lines with a travel time that was increased to respect the maximum acceleration.
    """

    t: Tensor
    position: Tensor
    velocity: Tensor
    acceleration: Tensor
    segment: Tensor
    on_surface: Tensor
    waypoints: Tensor
    travel_time: Tensor
    lengthened: int


def draw_waypoints(
    count: int,
    size: tuple[float, float],
    lift_height: tuple[float, float],
    lift_probability: float,
    generator: torch.Generator,
) -> Tensor:
    """Draw chart coordinates `(count, 3)` [m] uniformly in a rectangle, and lift some to a random height."""
    draws = torch.rand(count, 4, dtype=torch.float64, generator=generator)
    across = (draws[:, :2] - 0.5) * torch.tensor(size, dtype=torch.float64)
    low, high = lift_height
    height = (low + (high - low) * draws[:, 2]) * (draws[:, 3] < lift_probability)
    return torch.cat([across, height[:, None]], dim=-1)


def straight_lines(
    chart: Chart, waypoints: Tensor, t: Tensor, travel_time: float, max_acceleration: float
) -> Reference:
    """Return the motion along lines between waypoints `(k, 3)` of a chart at times t `(n,)` ≥ 0.

    The velocity is trapezoidal, with travel time and acceleration as in `trapezoid`. Speed and acceleration
    refer to the chart, and on a plane or in free space also to the end-effector. The motion ends at rest.
    """
    lines = waypoints.diff(dim=0)
    profile = trapezoid(torch.linalg.vector_norm(lines, dim=-1), travel_time, max_acceleration)
    ends = profile.travel_time.cumsum(0)
    segment = torch.searchsorted(ends, t, right=True).clamp(max=len(lines) - 1)
    since = t - (ends - profile.travel_time)[segment]
    direction = torch.nn.functional.normalize(lines, dim=-1)[segment]
    s, sd, sdd = Trapezoid(*(x[segment] for x in profile)).at(since)
    w = waypoints[segment] + s[:, None] * direction
    position, velocity, acceleration = chart.motion(w, sd[:, None] * direction, sdd[:, None] * direction)
    resting = (waypoints[:-1, 2] == 0.0) & (waypoints[1:, 2] == 0.0)
    return Reference(
        t=t,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        segment=segment,
        on_surface=resting[segment],
        waypoints=chart.point(waypoints),
        travel_time=profile.travel_time,
        lengthened=int((profile.travel_time > travel_time).sum()),
    )
