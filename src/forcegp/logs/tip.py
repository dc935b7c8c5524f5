"""The tip that touched a surface: a point, or a ball of known or unknown radius."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import DataError
from forcegp.logs.robust_fit import Solution
from forcegp.logs.signals import Array

LEAST_RADIUS_STD = 4.0
"""A fitted radius counts from so many of its standard deviations on."""


@dataclass(frozen=True)
class Tip:
    """A rounded tip: a ball that ends at the path's points, or has its centre there.

    Attributes:
        axes: `(n, 3)` unit vectors from the ball's centre to the path's points; zero where these are centres.
        radius: r of the ball; `None` to fit it [m].
    """

    axes: Array
    radius: float | None

    @classmethod
    def sharp(cls, points: Array) -> Tip:
        """No ball."""
        return cls(np.zeros_like(points), 0.0)

    def start(self, x: list[float]) -> Array:
        """Initial parameters, with those of a surface first."""
        return np.array([*x, 0.0] if self.radius is None else x)

    def of(self, x: Array) -> float:
        """The radius by parameters."""
        return float(x[-1]) if self.radius is None else self.radius

    def std(self, found: Solution) -> dict[str, float]:
        """Error bar of a fitted radius.

        Raises:
            DataError: the orientation of the tip does not show it.
        """
        if self.radius is not None:
            return {}
        radius, std = self.of(found.x), float(np.sqrt(found.covariance[-1, -1]))
        if not radius > LEAST_RADIUS_STD * std:
            raise DataError(
                "the path does not determine the radius of the tip",
                expected=f"a positive radius, at least {LEAST_RADIUS_STD:g} times its standard deviation",
                got=f"{1e3 * radius:.3g} ± {1e3 * std:.2g} mm",
                hint="measure it, or turn the tool while it touches",
            )
        return {"tip_radius": std}


def tip_of(
    system: ConstrainedSystem,
    contact: SurfaceContact,
    q: torch.Tensor,
    radius: float | Literal["fit"] | None,
) -> Tip:
    """The tip that touched at positions `(n, nq)`: that of the scene, or a ball that ends at its point.

    Raises:
        DataError: the scene's tip has a radius of its own, or the point is the origin of its frame.
    """
    if radius is None:
        return Tip(np.zeros((len(q), 3)), contact.radius)
    point = torch.tensor(tuple(contact.point), dtype=q.dtype)
    if contact.radius > 0.0 or not bool(point.any()):
        raise DataError(
            f"the tip of contact {contact.name!r} is known, or has no axis",
            expected="a contact of a point away from the origin of its frame, without a radius",
            got=f"radius {contact.radius:g} m, point {tuple(contact.point)}",
            hint="leave out the radius of the tip",
        )
    rotation, _ = kinematics.frame_pose(system.robot, q, contact.frame)
    axes = (rotation @ (point / point.norm())).numpy()
    return Tip(axes, None if radius == "fit" else radius)
