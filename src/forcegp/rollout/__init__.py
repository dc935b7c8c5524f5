"""Forward in time: trajectories that stay on the surface, with uncertainty, and contact that can be lost."""

from forcegp.rollout.contact import ContactEvent
from forcegp.rollout.forward import RolloutOptions, rollout, rollout_model
from forcegp.rollout.inputs import Feedback, Inputs, Sampled, TaskSpaceControl
from forcegp.rollout.law import AccelerationLaw, ForceLaw, Law, law_of
from forcegp.rollout.trajectory import Bands, DivergedError, Divergence, Rollout

__all__ = [
    "AccelerationLaw",
    "Bands",
    "ContactEvent",
    "DivergedError",
    "Divergence",
    "Feedback",
    "ForceLaw",
    "Inputs",
    "Law",
    "Rollout",
    "RolloutOptions",
    "Sampled",
    "TaskSpaceControl",
    "law_of",
    "rollout",
    "rollout_model",
]
