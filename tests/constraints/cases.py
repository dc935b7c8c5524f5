"""Random robots under constraints of every kind."""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.constraints import (
    Baumgarte,
    ConstrainedSystem,
    Constraint,
    Cylinder,
    ImplicitSurface,
    Plane,
    PointConnection,
    Sphere,
    SurfaceContact,
)
from random_robots import random_robot


def hill(p: Tensor) -> Tensor:
    """A wavy floor; its gradient has no unit length."""
    return p[2] - 0.3 * torch.sin(2.0 * p[0]) * torch.cos(p[1])


CONSTRAINTS: dict[str, tuple[Constraint, ...]] = {
    "plane": (SurfaceContact("plane", "tool", (0.1, 0.0, 0.2), Plane((0.2, 0.3, 1.0), 0.1)),),
    "sphere": (SurfaceContact("ball", "tool", (0.0, 0.1, 0.0), Sphere((3.0, 1.0, 0.5), 0.5)),),
    "cylinder": (
        SurfaceContact("pipe", "tool", (0.0, 0.1, 0.0), Cylinder((3.0, 1.0, 0.5), (1.0, 2.0, 0.0), 0.2)),
    ),
    "implicit": (SurfaceContact("hill", "tool", (0.0, 0.0, 0.1), ImplicitSurface(hill)),),
    "two": (
        SurfaceContact("plane", "tool", (0.1, 0.0, 0.2), Plane((0.2, 0.3, 1.0), 0.1)),
        SurfaceContact("ball", "tool", (0.0, 0.1, 0.0), Sphere((3.0, 1.0, 0.5), 0.5)),
    ),
    "rounded": (SurfaceContact("round", "tool", (0.1, 0.0, 0.2), Plane((0.2, 0.3, 1.0), 0.1), radius=0.07),),
    "balls": (SurfaceContact("ball", "tool", (0.0, 0.1, 0.0), Sphere((3.0, 1.0, 0.5), 0.5), radius=0.2),),
    "pin": (PointConnection("pin", "tool", (0.1, 0.2, 0.0), None, (0.5, 0.1, 0.2)),),
    "redundant": (
        SurfaceContact("plane", "tool", (0.1, 0.0, 0.2), Plane((0.2, 0.3, 1.0), 0.1)),
        SurfaceContact("again", "tool", (0.1, 0.0, 0.2), Plane((0.2, 0.3, 1.0), 0.1)),
        SurfaceContact("ball", "tool", (0.0, 0.1, 0.0), Sphere((3.0, 1.0, 0.5), 0.5)),
    ),
}
SEEDS = (0, 1, 2)


def system_of(kind: str, seed: int, baumgarte: Baumgarte | None = None) -> ConstrainedSystem:
    """A random robot of seven joints under some constraints."""
    return ConstrainedSystem(chain(seed), CONSTRAINTS[kind], baumgarte)


def chain(seed: int):
    """A random robot whose last link hangs on all joints, so that three rows at the tool are independent."""
    robot = random_robot(seed, nq=7)
    return robot.replace(parents=tuple(range(-1, 6)))


def random_state(system: ConstrainedSystem, *batch: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, velocities, and impressed forces."""
    generator = torch.Generator().manual_seed(seed)
    q, qd, Q = (
        torch.randn(*batch, system.robot.nq, generator=generator, dtype=torch.float64) for _ in range(3)
    )
    return q, qd, 10.0 * Q
