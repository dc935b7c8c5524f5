"""Named sets of force priors: the candidates of automatic selection, and those of the paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import check_name
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import ContactForcePrior, NormalForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior, JointFrictionPrior, mean_of
from forcegp.gp.kernels import Kernel, Linear, SquaredExponential

PAPER = SquaredExponential()
"""The paper's kernel of a joint force (eq. 31)."""
ANGLES, RATES = SquaredExponential(("q",), shared=True), Linear(("qd",), shared=True)
"""Kernel of the configuration; what is linear in the speed of the joints."""
WHOLE = Linear(("tau",)) + ANGLES + RATES * RATES * ANGLES + SquaredExponential(("qd",), shared=True)
"""Of a force that includes the motor torque, which enters linearly: weight, which the configuration decides,
bias and damping, which there are quadratic and linear in the speed, and any friction of the joints."""
REMAINING = RATES * ANGLES + SquaredExponential(shared=True)
"""Of a force without it: damping that depends on the configuration, and anything else."""
STATE_RESIDUAL = SquaredExponential(("q", "qd"), shared=True)
"""Of a force that friction leaves. It does not read the motor torque: in closed loop, a residual that does
learns to cancel it."""


def default_priors(
    system: ConstrainedSystem, mean: str | AnalyticalMean = "analytical", kernel: Kernel | None = None
) -> tuple[ForcePrior, ...]:
    """A joint force prior; with contacts also a prior on the part that accelerations do not determine.

    If the mean includes the motor torque, each contact with a surface also has a `SlidingFrictionPrior`;
    without it, its friction would be attributed to the joints, and predictions in free motion would be
    overconfident.

    Args:
        mean: the model's prior mean, which determines the default kernel.
        kernel: covariance of each joint force, without a prior on the contact's friction; by default
            `REMAINING` if the mean includes the motor torque, else `WHOLE`.

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
    """Friction of each joint, and Coulomb friction of each contact with a surface.

    None of the priors depends on the motor torque.

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


def friction_and_residual_priors(system: ConstrainedSystem) -> tuple[ForcePrior, ...]:
    """`friction_priors`, and any force of each joint that depends on (q, q̇)."""
    residual = JointForcePrior(STATE_RESIDUAL, inputs=("q", "qd"))
    normal = (NormalForcePrior(residual),) if system.m else ()
    return (*friction_priors(system), residual, *normal)


@dataclass(frozen=True)
class PriorSet:
    """Force priors around the analytical forces, by name.

    Attributes:
        name: of the set.
        description: the forces that it models.
        priors: the priors for a system.
        has_joint_friction: whether joint friction and torque noise are modelled, which identification of
            inertia requires.
        needs_surface: whether the set is for systems with a contact with a surface.
    """

    name: str
    description: str
    priors: Callable[[ConstrainedSystem], tuple[ForcePrior, ...]]
    has_joint_friction: bool = True
    needs_surface: bool = False

    def fits(self, system: ConstrainedSystem) -> bool:
        """Whether the set is for this system."""
        return not self.needs_surface or bool(_surfaces(system))


def contact_priors(system: ConstrainedSystem, kernel: Kernel | None = None) -> tuple[ForcePrior, ...]:
    """A prior on the friction of each contact with a surface; a joint force prior without such contacts.

    Args:
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


SETS: dict[str, PriorSet] = {
    each.name: each
    for each in (
        PriorSet("sliding", "friction of contacts", contact_priors, False, needs_surface=True),
        PriorSet("friction", "friction of joints and contacts, noise of the torque", friction_priors),
        PriorSet(
            "friction+residual", "the same, and any joint force of (q, q̇)", friction_and_residual_priors
        ),
    )
}
"""Sets around the analytical forces that the data choose between, simplest first."""
FEW = SETS["friction"]
"""The set for few samples."""


def priors_of(
    system: ConstrainedSystem, mean: AnalyticalMean, force_priors: str | Sequence[ForcePrior]
) -> tuple[ForcePrior, ...]:
    """The given force priors, or those of a named set; for `"auto"` those for few samples.

    Raises:
        UnknownNameError: no such set.
    """
    if not isinstance(force_priors, str):
        return tuple(force_priors)
    if force_priors == "auto":
        return FEW.priors(system) if "actuation" in mean.terms else default_priors(system, mean)
    check_name("set of force priors", force_priors, ("auto", *SETS))
    return SETS[force_priors].priors(system)
