"""Implicit constraints: surfaces, contacts, stabilization, and the constrained equations of motion."""

from forcegp.constraints.contact import Constraint, PointConnection, SurfaceContact
from forcegp.constraints.gauss import Equations, Linearization
from forcegp.constraints.surface import Cylinder, ImplicitSurface, Plane, Sphere, Surface, SurfaceSchema
from forcegp.constraints.system import Baumgarte, ConstrainedSystem
from forcegp.constraints.unilateral import project_state

__all__ = [
    "Baumgarte",
    "ConstrainedSystem",
    "Constraint",
    "Cylinder",
    "Equations",
    "ImplicitSurface",
    "Linearization",
    "Plane",
    "PointConnection",
    "Sphere",
    "Surface",
    "SurfaceContact",
    "SurfaceSchema",
    "project_state",
]
