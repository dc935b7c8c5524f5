"""Sets of force priors: those of real robots, and those of the paper."""

from __future__ import annotations

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import ContactForcePrior, NormalForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior, JointFrictionPrior, mean_of
from forcegp.gp.kernels import Kernel, Linear, SquaredExponential

PAPER = SquaredExponential()
"""The paper's kernel for a joint force (eq. 31)."""
ANGLES, RATES = SquaredExponential(("q",), shared=True), Linear(("qd",), shared=True)
"""Kernel that depends on the configuration, and linear kernel that depends on the joint velocities."""
WHOLE = Linear(("tau",)) + ANGLES + RATES * RATES * ANGLES + SquaredExponential(("qd",), shared=True)
"""Kernel for a force that includes the motor torque (linear), gravity (a function of the configuration), bias
and damping forces (quadratic and linear in the velocity), and any joint friction."""
REMAINING = RATES * ANGLES + SquaredExponential(shared=True)
"""Kernel for a force without the motor torque: configuration-dependent damping and an arbitrary remainder."""


def default_priors(
    system: ConstrainedSystem, mean: str | AnalyticalMean = "analytical", kernel: Kernel | None = None
) -> tuple[ForcePrior, ...]:
    """Return a joint force prior and, for contacts, a prior on the part not identifiable from accelerations.

    If the mean includes the motor torque, each surface contact also has a `SlidingFrictionPrior`. Otherwise,
    contact friction would be attributed to the joints, and predictions in free motion would be overconfident.

    Args:
        mean: prior mean of the model, which determines the default kernel.
        kernel: covariance of each joint force. Defaults to `REMAINING` if the mean includes the motor torque,
            and to `WHOLE` otherwise. The prior on contact friction does not use it.

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


def friction_priors(system: ConstrainedSystem) -> tuple[ForcePrior, ...]:
    """Return priors on the friction of each joint and on the Coulomb friction of each surface contact.

    None of these priors depends on the motor torque.

    Args:
        system: robot and contacts.

    Example:
        >>> import torch, forcegp
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> [type(prior).__name__ for prior in friction_priors(system)]
        ['JointFrictionPrior', 'SlidingFrictionPrior']
    """
    sliding = (SlidingFrictionPrior(name, Linear(), coupled=True) for name in _surfaces(system))
    return (JointFrictionPrior(), *sliding)


def contact_priors(system: ConstrainedSystem, kernel: Kernel | None = None) -> tuple[ForcePrior, ...]:
    """Return priors on the friction of each surface contact, or a joint force prior if there are no contacts.

    Args:
        kernel: covariance of each component of an arbitrary tangential force. By default, the force is
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
    """Return the names of the contacts with a surface."""
    return [contact.name for contact in system.contacts if isinstance(contact, SurfaceContact)]
