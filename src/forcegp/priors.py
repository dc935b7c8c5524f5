"""Priors on unknown forces, prior means, and measurements, of which a `StructuredGP` consists.

Laws of joint friction register themselves when they are imported (`JointTerm.laws`). This module imports all
laws of the library, so that models that contain them can be loaded.
"""

from forcegp.forces.measurements import Observation
from forcegp.forces.priors.base import ForcePrior, OperatorForcePrior
from forcegp.forces.priors.constants import DrivePrior, OffsetPrior, PerRecording
from forcegp.forces.priors.contact import ContactForcePrior, NormalForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior, JointFrictionPrior
from forcegp.forces.priors.memory import BristlePrior
from forcegp.forces.priors.residual import ResidualPrior
from forcegp.forces.priors.ripple import RipplePrior
from forcegp.forces.term import JointTerm

__all__ = [
    "AnalyticalMean",
    "BristlePrior",
    "ContactForcePrior",
    "DrivePrior",
    "ForcePrior",
    "InertialPrior",
    "JointForcePrior",
    "JointFrictionPrior",
    "JointTerm",
    "NormalForcePrior",
    "Observation",
    "OffsetPrior",
    "OperatorForcePrior",
    "PayloadPrior",
    "PerRecording",
    "ResidualPrior",
    "RipplePrior",
    "SlidingFrictionPrior",
]
