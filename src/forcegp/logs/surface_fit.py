"""The plane or sphere that the tip slid on, fitted to its path, with error bars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, Plane, Sphere, SurfaceContact
from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.logs.signals import Array

MAD_TO_STD = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""
MOST_POINTS = 20_000
"""Points that are fitted; of a longer path, every k-th."""
LEAST_POINTS = 20
"""Points that a fit needs."""
ROUNDING = 1e-9
"""Smallest scale of the residuals [m], so that an exact path has one."""
OUTLIER_STD = 4.0
"""Rows further from the surface than so many deviations are not on it."""
LEAST_WIDTH = 10.0
"""Least width of a path that determines a plane, in deviations of its residuals."""
LARGEST_TILT = 0.2
"""Standard deviation of the tilt [rad] beyond which the path does not determine a plane."""


@dataclass(frozen=True)
class SurfaceFit:
    """A fitted surface.

    Attributes:
        contact: name of the contact.
        surface: the plane or sphere.
        std: standard deviations: `offset` [m] (at the middle of the path) and `tilt` [rad] of a plane;
            `center` [m] (the largest of its three) and `radius` [m] of a sphere.
        residual: deviation of the path from the surface [m].
        points, outliers: rows that were fitted, and rows too far off to be on the surface.
        effective_points: how many independent rows the fitted ones are worth.
    """

    contact: str
    surface: Plane | Sphere
    std: dict[str, float]
    residual: float
    points: int
    outliers: int
    effective_points: float

    def toml(self) -> str:
        """The surface as a line of a scene file, with its error bars in a comment."""
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
        return f"surface = {{ {values} }}  # {self.contact}: {bars}\n"


def fit_surface(
    data: Dataset, system: ConstrainedSystem, contact: str, kind: Literal["plane", "sphere"] = "plane"
) -> SurfaceFit:
    """Fit a surface to the path of the touching point while a contact is closed.

    Least squares of the signed distances; rows that a robust fit finds off the surface, such as those of
    bouncing, are left out and counted. The error bars count residuals that are correlated in time as fewer
    independent ones.

    Args:
        data: a log with the contact's state.
        system: the robot with its contacts; the point and the side of the surface are the scene's.
        contact: which contact.
        kind: the kind of surface.

    Raises:
        DataError: the contact is closed in too few rows, or the path is too straight or too short.
        UnknownNameError: the scene has no such contact.
    """
    known = system.contact(contact)
    if not isinstance(known, SurfaceContact):
        raise DataError(f"{contact!r} is no contact with a surface")
    rows = data.active([contact])[:, 0].nonzero()[:, 0]
    if len(rows) < LEAST_POINTS:
        raise DataError(
            f"contact {contact!r} is closed in too few rows to fit a surface",
            expected=f"at least {LEAST_POINTS}",
            got=len(rows),
        )
    rows = rows[:: -(-len(rows) // MOST_POINTS)]
    q = data.select(system.robot.joint_names).q[rows]
    points = kinematics.point_position(system.robot, q, known.frame, tuple(known.point)).numpy()
    normal = known.surface.gradient(
        kinematics.point_position(system.robot, q, known.frame, tuple(known.point))
    )
    fit = _plane if kind == "plane" else _sphere
    return fit(contact, points, normal.mean(0).numpy())


def _plane(contact: str, points: Array, towards: Array) -> SurfaceFit:
    """n = n₀ + a u + b v, scaled to one, through the middle of the path moved by e along n."""
    middle = points.mean(axis=0)
    centered = points - middle
    u, v, n0 = np.linalg.svd(centered, full_matrices=False)[2]
    n0 = n0 if n0 @ towards >= 0.0 else -n0

    def normal(x: Array) -> Array:
        n = n0 + x[0] * u + x[1] * v
        return n / np.linalg.norm(n)

    found = _least_squares(lambda x: centered @ normal(x) - x[2], np.zeros(3))
    x, cov, across = found.x, found.covariance, float((centered @ v).std())
    tilt = float(np.sqrt(max(cov[0, 0], cov[1, 1])))
    if not (tilt < LARGEST_TILT and across > LEAST_WIDTH * found.residuals.std()):
        raise DataError(
            "the path does not determine a plane: it is nearly straight or a point",
            expected=f"a tilt known to {np.degrees(LARGEST_TILT):.2g}°, on a path wider than its noise",
            got=f"± {np.degrees(tilt):.3g}° on a path {1e3 * across:.3g} mm wide",
            hint="slide in two directions",
        )
    n = normal(x)
    plane = Plane(tuple(float(c) for c in n), float(n @ middle + x[2]))
    std = {"offset": float(np.sqrt(cov[2, 2])), "tilt": tilt}
    return _result(contact, plane, std, found, len(points))


def _sphere(contact: str, points: Array, towards: Array) -> SurfaceFit:
    """|p − center| = radius; starts from the linear fit |p|² = 2 p·center + const."""
    middle = points.mean(axis=0)
    centered = points - middle
    design = np.column_stack([2.0 * centered, np.ones(len(points))])
    start, _, rank, _ = np.linalg.lstsq(design, (centered**2).sum(axis=1), rcond=1e-10)
    squared = start[3] + start[:3] @ start[:3]
    if rank < 4 or not squared > 0.0:
        raise DataError(
            "the path does not determine a sphere", got="points in a plane or on a line", hint="fit a plane"
        )

    def residual(x: Array) -> Array:
        return np.linalg.norm(centered - x[:3], axis=1) - x[3]

    found = _least_squares(residual, np.array([*start[:3], np.sqrt(squared)]))
    x, cov = found.x, found.covariance
    center, radius = x[:3] + middle, float(x[3])
    std = {"center": float(np.sqrt(np.diag(cov)[:3].max())), "radius": float(np.sqrt(cov[3, 3]))}
    if not (std["radius"] < 0.5 * radius and (middle - center) @ towards > 0.0):
        raise DataError(
            "the path does not determine a sphere that is touched from outside",
            got=f"radius {radius:.4g} ± {std['radius']:.2g} m",
            hint="fit a plane, or slide over a larger part of the sphere",
        )
    sphere = Sphere(tuple(float(c) for c in center), radius)
    return _result(contact, sphere, std, found, len(points))


def _result(
    contact: str, surface: Plane | Sphere, std: dict[str, float], found: _Solution, points: int
) -> SurfaceFit:
    used = len(found.residuals)
    return SurfaceFit(
        contact, surface, std, float(found.residuals.std()), used, points - used, found.effective
    )


@dataclass(frozen=True)
class _Solution:
    """Parameters, their covariance, residuals of the rows used, and how many of these are independent."""

    x: Array
    covariance: Array
    residuals: Array
    effective: float


def _least_squares(residual: Callable[[Array], Array], start: Array) -> _Solution:
    """A robust fit tells the outliers from the rest; least squares of the rest gives the error bars."""
    robust = start
    for _ in range(2):
        scale = max(_spread(residual(robust)), ROUNDING)
        found = least_squares(residual, robust, loss="soft_l1", f_scale=scale, x_scale="jac")
        robust = found.x
    first = residual(robust)
    inside = np.abs(first - np.median(first)) <= OUTLIER_STD * max(_spread(first), ROUNDING)
    final = least_squares(lambda x: residual(x)[inside], robust, x_scale="jac")
    residuals = residual(final.x)[inside]
    effective = len(residuals) / correlation_time(residuals)
    information = final.jac.T @ final.jac * (effective / len(residuals))
    scale = max(float(residuals.std()), ROUNDING)
    return _Solution(final.x, scale**2 * np.linalg.pinv(information, hermitian=True), residuals, effective)


def correlation_time(values: Array) -> float:
    """1 + 2 Σ ρ_k up to the first negative ρ_k: the rows that count as one independent row (Sokal 1997).

    >>> 0.8 < correlation_time(np.random.default_rng(0).standard_normal(4000)) < 1.2
    True
    """
    x = values - values.mean()
    n = len(x)
    power = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    autocorrelation = np.fft.irfft(power)[:n]
    if not autocorrelation[0] > 0.0:
        return 1.0
    rho = autocorrelation / autocorrelation[0]
    first = int(np.argmax(rho < 0.0)) if (rho < 0.0).any() else n
    return float(min(max(1.0 + 2.0 * rho[1:first].sum(), 1.0), n / LEAST_POINTS if n > LEAST_POINTS else n))


def _spread(values: Array) -> float:
    return MAD_TO_STD * float(np.median(np.abs(values - np.median(values))))
