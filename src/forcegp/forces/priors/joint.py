"""What is known of the joint force Q before data: its mean from the robot file, and one process per joint."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import damping_force
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.priors.base import JOINT, ForcePrior, check_inputs
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel

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


class PerJointPrior(ForcePrior):
    """A force of each joint, E = I; a subclass may have another operator."""

    per_joint = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.per_joint = cls.operator is PerJointPrior.operator

    def outputs(self, robot: RobotModel) -> int:
        return robot.nq

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return torch.eye(at.q.shape[-1], dtype=at.q.dtype, device=at.q.device).expand(len(at.q), -1, -1)


@dataclass(frozen=True)
class JointForcePrior(PerJointPrior):
    """An independent process for each joint's force Q_i (eq. 31), E = I.

    Args:
        kernel: covariance of each component.
        inputs: which of `q`, `qd`, `tau` the force depends on.
        periodic: replace the angle of each revolute joint by its sine and cosine.
        name: prefix of the hyperparameters.

    Example:
        >>> from forcegp.gp.kernels import SquaredExponential
        >>> JointForcePrior(SquaredExponential(("q", "qd"))).name
        'joint'

    Raises:
        UnknownNameError: an input is not one of the three.
    """

    kernel: Kernel = field(default_factory=SquaredExponential)
    inputs: tuple[str, ...] = ("q", "qd", "tau")
    periodic: bool = False
    name: str = "joint"
    target: str = JOINT

    def __post_init__(self) -> None:
        check_inputs(self.name, self.inputs, ("q", "qd", "tau"))

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        x = {name: getattr(at, name) for name in self.inputs}
        if self.periodic and "q" in x:
            turns = system.robot.revolute.bool()
            angle = x["q"][:, turns]
            x["q"] = torch.cat([torch.sin(angle), torch.cos(angle), x["q"][:, ~turns]], dim=-1)
        return x
