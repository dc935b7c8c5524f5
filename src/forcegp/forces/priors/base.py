"""Gaussian-process priors on unknown forces: where a force acts, on what it depends, how it varies."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel
from forcegp.robot.model import RobotModel

JOINT, CONTACT, CONSTRAINT = "joint", "contact", "constraint"
"""Targets of priors: the joint force Q, the contact's dissipative force Q_z, or the part of Q that acts
against the constraint (the range of Aᵀ), which no acceleration in contact shows."""
NOISE, ANALYTICAL, COULOMB = "noise", "analytical", "coulomb"
RESERVED = (NOISE, ANALYTICAL, COULOMB)
"""Prefixes of what is learned beside the hyperparameters of the priors."""


class ForcePrior(ABC):
    """A zero-mean prior on an unknown force f(x), carried to generalized forces by a known operator E(x).

    The generalized force is E(x) f(x); `target` says whether it is part of Q, of Q_z, or of Q along the
    constraint.
    """

    name: str
    kernel: Kernel
    target: str
    vectors: tuple[str, ...] = ()
    """Inputs whose components are standardized by one scale, as turning the axes must change nothing."""
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
