"""The force priors that models have unless they are given others."""

from __future__ import annotations

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.gp.kernels import Kernel, Linear
from forcegp.gp.mean import AnalyticalMean, mean_of
from forcegp.gp.priors import ContactForcePrior, ForcePrior, JointForcePrior, NormalForcePrior
from forcegp.gp.stationary import SquaredExponential

PAPER = SquaredExponential()
"""The paper's kernel of a joint force (eq. 31)."""
WHOLE = Linear() + SquaredExponential()
"""Of a force that includes the motor torque, which enters linearly."""
REMAINING = Linear(("qd",), ard=False) * SquaredExponential(("q",)) + SquaredExponential()
"""Of a force without it: damping that depends on the configuration, and anything else."""
CONTACT_FRICTION = Linear(("velocity",)) + SquaredExponential()
"""Of the friction at a contact: viscous, and anything else."""


def default_priors(
    system: ConstrainedSystem, mean: str | AnalyticalMean = "zero", kernel: Kernel | None = None
) -> tuple[ForcePrior, ...]:
    """A joint force prior, with what accelerations do not show left open where there are contacts.

    Args:
        system: robot and contacts.
        mean: the model's prior mean, which decides what is left to the prior.
        kernel: covariance of each joint force; by default `REMAINING` where the mean includes the motor
            torque, `WHOLE` elsewhere.
    """
    joint = JointForcePrior(kernel or (REMAINING if "actuation" in mean_of(mean).terms else WHOLE))
    return (joint, NormalForcePrior(joint)) if system.m else (joint,)


def contact_priors(system: ConstrainedSystem) -> tuple[ForcePrior, ...]:
    """A prior on the friction of each contact with a surface; a joint force prior where there is none."""
    surfaces = [contact.name for contact in system.contacts if isinstance(contact, SurfaceContact)]
    return tuple(ContactForcePrior(name, CONTACT_FRICTION) for name in surfaces) or (JointForcePrior(),)
