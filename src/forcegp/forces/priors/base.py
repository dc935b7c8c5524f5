"""Gaussian-process priors on unknown forces, each defined by an operator, inputs and a kernel.

`OperatorForcePrior` is a prior on an arbitrary force with a user-defined operator.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, check_name
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel

JOINT, CONTACT, CONSTRAINT = "joint", "contact", "constraint"
"""Targets of priors: the joint force Q, the dissipative contact force Q_z, or the part of Q along the
constraint (in the range of Aᵀ), which does not affect accelerations in contact."""
NOISE, ANALYTICAL, COULOMB = "noise", "analytical_parameters", "coulomb"
RESERVED = (NOISE, ANALYTICAL, COULOMB)
"""Prefixes of learned parameters other than the hyperparameters of the priors."""
ForceMean = Callable[[ConstrainedSystem, States], Tensor]
"""Function that returns the prior mean of the joint force Q at states, `(n, nq)`."""


class ForcePrior(ABC):
    """A zero-mean prior on an unknown force f(x), mapped to generalized forces by a known operator E(x).

    The generalized force E(x) f(x) belongs to the part of Q̄ given by `target`: Q, Q_z, or Q along the
    constraint. A subclass has a `name`, a `kernel` and a `target`, and implements `outputs`, `features` and
    `operator`. Only classes listed in `CLASSES` of `models/structured_file.py` can be saved.
    """

    name: str
    kernel: Kernel
    target: str
    coupled: bool = False
    """Whether the prior includes Coulomb friction proportional to the multiplier."""
    vectors: tuple[str, ...] = ()
    """Vector inputs, which have a common scale so that results do not depend on the axes."""
    commensurate: bool = True
    """Whether all components of f have the same physical unit."""
    sticks: bool = False
    """Whether the force includes dry joint friction, for which `States.slip` is needed."""
    remembers: bool = False
    """Whether the force depends on the past, for which `States.history` is needed."""
    scaled: bool = True
    """Whether to standardize the kernel inputs."""
    per_joint: bool = False
    """Whether f has one component per joint and E = I, so that products with E can be skipped."""
    centred: bool = True
    """Whether to subtract the mean of the training data from the inputs before scaling."""
    remainder: bool = False
    """Whether the force is learned from what all other forces leave, and does not change them."""
    is_error: bool = False
    """Whether the robot includes the force, so that its mean is zero and its error only widens error bars."""
    is_stated: bool = False
    """Whether the scale of the force is stated, and not learned."""
    delay: float = 0.0
    """Time by which logged torques precede the motion, if it was identified with the force [s]."""

    @property
    def prefix(self) -> str:
        """Prefix of the hyperparameters. Priors with the same prefix share their hyperparameters."""
        return self.name

    @abstractmethod
    def outputs(self, robot: RobotModel) -> int:
        """Return the number of components of f."""

    @abstractmethod
    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Return the named kernel inputs `(n, w)` before standardization."""

    @abstractmethod
    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Return E(x) `(n, nq, outputs)`."""

    def applied(self, B: Tensor, system: ConstrainedSystem, at: States) -> Tensor:
        """Return B E(x) for a map B `(n, d, nq)` of joint forces."""
        return B @ self.operator(system, at)

    def stated(self, initial: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return initial log-hyperparameters of the kernel, changed by what is known of the force."""
        return initial

    def check(self, system: ConstrainedSystem) -> None:  # noqa: B027  (most priors fit every system)
        """Raise a typed error if the prior does not match the system."""


def check_inputs(name: str, inputs: tuple[str, ...], valid: tuple[str, ...]) -> None:
    """Check the names of the inputs of a force.

    Raises:
        ModelError: there are no inputs.
        UnknownNameError: an input is unknown.
    """
    if not inputs:
        raise ModelError(f"force prior {name!r} has no inputs", expected="at least one input")
    for symbol in inputs:
        check_name(f"input of force prior {name!r}", symbol, valid)


def check_priors(priors: tuple[ForcePrior, ...], system: ConstrainedSystem) -> None:
    """Check that priors match a system and have distinct names, since names are hyperparameter prefixes.

    Raises:
        ModelError: there are no priors, one is not a prior, two have the same name, a name is not a single
            word, or a prior shares the hyperparameters of a missing prior.
        UnknownNameError: a prior names a contact that the system does not have.
    """
    for prior in priors:
        if not isinstance(prior, ForcePrior):
            raise ModelError(
                "not a force prior",
                expected="objects such as forcegp.priors.JointFrictionPrior()",
                got=repr(prior),
                hint="omit force_priors for all terms that apply to the log",
            )
        kernel, name = (getattr(prior, key, None) for key in ("kernel", "name"))
        if not isinstance(kernel, Kernel) or not isinstance(name, str):
            raise ModelError(
                f"{type(prior).__name__} is not a valid force prior",
                expected="a kernel and a name",
                got=f"kernel {kernel!r} and name {name!r}",
                hint="give the class both fields, and decorate it with @dataclass(frozen=True)",
            )
    names = [prior.name for prior in priors]
    if not names or len(set(names)) != len(names):
        raise ModelError("force priors need distinct names, and at least one prior", got=names)
    for name in names:
        if not name or "." in name or name in RESERVED:
            raise ModelError(
                f"a force prior cannot be named {name!r}",
                expected=f"a name without dots that is not one of {', '.join(RESERVED)}",
            )
    for prior in priors:
        if prior.prefix not in names:
            raise ModelError(
                f"force prior {prior.name!r} shares the hyperparameters of a prior that is missing",
                expected=f"{prior.prefix!r} among the priors",
                got=", ".join(names),
            )
        prior.check(system)


@dataclass(frozen=True)
class OperatorForcePrior(ForcePrior):
    """A prior on a force with a user-defined operator, which may be any tensor of appropriate size.

    Args:
        name: prefix of the hyperparameters.
        size: number of components of f.
        operator_function: function that maps `(system, states)` to E(x) `(n, nq, size)`.
        feature_function: function that maps `(system, states)` to named inputs `(n, w)`; default q, q̇, τ.
        kernel: covariance of each component.
        target: `joint` for Q, `contact` for Q_z, or `constraint` for Q along the constraint.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> system = forcegp.ConstrainedSystem(robot)
        >>> frame = robot.frame_names[-1]
        >>> def at_end(system, at):
        ...     return forcegp.kinematics.point_jacobian(system.robot, at.q, frame).mT
        >>> wind = OperatorForcePrior("wind", 3, at_end)
        >>> wind.outputs(robot), wind.target
        (3, 'joint')
    """

    name: str
    size: int
    operator_function: Callable[[ConstrainedSystem, States], Tensor]
    feature_function: Callable[[ConstrainedSystem, States], dict[str, Tensor]] | None = None
    kernel: Kernel = field(default_factory=SquaredExponential)
    target: str = JOINT

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
