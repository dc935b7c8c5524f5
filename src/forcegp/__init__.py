"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on the unknown forces."""

from forcegp import dynamics, kinematics
from forcegp.constraints import (
    Baumgarte,
    ConstrainedSystem,
    Cylinder,
    ImplicitSurface,
    Plane,
    PointConnection,
    Sphere,
    SurfaceContact,
)
from forcegp.robot import RobotModel, load_robot

__all__ = [
    "Baumgarte",
    "ConstrainedSystem",
    "Cylinder",
    "ImplicitSurface",
    "Plane",
    "PointConnection",
    "RobotModel",
    "Sphere",
    "SurfaceContact",
    "dynamics",
    "kinematics",
    "load_robot",
]
