"""A prior on each joint's force (eq. 31)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.priors.base import JOINT, ForcePrior, check_inputs
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class JointForcePrior(ForcePrior):
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
