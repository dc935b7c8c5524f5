"""Forward simulation of trajectories on a surface, with uncertainty and intermittent contacts."""

from forcegp.forces.quantities import ForceField
from forcegp.rollout.comparison import Comparison, beside_log, compare, widening
from forcegp.rollout.events import ContactEvent, contact_loss_probability
from forcegp.rollout.forward import RolloutOptions, rollout, rollout_model
from forcegp.rollout.inputs import Feedback, ForwardModel, Inputs, Sampled, TaskSpaceControl, Torque
from forcegp.rollout.law import AccelerationLaw, ForceLaw, Law, law_of
from forcegp.rollout.trajectory import Bands, DivergedError, Divergence, Rollout

__all__ = [
    "AccelerationLaw",
    "Bands",
    "Comparison",
    "ContactEvent",
    "DivergedError",
    "Divergence",
    "Feedback",
    "ForceField",
    "ForceLaw",
    "ForwardModel",
    "Inputs",
    "Law",
    "Rollout",
    "RolloutOptions",
    "Sampled",
    "TaskSpaceControl",
    "Torque",
    "beside_log",
    "compare",
    "contact_loss_probability",
    "law_of",
    "rollout",
    "rollout_model",
    "widening",
]
