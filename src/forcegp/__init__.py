"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on the unknown forces.

Public names are imported when they are first used: `import forcegp` alone loads no PyTorch, so that the
command line answers at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from forcegp import compiled, derivatives, dynamics, identification, kinematics
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
    from forcegp.data import Dataset, SavitzkyGolay
    from forcegp.robot import AnalyticalParameters, RobotModel, load_robot
    from forcegp.scene import Scene, load_scene

_HOME = {
    "AnalyticalParameters": "robot",
    "Baumgarte": "constraints",
    "ConstrainedSystem": "constraints",
    "Cylinder": "constraints",
    "Dataset": "data",
    "ImplicitSurface": "constraints",
    "Plane": "constraints",
    "PointConnection": "constraints",
    "RobotModel": "robot",
    "SavitzkyGolay": "data",
    "Scene": "scene",
    "Sphere": "constraints",
    "SurfaceContact": "constraints",
    "compiled": "",
    "derivatives": "",
    "dynamics": "",
    "identification": "",
    "kinematics": "",
    "load_robot": "robot",
    "load_scene": "scene",
}
"""The subpackage of each public name; empty where the name is a module itself."""

__all__ = [
    "AnalyticalParameters",
    "Baumgarte",
    "ConstrainedSystem",
    "Cylinder",
    "Dataset",
    "ImplicitSurface",
    "Plane",
    "PointConnection",
    "RobotModel",
    "SavitzkyGolay",
    "Scene",
    "Sphere",
    "SurfaceContact",
    "compiled",
    "derivatives",
    "dynamics",
    "identification",
    "kinematics",
    "load_robot",
    "load_scene",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'forcegp' has no attribute {name!r}")
    if not _HOME[name]:
        return import_module(f"forcegp.{name}")
    value = getattr(import_module(f"forcegp.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
