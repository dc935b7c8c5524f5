"""Holonomic constraints c(q) = 0 of a robot: a point that touches a surface, two points that coincide.

Differentiating twice gives A q̈ = b with A = ∂c/∂q and b = −Ȧ q̇ (eq. 3).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp.constraints.gauss import ContactPoint
from forcegp.constraints.surface import Surface, check_point
from forcegp.errors import ParameterError
from forcegp.kinematics import Anchor, PointMotion, skew
from forcegp.robot.model import RobotModel


class ConstraintTerms(NamedTuple):
    """A constraint at a state.

    Attributes:
        c: `(*batch, rows)` position-level error.
        A: `(*batch, rows, nq)` Jacobian of c.
        b: `(*batch, rows)` with A q̈ = b, no stabilization.
        point: the touching point, for a contact with a surface.
    """

    c: Tensor
    A: Tensor
    b: Tensor
    point: ContactPoint | None = None


class Constraint(ABC):
    """A named holonomic constraint with a fixed number of rows."""

    name: str
    rows: int

    @property
    @abstractmethod
    def anchors(self) -> tuple[Anchor, ...]:
        """The points of the robot that the constraint reads, each with its frame."""

    @abstractmethod
    def terms_of(self, points: Sequence[PointMotion]) -> ConstraintTerms:
        """c, A and b from the motion of the anchors."""

    @abstractmethod
    def check(self, robot: RobotModel) -> None:
        """Check that the constraint fits a robot.

        Raises:
            UnknownNameError: the robot has no such frame.
            ParameterError: a point does not have three finite coordinates.
        """


@dataclass(frozen=True)
class SurfaceContact(Constraint):
    """A point or a ball of the robot that slides on a surface, c(q) = c_surface(p(q)) − r.

    A = ∇cᵀ J_p and b = −(∇cᵀ J̇_p q̇ + ṗᵀ ∇²c ṗ); the multiplier is the normal force where |∇c| = 1. A rounded
    tip is a ball of radius r around p. It touches in p − r n, whose material velocity is ṗ + ω × (−r n), so
    J_E = J_p + r [n]ₓ J_ω: friction at a rounded tip has the lever arm −r n, the normal force has none.

    Args:
        name: name of the contact, as in `contact.<name>` of a data set.
        frame: link or frame that carries the point.
        point: coordinates in that frame [m]; of a rounded tip, its centre.
        surface: the surface, in the world.
        radius: r of a rounded tip; 0 is a sharp one [m].

    Raises:
        ParameterError: the radius is negative, or the surface is not a signed distance.

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
    rows: int = 1
    radius: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        if not 0.0 <= self.radius < float("inf"):
            raise ParameterError(
                f"the tip of contact {self.name!r} has no such radius",
                expected="a finite length, 0 or above [m]",
                got=self.radius,
            )
        _ = self.center_surface

    @property
    def center_surface(self) -> Surface:
        """The surface that `point` moves on: that of the contact, raised by the radius of the tip."""
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
        touching = ContactPoint(tip.position, velocity, J, normal)
        if self.radius:
            # The touching material point p − r n has the velocity ṗ + ω × (−r n) and J_E = J_p + r [n]ₓ J_ω.
            arm = -self.radius * normal
            touching = ContactPoint(
                tip.position + arm,
                velocity + torch.linalg.cross(tip.twist[..., :3], arm),
                J - skew(arm) @ tip.jacobian[..., :3, :],
                normal,
            )
        return ConstraintTerms(c[..., None], A, b[..., None], touching)


@dataclass(frozen=True)
class PointConnection(Constraint):
    """Two points that coincide, c(q) = p_1(q) − p_2(q): closes a kinematic loop.

    Args:
        name: name of the constraint.
        frame, point: first frame, and the point in its coordinates [m].
        other_frame, other_point: the second; `None` holds the first point at a place of the world.
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
