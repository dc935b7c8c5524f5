"""What is known of forces before data: the prior mean of Q, and Gaussian-process priors on unknown forces.

A prior says where a force acts, on what it depends and how it varies.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import damping_force
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.quantities import AffineMap, States
from forcegp.gp.features import Standardization
from forcegp.gp.kernels import Kernel
from forcegp.gp.structured_covariance import Block
from forcegp.robot.model import RobotModel

JOINT, CONTACT, CONSTRAINT = "joint", "contact", "constraint"
"""Targets of priors: the joint force Q, the contact's dissipative force Q_z, or the part of Q that acts
against the constraint (the range of Aᵀ), which no acceleration in contact shows."""
NOISE, ANALYTICAL, COULOMB = "noise", "analytical", "coulomb"
RESERVED = (NOISE, ANALYTICAL, COULOMB)
"""Prefixes of what is learned beside the hyperparameters of the priors."""

MIXING = "mixing"
"""Last part of the names of what an operator learns."""

ForceMean = Callable[[ConstrainedSystem, States], Tensor]
"""Prior mean of the joint force Q at states, `(n, nq)`."""
TERMS = ("bias", "gravity", "friction", "actuation")
"""Q_C, Q_G, Q_D and Q_u: the known parts of Q."""


@dataclass(frozen=True)
class AnalyticalMean:
    """m(x; θ_A) = Q_K, the sum of some of Q_C, Q_G, Q_D and Q_u.

    Args:
        terms: which of `bias`, `gravity`, `friction`, `actuation` are known; none is the zero mean.

    Example:
        >>> AnalyticalMean(("gravity", "actuation")).terms
        ('gravity', 'actuation')

    Raises:
        UnknownNameError: a term does not exist.
        ModelError: a term is named twice.
    """

    terms: tuple[str, ...] = TERMS

    def __post_init__(self) -> None:
        for term in self.terms:
            if term not in TERMS:
                raise UnknownNameError("term of the analytical mean", term, TERMS)
            if self.terms.count(term) > 1:
                raise ModelError(f"term {term!r} of the analytical mean is named twice", got=self.terms)

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """The mean of Q at states, `(n, nq)` [N m, N]."""
        Q_D = at.eom.Q_D if at.slip is None else damping_force(system.robot, at.qd, at.slip)
        known = {"bias": at.eom.Q_C, "gravity": at.eom.Q_G, "friction": Q_D, "actuation": at.tau}
        return sum((known[term] for term in self.terms), start=torch.zeros_like(at.q))


def mean_of(mean: str | AnalyticalMean) -> AnalyticalMean:
    """`"zero"`, `"analytical"` or a mean of one's own.

    Raises:
        UnknownNameError: a name that is neither.
    """
    if isinstance(mean, AnalyticalMean):
        return mean
    named = {"zero": AnalyticalMean(()), "analytical": AnalyticalMean()}
    if mean not in named:
        raise UnknownNameError("mean", mean, named)
    return named[mean]


class ForcePrior(ABC):
    """A zero-mean prior on an unknown force f(x), carried to generalized forces by a known operator E(x).

    The generalized force is E(x) f(x); `target` says whether it is part of Q, of Q_z, or of Q along the
    constraint.
    """

    name: str
    kernel: Kernel
    target: str
    coupled: bool = False
    """Whether Coulomb friction that is proportional to the multiplier goes with the prior."""
    vectors: tuple[str, ...] = ()
    """Inputs whose components are standardized by one scale, as turning the axes must change nothing."""
    commensurate: bool = True
    """Whether all components of f have one unit."""
    sticks: bool = False
    """Whether the force has dry friction of joints in it, which `States.slip` tells apart."""
    in_time: bool = False
    """Whether the force is a function of time, which couples the samples of a trajectory."""
    scaled: bool = True
    """Whether the inputs are standardized."""
    centred: bool = True
    """Whether the mean of the training data is subtracted from the inputs before they are scaled."""

    @property
    def prefix(self) -> str:
        """Prefix of the hyperparameters; another prior's name where they are shared."""
        return self.name

    @abstractmethod
    def outputs(self, robot: RobotModel) -> int:
        """Number of components of f."""

    @abstractmethod
    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Named inputs of the kernel `(n, w)`, before standardization."""

    @abstractmethod
    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        """E(x) `(n, nq, outputs)`."""

    def initial_parameters(self, robot: RobotModel) -> dict[str, Tensor]:
        """Where learning what the operator E contains begins, by name; nothing for most priors."""
        return {}

    def with_parameters(self, params: Mapping[str, Tensor]) -> ForcePrior:
        """The prior with learned parameters of its operator, of those in `initial_parameters`."""
        return self

    def check(self, system: ConstrainedSystem) -> None:  # noqa: B027  (most priors fit every system)
        """Raise a typed error where the prior does not fit the system."""


def check_inputs(name: str, inputs: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Check what a force depends on.

    Raises:
        ModelError: on nothing.
        UnknownNameError: on something that is not known.
    """
    if not inputs:
        raise ModelError(f"force prior {name!r} depends on nothing", expected="one input at least")
    for given in inputs:
        if given not in known:
            raise UnknownNameError(f"input of force prior {name!r}", given, known)


def check_priors(priors: tuple[ForcePrior, ...], system: ConstrainedSystem) -> None:
    """Check that priors fit a system and have names of their own, which prefix their hyperparameters.

    Raises:
        ModelError: no prior is given, two share a name, or a name is not one word.
        UnknownNameError: a prior names a contact that the system does not have.
    """
    names = [prior.name for prior in priors]
    if not names or len(set(names)) != len(names):
        raise ModelError("force priors need distinct names, and one at least", got=names)
    for name in names:
        if not name or "." in name or name in RESERVED:
            raise ModelError(
                f"a force prior cannot be named {name!r}",
                expected=f"a name without dots that is none of {', '.join(RESERVED)}",
            )
    for prior in priors:
        prior.check(system)


def prior_rows(
    priors: Sequence[ForcePrior],
    scales: Sequence[Standardization],
    mean: ForceMean,
    system: ConstrainedSystem,
    at: States,
    z: AffineMap,
) -> Block:
    """What priors say of a quantity z = B_Q Q + B_z Q_z + o at states.

    Args:
        priors, scales: the force priors and the standardization of their inputs.
        mean: prior mean m of Q.
        system: robot and contacts.
        at: n states.
        z: the quantity.

    Returns:
        Kernel inputs and operators B(x) E(x) of each prior, with o(x) + B(x) m(x) as target.
    """
    target = z.o + (z.B_Q @ mean(system, at)[..., None])[..., 0]
    by_target = {CONTACT: z.B_z, CONSTRAINT: z.B_N}
    features, operators = [], []
    for prior in priors:
        features.append(prior.features(system, at))
        operators.append(by_target.get(prior.target, z.B_Q) @ prior.operator(system, at))
    standard = (scale.apply(x) for scale, x in zip(scales, features, strict=True))
    return Block(tuple(standard), tuple(operators), target)
