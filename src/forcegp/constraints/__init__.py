"""Implicit constraints: surfaces, contacts, stabilization, and the constrained equations of motion."""

from forcegp.constraints.baumgarte import Baumgarte
from forcegp.constraints.contact import Constraint, PointConnection, SurfaceContact
from forcegp.constraints.gauss import Equations
from forcegp.constraints.surface import Cylinder, ImplicitSurface, Plane, Sphere, Surface, SurfaceSchema
from forcegp.constraints.system import ConstrainedSystem

__all__ = [
    "Baumgarte",
    "ConstrainedSystem",
    "Constraint",
    "Cylinder",
    "Equations",
    "ImplicitSurface",
    "Plane",
    "PointConnection",
    "Sphere",
    "Surface",
    "SurfaceContact",
    "SurfaceSchema",
]
