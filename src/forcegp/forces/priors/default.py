"""The force priors that models have unless they are given others."""

from __future__ import annotations

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import ContactForcePrior, NormalForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior, JointFrictionPrior, mean_of
from forcegp.gp.kernels import Kernel, Linear, SquaredExponential

PAPER = SquaredExponential()
"""The paper's kernel of a joint force (eq. 31)."""
ANGLES, RATES = SquaredExponential(("q",), shared=True), Linear(("qd",), shared=True)
"""What depends on the configuration; what is linear in the speed of the joints."""
WHOLE = Linear(("tau",)) + ANGLES + RATES * RATES * ANGLES + SquaredExponential(("qd",), shared=True)
"""Of a force that includes the motor torque, which enters linearly: weight, which the configuration decides,
bias and damping, which there are quadratic and linear in the speed, and any friction of the joints."""
REMAINING = RATES * ANGLES + SquaredExponential(shared=True)
"""Of a force without it: damping that depends on the configuration, and anything else."""


def default_priors(
    system: ConstrainedSystem, mean: str | AnalyticalMean = "zero", kernel: Kernel | None = None
) -> tuple[ForcePrior, ...]:
    """A joint force prior, with what accelerations do not show left open where there are contacts.

    Where the mean includes the motor torque, each contact with a surface also has a `SlidingFrictionPrior`:
    without one the joints are blamed for its friction, and what is read in free motion is overconfident.

    Args:
        system: robot and contacts.
        mean: the model's prior mean, which decides what is left to the prior.
        kernel: covariance of each joint force, without a prior on the contact's friction; by default
            `REMAINING` where the mean includes the motor torque, `WHOLE` elsewhere.

    Example:
        >>> import torch, forcegp
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> [type(prior).__name__ for prior in default_priors(system, "analytical")]
        ['JointForcePrior', 'NormalForcePrior', 'SlidingFrictionPrior']
    """
    around = "actuation" in mean_of(mean).terms
    joint = JointForcePrior(kernel or (REMAINING if around else WHOLE))
    if not system.m:
        return (joint,)
    sliding = [SlidingFrictionPrior(name) for name in _surfaces(system)] if around and kernel is None else []
    return (joint, NormalForcePrior(joint), *sliding)


def measured_priors(system: ConstrainedSystem) -> tuple[ForcePrior, ...]:
    """Priors for a robot that is measured: friction of each joint, and of each contact with a surface.

    None of them reads the motor torque. The torque noise that goes with them is learned.

    Args:
        system: robot and contacts.

    Example:
        >>> import torch, forcegp
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> [type(prior).__name__ for prior in measured_priors(system)]
        ['JointFrictionPrior', 'SlidingFrictionPrior']
    """
    sliding = (SlidingFrictionPrior(name, Linear(), coupled=True) for name in _surfaces(system))
    return (JointFrictionPrior(), *sliding)


def contact_priors(system: ConstrainedSystem, kernel: Kernel | None = None) -> tuple[ForcePrior, ...]:
    """A prior on the friction of each contact with a surface; a joint force prior where there is none.

    Args:
        system: robot and contacts.
        kernel: covariance of each Cartesian component of any tangential force; by default the force is
            friction that opposes sliding.

    Example:
        >>> import torch, forcegp
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> [type(prior).__name__ for prior in contact_priors(system)]
        ['SlidingFrictionPrior']
    """
    names = _surfaces(system)
    if kernel is None:
        priors = [SlidingFrictionPrior(name) for name in names]
    else:
        priors = [ContactForcePrior(name, kernel) for name in names]
    return tuple(priors) or (JointForcePrior(),)


def _surfaces(system: ConstrainedSystem) -> list[str]:
    """Names of the contacts with a surface."""
    return [contact.name for contact in system.contacts if isinstance(contact, SurfaceContact)]
