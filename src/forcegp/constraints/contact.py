"""Holonomic constraints c(q) = 0: the contact of a point with a surface, and the connection of two points.

Differentiating twice gives A q̈ = b with A = ∂c/∂q and b = −Ȧ q̇ (eq. 3).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp.constraints.gauss import ContactPoint, tangent_frame
from forcegp.constraints.surface import Surface, check_point
from forcegp.errors import ParameterError
from forcegp.kinematics import Anchor, PointMotion, skew
from forcegp.robot.model import RobotModel


class ConstraintTerms(NamedTuple):
    """A constraint evaluated at a state.

    Attributes:
        c: `(*batch, rows)` constraint error at position level.
        A: `(*batch, rows, nq)` Jacobian of c.
        b: `(*batch, rows)` right-hand side of A q̈ = b, without stabilization.
        point: the contact point, for a contact with a surface.
        holds: `(*batch, rows)` bool, rows that apply at this state; `None` means that all rows apply.
    """

    c: Tensor
    A: Tensor
    b: Tensor
    point: ContactPoint | None = None
    holds: Tensor | None = None


class Constraint(ABC):
    """A named holonomic constraint with a fixed number of rows."""

    name: str
    rows: int

    @property
    @abstractmethod
    def anchors(self) -> tuple[Anchor, ...]:
        """Frames and points of the robot that the constraint depends on."""

    @abstractmethod
    def terms_of(self, points: Sequence[PointMotion]) -> ConstraintTerms:
        """Return c, A and b, computed from the motion of the anchors."""

    @abstractmethod
    def check(self, robot: RobotModel) -> None:
        """Check that the constraint matches a robot.

        Raises:
            UnknownNameError: the robot does not have the frame.
            ParameterError: a point does not have three finite coordinates.
        """


@dataclass(frozen=True)
class SurfaceContact(Constraint):
    """Contact between a surface and a point or a ball on the robot, c(q) = c_surface(p(q)) − r.

    A = ∇cᵀ J_p and b = −(∇cᵀ J̇_p q̇ + ṗᵀ ∇²c ṗ). If |∇c| = 1, the multiplier is the normal force. A rounded
    tip is a ball of radius r around p. Its contact point p − r n has the material velocity ṗ + ω × (−r n), so
    J_E = J_p + r [n]ₓ J_ω. About p, friction has the lever arm −r n, and the normal force has none.

    A contact that may stick has two additional rows, (t_1, t_2)ᵀ J_E q̇ = 0 in the tangent frame of the
    surface. They apply while the tangential speed of the contact point is below `stick_speed`, and their
    multipliers are the components of the tangential force. In a rollout, sticking ends when this force
    exceeds the friction predicted by the model (`rollout/cone.py`).

    Args:
        name: name of the contact; in a data set, its column is `contact.<name>`.
        frame: link or frame of the contact point.
        point: coordinates of the point in that frame [m], or those of the centre of a rounded tip.
        surface: the surface in the world frame.
        radius: radius r of a rounded tip [m]; 0 for a sharp tip.
        stick_speed: tangential speed below which the contact point sticks [m/s]; `None` if it always slides.

    Raises:
        ParameterError: the radius is negative, c is not a signed distance, or the speed is not positive.

    Example:
        >>> from forcegp import Plane
        >>> tip = SurfaceContact("table", "tool0", (0.0, 0.0, 0.08), Plane(offset=0.05), radius=0.01)
        >>> round(tip.center_surface.offset, 3)
        0.06
    """

    name: str
    frame: str
    point: Sequence[float]
    surface: Surface
    rows: int = field(default=1, init=False)
    radius: float = field(default=0.0, kw_only=True)
    stick_speed: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.stick_speed is not None:
            if not 0.0 < self.stick_speed < float("inf"):
                raise ParameterError(
                    f"contact {self.name!r} has an invalid stick speed",
                    expected="a positive finite speed [m/s], or None for a contact that always slides",
                    got=self.stick_speed,
                )
            object.__setattr__(self, "rows", 3)
        if not 0.0 <= self.radius < float("inf"):
            raise ParameterError(
                f"the tip of contact {self.name!r} has an invalid radius",
                expected="a finite length, 0 or above [m]",
                got=self.radius,
            )
        _ = self.center_surface

    @property
    def center_surface(self) -> Surface:
        """Surface on which `point` moves, which is the contact surface offset by the radius of the tip."""
        return self.surface.raised(self.radius) if self.radius else self.surface

    def check(self, robot: RobotModel) -> None:
        robot.frame_index(self.frame)
        check_point(self.point, f"the touching point of {self.name!r}")

    @property
    def anchors(self) -> tuple[Anchor, ...]:
        return ((self.frame, self.point),)

    def terms_of(self, points: Sequence[PointMotion]) -> ConstraintTerms:
        (tip,) = points
        surface = self.center_surface
        # c(p), A = ∇cᵀ J_p, b = −(∇cᵀ J̇_p q̇ + ṗᵀ ∇²c ṗ) (eq. 3)
        c, normal = surface.value(tip.position), surface.gradient(tip.position)
        J, velocity = tip.jacobian[..., 3:, :], tip.twist[..., 3:]
        A = vecdot(normal[..., None], J, dim=-2)[..., None, :]
        b = -(vecdot(normal, tip.bias[..., 3:]) + surface.curvature(tip.position, velocity))
        touching, bias = ContactPoint(tip.position, velocity, J, normal), tip.bias[..., 3:]
        if self.radius:
            # The touching material point p − r n has the velocity ṗ + ω × (−r n) and J_E = J_p + r [n]ₓ J_ω.
            arm, omega = -self.radius * normal, tip.twist[..., :3]
            touching = ContactPoint(
                tip.position + arm,
                velocity + torch.linalg.cross(omega, arm),
                J - skew(arm) @ tip.jacobian[..., :3, :],
                normal,
            )
            # J̇_E q̇ = J̇_p q̇ + J̇_ω q̇ × (−r n) + ω × (−r ṅ), ṅ = ∇²c ṗ
            turning = torch.func.jvp(surface.gradient, (tip.position,), (velocity,))[1]
            bias = bias + torch.linalg.cross(tip.bias[..., :3], arm)
            bias = bias - self.radius * torch.linalg.cross(omega, turning)
        if self.stick_speed is None:
            return ConstraintTerms(c[..., None], A, b[..., None], touching)
        # A = (∇c, t_1, t_2)ᵀ J_E; while the point is at rest, the tangent frame is treated as constant.
        along, speed = tangent_frame(touching.unit_normal), touching.sliding[1].norm(dim=-1, keepdim=True)
        sticks = speed < self.stick_speed
        touching = dataclasses.replace(touching, sticks=sticks[..., 0])
        A = torch.cat([A, along.mT @ touching.jacobian], dim=-2)
        b = torch.cat([b[..., None], -(along.mT @ bias[..., None])[..., 0]], dim=-1)
        holds = torch.cat([torch.ones_like(sticks), sticks, sticks], dim=-1)
        return ConstraintTerms(torch.nn.functional.pad(c[..., None], (0, 2)), A, b, touching, holds)


@dataclass(frozen=True)
class PointConnection(Constraint):
    """Connection of two points, c(q) = p_1(q) − p_2(q), which closes a kinematic loop.

    Args:
        name: name of the constraint.
        frame, point: first frame, and a point in the coordinates of that frame [m].
        other_frame, other_point: second frame and point; a frame of `None` is the world.
    """

    name: str
    frame: str
    point: Sequence[float]
    other_frame: str | None
    other_point: Sequence[float]
    rows: int = 3

    def check(self, robot: RobotModel) -> None:
        robot.frame_index(self.frame)
        if self.other_frame is not None:
            robot.frame_index(self.other_frame)
        for point in (self.point, self.other_point):
            check_point(point, f"an end of {self.name!r}")

    @property
    def anchors(self) -> tuple[Anchor, ...]:
        first = (self.frame, self.point)
        return (first,) if self.other_frame is None else (first, (self.other_frame, self.other_point))

    def terms_of(self, points: Sequence[PointMotion]) -> ConstraintTerms:
        first = points[0]
        p, bias, J = first.position, first.bias[..., 3:], first.jacobian[..., 3:, :]
        if self.other_frame is None:
            place = torch.as_tensor(self.other_point, dtype=p.dtype, device=p.device)
            return ConstraintTerms(p - place, J, -bias)
        # c = p_1 − p_2, A = J_1 − J_2, b = J̇_2 q̇ − J̇_1 q̇
        other = points[1]
        return ConstraintTerms(p - other.position, J - other.jacobian[..., 3:, :], other.bias[..., 3:] - bias)
