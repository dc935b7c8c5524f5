"""The plane or sphere that the tip slid on, fitted to its path, with error bars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

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
        points, effective_points: how many were fitted, and how many independent ones they are worth.
    """

    contact: str
    surface: Plane | Sphere
    std: dict[str, float]
    residual: float
    points: int
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

    Least squares of the signed distances, with a loss that grows linearly beyond three deviations, so that
    rows of bouncing and labelling do not pull. The error bars count residuals that are correlated in time as
    fewer independent ones.

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

    x, cov, residuals, effective = _least_squares(lambda x: centered @ normal(x) - x[2], np.zeros(3))
    tilt = float(np.sqrt(max(cov[0, 0], cov[1, 1])))
    if not tilt < LARGEST_TILT:
        raise DataError(
            "the path does not determine a plane: it is nearly straight or a point",
            expected=f"a tilt known to {np.degrees(LARGEST_TILT):.2g}°",
            got=f"± {np.degrees(tilt):.3g}°",
            hint="slide in two directions",
        )
    n = normal(x)
    plane = Plane(tuple(float(c) for c in n), float(n @ middle + x[2]))
    std = {"offset": float(np.sqrt(cov[2, 2])), "tilt": tilt}
    return SurfaceFit(contact, plane, std, _spread(residuals), len(points), effective)


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

    x, cov, residuals, effective = _least_squares(residual, np.array([*start[:3], np.sqrt(squared)]))
    center, radius = x[:3] + middle, float(x[3])
    std = {"center": float(np.sqrt(np.diag(cov)[:3].max())), "radius": float(np.sqrt(cov[3, 3]))}
    if not (std["radius"] < 0.5 * radius and (middle - center) @ towards > 0.0):
        raise DataError(
            "the path does not determine a sphere that is touched from outside",
            got=f"radius {radius:.4g} ± {std['radius']:.2g} m",
            hint="fit a plane, or slide over a larger part of the sphere",
        )
    sphere = Sphere(tuple(float(c) for c in center), radius)
    return SurfaceFit(contact, sphere, std, _spread(residuals), len(points), effective)


def _least_squares(residual: Callable[[Array], Array], start: Array) -> tuple[Array, Array, Array, float]:
    """Solution, covariance, residuals and number of independent ones."""

    def solve(x: Array) -> OptimizeResult:
        scale = max(_spread(residual(x)), ROUNDING)
        return least_squares(residual, x, loss="soft_l1", f_scale=3.0 * scale, x_scale="jac")

    # The scale of the residuals is known only once the first fit has told the outliers from the rest.
    found = solve(solve(start).x)
    residuals = residual(found.x)
    effective = len(residuals) / correlation_time(residuals)
    information = found.jac.T @ found.jac * (effective / len(residuals))
    scale = max(_spread(residuals), ROUNDING)
    return found.x, scale**2 * np.linalg.pinv(information, hermitian=True), residuals, effective


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
