"""Fit of a plane or a sphere to the path of the tip, which is a point or a ball.

Error bars account for residuals that are correlated in time. The radius of the ball may be fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy.optimize import least_squares

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, Plane, Sphere, SurfaceContact
from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.learning.correlation import autocorrelation_time
from forcegp.logs.table import Array
from forcegp.robust import robust_std

LEAST_POINTS, ROUNDING = 20, 1e-9
"""Minimum number of points for a fit; smallest scale assumed for the residuals."""
OUTLIER_STD = 4.0
"""Residuals beyond this many standard deviations are outliers."""


@dataclass(frozen=True)
class Solution:
    """Parameters, covariance, residuals, effective number of rows, and number of outliers of a fit."""

    x: Array
    covariance: Array
    residuals: Array
    effective: float
    outliers: int


def robust_least_squares(residual: Callable[[Array], Array], start: Array) -> Solution:
    """Minimise squared residuals `(n,)` over parameters `(k,)`, excluding the outliers of a robust fit."""
    robust = start
    for _ in range(2):
        scale = max(float(robust_std(residual(robust))), ROUNDING)
        robust = least_squares(residual, robust, loss="soft_l1", f_scale=scale, x_scale="jac").x
    first = residual(robust)
    inside = np.abs(first - np.median(first)) <= OUTLIER_STD * max(float(robust_std(first)), ROUNDING)
    final = least_squares(lambda x: residual(x)[inside], robust, x_scale="jac")
    residuals = residual(final.x)[inside]
    centered = torch.from_numpy(residuals - residuals.mean())[:, None]
    time = float(autocorrelation_time(centered, torch.zeros(len(residuals), dtype=torch.int64)))
    effective = max(len(residuals) / time, min(LEAST_POINTS, len(residuals)))
    information = final.jac.T @ final.jac * (effective / len(residuals))
    scale = max(float(residuals.std()), ROUNDING)
    covariance = scale**2 * np.linalg.pinv(information, hermitian=True)
    return Solution(final.x, covariance, residuals, effective, int((~inside).sum()))


LEAST_RADIUS_STD = 4.0
"""Number of standard deviations above which a fitted radius is significant."""


@dataclass(frozen=True)
class Tip:
    """A ball of radius r [m] (`None` if to be fitted), and unit vectors (n, 3) along the tool, or zeros."""

    axes: Array
    radius: float | None

    def start(self, *x: float) -> Array:
        """Return the initial parameters, which begin with those of the surface."""
        return np.array([*x, 0.0] if self.radius is None else x)

    def of(self, x: Array) -> float:
        """Return the radius, given the parameters."""
        return float(x[-1]) if self.radius is None else self.radius

    def std(self, solution: Solution) -> dict[str, float]:
        """Return the error bar of a fitted radius; raise `DataError` if the path cannot determine it."""
        if self.radius is not None:
            return {}
        radius, std = self.of(solution.x), float(np.sqrt(solution.covariance[-1, -1]))
        if not radius > LEAST_RADIUS_STD * std:
            raise DataError(
                "the path does not determine the radius of the tip",
                expected=f"a positive radius, at least {LEAST_RADIUS_STD:g} times its standard deviation",
                got=f"{1e3 * radius:.3g} ± {1e3 * std:.2g} mm",
                hint="measure it, or tilt the tool in contact",
            )
        return {"tip_radius": std}


def tip_of(
    system: ConstrainedSystem, contact: SurfaceContact, q: torch.Tensor, radius: float | Literal["fit"] | None
) -> Tip:
    """Return the tip at positions (n, nq): the tip in the scene, or a ball that ends at the contact point."""
    if radius is None:
        return Tip(np.zeros((len(q), 3)), contact.radius)
    point = torch.tensor(tuple(contact.point), dtype=q.dtype)
    if contact.radius > 0.0 or not bool(point.any()):
        raise DataError(
            f"the tip of contact {contact.name!r} is known, or has no axis",
            expected="a contact of a point away from the origin of its frame, without a radius",
            got=f"radius {contact.radius:g} m, point {tuple(contact.point)}",
            hint="omit the radius of the tip",
        )
    rotation, _ = kinematics.frame_pose(system.robot, q, contact.frame)
    return Tip((rotation @ (point / point.norm())).numpy(), None if radius == "fit" else radius)


MOST_POINTS = 20_000
"""Maximum number of points in a fit; for a longer path, every k-th point is used."""
LEAST_WIDTH, LARGEST_TILT = 10.0, 0.2
"""Minimum width of the path for a plane, relative to the residuals; largest σ of its tilt [rad]."""


@dataclass(frozen=True)
class SurfaceFit:
    """A fitted surface, the radius of the tip [m], and standard deviations.

    The standard deviations of a plane are `offset` [m], at the middle of the path, and `tilt` [rad]. Those of
    a sphere are `center` [m], the largest of three, and `radius` [m]. A fitted tip adds `tip_radius` [m].
    """

    contact: str
    surface: Plane | Sphere
    std: dict[str, float]
    solution: Solution
    tip_radius: float = 0.0

    def toml(self) -> str:
        """Return the surface as a line for a scene file, with error bars in a comment."""
        bars = ", ".join(
            f"{name} ± {np.degrees(v):.2g}°" if name == "tilt" else f"{name} ± {1e3 * v:.2g} mm"
            for name, v in self.std.items()
        )
        if isinstance(self.surface, Plane):
            normal = ", ".join(f"{x:.6f}" for x in self.surface.normal)
            values = f'type = "plane", normal = [{normal}], offset = {self.surface.offset:.6f}'
        else:
            center = ", ".join(f"{x:.6f}" for x in self.surface.center)
            values = f'type = "sphere", center = [{center}], radius = {self.surface.radius:.6f}'
        tip = f"; tip of {1e3 * self.tip_radius:.3g} mm" if self.tip_radius else ""
        return f"surface = {{ {values} }}  # {self.contact}: {bars}{tip}\n"


def fit_surface(
    data: Dataset,
    system: ConstrainedSystem,
    contact: str,
    kind: Literal["plane", "sphere"] = "plane",
    tip_radius: float | Literal["fit"] | None = None,
) -> SurfaceFit:
    """Fit a surface to the path of the contact point while a contact is closed.

    The fit minimises the sum of squared signed distances, excluding outliers of a robust fit. Error bars
    account for residuals that are correlated in time. If `tip_radius` is a number [m] or `"fit"`, the tip is
    a ball that ends at the contact point of the scene. By default, the tip is that of the scene.

    Raises:
        DataError: the tip in the scene already has a radius or has no axis, the contact is closed in too few
            rows, or the path is too straight or too short.
        UnknownNameError: the contact does not exist.
    """
    touching = system.contact(contact)
    if not isinstance(touching, SurfaceContact):
        raise DataError(f"{contact!r} is not a contact with a surface")
    rows = data.active([contact])[:, 0].nonzero()[:, 0]
    if len(rows) < LEAST_POINTS:
        text = f"contact {contact!r} is closed in too few rows to fit a surface"
        raise DataError(text, expected=f"at least {LEAST_POINTS}", got=len(rows))
    rows = rows[:: -(-len(rows) // MOST_POINTS)]
    q = data.select(system.robot.joint_names).q[rows]
    points = kinematics.point_position(system.robot, q, touching.frame, tuple(touching.point))
    normal = touching.surface.gradient(points)
    fit = _plane if kind == "plane" else _sphere
    return fit(contact, points.numpy(), normal.mean(0).numpy(), tip_of(system, touching, q, tip_radius))


def _plane(contact: str, points: Array, towards: Array, tip: Tip) -> SurfaceFit:
    """Fit a plane with unit normal n ∝ n₀ + a u + b v through the middle of the path, shifted by e along n.

    The centre p − r a of the ball satisfies n·(p − r a) − r = offset.
    """
    middle = points.mean(axis=0)
    centered = points - middle
    u, v, n0 = np.linalg.svd(centered, full_matrices=False)[2]
    n0 = n0 if n0 @ towards >= 0.0 else -n0

    def normal(x: Array) -> Array:
        n = n0 + x[0] * u + x[1] * v
        return n / np.linalg.norm(n)

    def residual(x: Array) -> Array:
        n = normal(x)
        return centered @ n - tip.of(x) * (tip.axes @ n + 1.0) - x[2]

    solution = robust_least_squares(residual, tip.start(0.0, 0.0, 0.0))
    x, cov, across = solution.x, solution.covariance, float((centered @ v).std())
    tilt = float(np.sqrt(max(cov[0, 0], cov[1, 1])))
    if not (tilt < LARGEST_TILT and across > LEAST_WIDTH * solution.residuals.std()):
        raise DataError(
            "the path does not determine a plane: it is nearly straight or a point",
            expected=f"a tilt known to {np.degrees(LARGEST_TILT):.2g}°, on a path wider than its noise",
            got=f"± {np.degrees(tilt):.3g}° on a path {1e3 * across:.3g} mm wide",
            hint="slide in two directions",
        )
    n = normal(x)
    plane = Plane(tuple(float(c) for c in n), float(n @ middle + x[2]))
    std = {"offset": float(np.sqrt(cov[2, 2])), "tilt": tilt} | tip.std(solution)
    return SurfaceFit(contact, plane, std, solution, tip.of(x))


def _sphere(contact: str, points: Array, towards: Array, tip: Tip) -> SurfaceFit:
    """Fit |p − r a − center| = radius + r, starting from the linear fit |p|² = 2 p·center + const."""
    middle = points.mean(axis=0)
    centered = points - middle
    design = np.column_stack([2.0 * centered, np.ones(len(points))])
    start, _, rank, _ = np.linalg.lstsq(design, (centered**2).sum(axis=1), rcond=1e-10)
    squared = start[3] + start[:3] @ start[:3]
    if rank < 4 or not squared > 0.0:
        got = "points in a plane or on a line"
        raise DataError("the path does not determine a sphere", got=got, hint="fit a plane")

    def residual(x: Array) -> Array:
        r = tip.of(x)
        return np.linalg.norm(centered - r * tip.axes - x[:3], axis=1) - r - x[3]

    solution = robust_least_squares(residual, tip.start(*start[:3], np.sqrt(squared)))
    x, cov = solution.x, solution.covariance
    center, radius = x[:3] + middle, float(x[3])
    std = {"center": float(np.sqrt(np.diag(cov)[:3].max())), "radius": float(np.sqrt(cov[3, 3]))}
    std |= tip.std(solution)
    if not (std["radius"] < 0.5 * radius and (middle - center) @ towards > 0.0):
        text, got = "the path does not determine a sphere for contact from outside", f"radius {radius:.4g}"
        hint = "fit a plane, or slide over a larger part of the sphere"
        raise DataError(text, got=f"{got} ± {std['radius']:.2g} m", hint=hint)
    return SurfaceFit(contact, Sphere(tuple(float(c) for c in center), radius), std, solution, tip.of(x))
