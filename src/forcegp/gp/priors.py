"""Gaussian-process priors on unknown forces: where a force acts, on what it depends, how it varies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, UnknownNameError
from forcegp.gp.kernels import Kernel
from forcegp.gp.states import States
from forcegp.gp.stationary import SquaredExponential
from forcegp.robot.model import RobotModel

RESERVED = ("noise", "analytical")
"""Prefixes of what is learned beside the hyperparameters of the priors."""


class ForcePrior(ABC):
    """A zero-mean prior on an unknown force f(x), carried to generalized forces by a known operator E(x).

    The generalized force is E(x) f(x). A prior with `in_contact_only` contributes to Q_z, the others to Q.
    """

    name: str
    kernel: Kernel
    in_contact_only: bool

    @property
    def measurable(self) -> bool:
        """Whether accelerations in contact or in free motion show the force."""
        return True

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


@dataclass(frozen=True)
class JointForcePrior(ForcePrior):
    """An independent process for each joint's force Q_i (eq. 31), E = I.

    Args:
        kernel: covariance of each component.
        inputs: which of `q`, `qd`, `tau` the force depends on.
        periodic: replace the angle of each revolute joint by its sine and cosine.
        name: prefix of the hyperparameters.

    Raises:
        UnknownNameError: an input is not one of the three.
    """

    kernel: Kernel = field(default_factory=SquaredExponential)
    inputs: tuple[str, ...] = ("q", "qd", "tau")
    periodic: bool = False
    name: str = "joint"
    in_contact_only: bool = False

    def __post_init__(self) -> None:
        check_inputs(self.name, self.inputs, ("q", "qd", "tau"))

    def outputs(self, robot: RobotModel) -> int:
        return robot.nq

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        x = {name: getattr(at, name) for name in self.inputs}
        if self.periodic and "q" in x:
            turns = system.robot.revolute.bool()
            angle = x["q"][:, turns]
            x["q"] = torch.cat([torch.sin(angle), torch.cos(angle), x["q"][:, ~turns]], dim=-1)
        return x

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return torch.eye(at.q.shape[-1], dtype=at.q.dtype, device=at.q.device).expand(len(at.q), -1, -1)


@dataclass(frozen=True)
class NormalForcePrior(ForcePrior):
    """What accelerations in contact never show: a joint force along the constraint, E = Aᵀ Lᵀ = I − P.

    H Aᵀ = 0, so a force Aᵀ g(x) changes the multiplier by −g(x) and no acceleration. A joint force prior
    alone takes its smoothness for knowledge of that part, and gives multipliers that are too sure. This
    independent process of the same size, with the hyperparameters of the joint force prior, leaves open
    what is open, until a force sensor or the like says more.

    Args:
        like: the joint force prior whose kernel, inputs and hyperparameters it shares.
    """

    like: JointForcePrior = field(default_factory=JointForcePrior)
    in_contact_only: bool = True

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return f"{self.like.name}_normal"

    @property
    def kernel(self) -> Kernel:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.like.kernel

    @property
    def measurable(self) -> bool:
        return False

    @property
    def prefix(self) -> str:
        return self.like.name

    def outputs(self, robot: RobotModel) -> int:
        return self.like.outputs(robot)

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return self.like.features(system, at)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return at.eom.A.mT @ at.eom.L.mT


@dataclass(frozen=True)
class OperatorForcePrior(ForcePrior):
    """A prior on any force, carried by a user-given operator ("any analytical tensor of appropriate size").

    Args:
        name: prefix of the hyperparameters.
        size: number of components of f.
        operator_function: maps `(system, states)` to E(x) `(n, nq, size)`.
        feature_function: maps `(system, states)` to named inputs `(n, w)`; q, q̇, τ by default.
        kernel: covariance of each component.
        in_contact_only: whether the force belongs to Q_z.
    """

    name: str
    size: int
    operator_function: Callable[[ConstrainedSystem, States], Tensor]
    feature_function: Callable[[ConstrainedSystem, States], dict[str, Tensor]] | None = None
    kernel: Kernel = field(default_factory=SquaredExponential)
    in_contact_only: bool = False

    def outputs(self, robot: RobotModel) -> int:
        return self.size

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        if self.feature_function is None:
            return {"q": at.q, "qd": at.qd, "tau": at.tau}
        return self.feature_function(system, at)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        E = self.operator_function(system, at)
        expected = (len(at.q), at.q.shape[-1], self.size)
        if tuple(E.shape) != expected:
            raise ModelError(
                f"the operator of force prior {self.name!r} has the wrong shape",
                expected=expected,
                got=tuple(E.shape),
            )
        return E


def check_priors(priors: tuple[ForcePrior, ...], system: ConstrainedSystem) -> None:
    """Check that priors fit a system and have names of their own, which prefix their hyperparameters.

    Raises:
        ModelError: no prior is given, two share a name, or a name is not one word.
        UnknownNameError: a prior names a contact that the system has not.
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
