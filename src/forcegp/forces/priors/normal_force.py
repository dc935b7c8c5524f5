"""A prior on the part of the joint force along the constraint, which no acceleration shows."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.priors.base import CONSTRAINT, ForcePrior
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.quantities import States
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class NormalForcePrior(ForcePrior):
    """What accelerations in contact never show: a joint force along the constraint, E = Aᵀ Lᵀ = I − P.

    H Aᵀ = 0, so a force Aᵀ g(x) changes the multiplier by −g(x) and no acceleration. A joint force prior
    alone is overconfident along the normal. This independent process, with the hyperparameters of the joint
    force prior, keeps the uncertainty of that part until a force sensor or the like reduces it.

    Args:
        like: the joint force prior whose kernel, inputs and hyperparameters it shares.

    Example:
        >>> from forcegp import JointForcePrior
        >>> NormalForcePrior(JointForcePrior()).target
        'constraint'
    """

    like: JointForcePrior = field(default_factory=JointForcePrior)
    target: str = CONSTRAINT

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", f"{self.like.name}_normal")
        object.__setattr__(self, "kernel", self.like.kernel)

    @property
    def prefix(self) -> str:
        return self.like.name

    def outputs(self, robot: RobotModel) -> int:
        return self.like.outputs(robot)

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return self.like.features(system, at)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return at.eom.A.mT @ at.eom.L.mT
