"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on the unknown forces.

Public names are imported when they are first used: `import forcegp` alone loads no PyTorch, so that the
command line answers at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from forcegp import compiled, derivatives, dynamics, identification, kinematics
    from forcegp.checks import check
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
    from forcegp.data import Dataset, SavitzkyGolay, StreamedDataset
    from forcegp.evaluation import Evaluation, evaluate
    from forcegp.forces.noise import Noise
    from forcegp.forces.observations import Observation
    from forcegp.forces.priors.contact import ContactForcePrior, SlidingFrictionPrior
    from forcegp.forces.priors.coregional import CoregionalPrior
    from forcegp.forces.priors.disturbance import DisturbancePrior
    from forcegp.forces.priors.inertial import InertialPrior
    from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior
    from forcegp.forces.priors.joint_friction import JointFrictionPrior
    from forcegp.forces.priors.normal_force import NormalForcePrior
    from forcegp.forces.priors.operator import OperatorForcePrior
    from forcegp.forces.priors.payload import PayloadPrior
    from forcegp.gp.optimise import LearningOptions
    from forcegp.logs import read_log
    from forcegp.models.analytical import AnalyticalModel
    from forcegp.models.independent_gp import IndependentGP
    from forcegp.models.load import load_model
    from forcegp.models.neural import NeuralNetwork
    from forcegp.models.structured_gp import StructuredGP
    from forcegp.robot import AnalyticalParameters, RobotModel, load_robot
    from forcegp.rollout import Rollout, RolloutOptions, TaskSpaceControl, contact_loss_probability
    from forcegp.scene import Scene, load_scene

_HOME = {
    "AnalyticalMean": "forces.priors.joint",
    "AnalyticalModel": "models.analytical",
    "AnalyticalParameters": "robot",
    "Baumgarte": "constraints",
    "ConstrainedSystem": "constraints",
    "ContactForcePrior": "forces.priors.contact",
    "Cylinder": "constraints",
    "Dataset": "data",
    "Evaluation": "evaluation",
    "ImplicitSurface": "constraints",
    "IndependentGP": "models.independent_gp",
    "InertialPrior": "forces.priors.inertial",
    "JointForcePrior": "forces.priors.joint",
    "JointFrictionPrior": "forces.priors.joint_friction",
    "CoregionalPrior": "forces.priors.coregional",
    "DisturbancePrior": "forces.priors.disturbance",
    "LearningOptions": "gp.optimise",
    "NeuralNetwork": "models.neural",
    "Noise": "forces.noise",
    "NormalForcePrior": "forces.priors.normal_force",
    "Observation": "forces.observations",
    "OperatorForcePrior": "forces.priors.operator",
    "PayloadPrior": "forces.priors.payload",
    "Plane": "constraints",
    "PointConnection": "constraints",
    "RobotModel": "robot",
    "Rollout": "rollout",
    "RolloutOptions": "rollout",
    "SavitzkyGolay": "data",
    "Scene": "scene",
    "Sphere": "constraints",
    "StreamedDataset": "data",
    "StructuredGP": "models.structured_gp",
    "SlidingFrictionPrior": "forces.priors.contact",
    "SurfaceContact": "constraints",
    "TaskSpaceControl": "rollout",
    "check": "checks",
    "compiled": "",
    "contact_loss_probability": "rollout",
    "derivatives": "",
    "dynamics": "",
    "evaluate": "evaluation",
    "identification": "",
    "kinematics": "",
    "load_model": "models.load",
    "load_robot": "robot",
    "load_scene": "scene",
    "read_log": "logs",
}
"""The subpackage of each public name; empty where the name is a module itself."""

__all__ = [
    "AnalyticalMean",
    "AnalyticalModel",
    "AnalyticalParameters",
    "Baumgarte",
    "ConstrainedSystem",
    "ContactForcePrior",
    "CoregionalPrior",
    "Cylinder",
    "Dataset",
    "DisturbancePrior",
    "Evaluation",
    "ImplicitSurface",
    "IndependentGP",
    "InertialPrior",
    "JointForcePrior",
    "JointFrictionPrior",
    "LearningOptions",
    "NeuralNetwork",
    "Noise",
    "NormalForcePrior",
    "Observation",
    "OperatorForcePrior",
    "PayloadPrior",
    "Plane",
    "PointConnection",
    "RobotModel",
    "Rollout",
    "RolloutOptions",
    "SavitzkyGolay",
    "Scene",
    "SlidingFrictionPrior",
    "Sphere",
    "StreamedDataset",
    "StructuredGP",
    "SurfaceContact",
    "TaskSpaceControl",
    "check",
    "compiled",
    "contact_loss_probability",
    "derivatives",
    "dynamics",
    "evaluate",
    "identification",
    "kinematics",
    "load_model",
    "load_robot",
    "load_scene",
    "read_log",
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
