"""A prior on joint forces that are correlated with each other.

One cause moves several joints: a cable, a payload, a contact that the scene does not have. Independent
processes must learn such a force once per joint.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.priors.base import JOINT, MIXING, ForcePrior, check_inputs
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class CoregionalPrior(ForcePrior):
    """Q_i = Σ_r W_ir g_r(x) + h_i(x): covariance k(x, x′) (W Wᵀ + diag κ) between the joints.

    The causes g_r and the remainders h_i are independent processes with the same length-scales, W has a
    column for each cause, and κ is the variance of the remainders (the intrinsic coregionalisation model;
    Álvarez, Rosasco and Lawrence, *Kernels for vector-valued functions*, 2012, section 4.2). All are learned;
    the length of a column of W is the standard deviation of its cause. With a kernel whose length-scales are
    not shared every process has its own (the linear model of coregionalisation).

    Args:
        kernel: covariance of each process.
        causes: number of columns of W.
        inputs: which of `q`, `qd`, `tau` the force depends on.
        name: prefix of the hyperparameters.

    Example:
        >>> import forcegp
        >>> CoregionalPrior(causes=2).outputs(forcegp.load_robot("kuka_iiwa"))
        9

    Raises:
        ModelError: there is no cause.
        UnknownNameError: an input is not one of the three.
    """

    kernel: Kernel = field(default_factory=lambda: SquaredExponential(shared=True))
    causes: int = 1
    inputs: tuple[str, ...] = ("q", "qd")
    name: str = "coregional"
    target: str = JOINT
    _mixing: Tensor | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_inputs(self.name, self.inputs, ("q", "qd", "tau"))
        if self.causes < 1:
            raise ModelError("a coregionalised force needs a cause", expected="1 or more", got=self.causes)

    def outputs(self, robot: RobotModel) -> int:
        return self.causes + robot.nq

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return {name: getattr(at, name) for name in self.inputs}

    def initial_parameters(self, robot: RobotModel) -> dict[str, Tensor]:
        """Columns of a cosine transform: the sum of all joints first."""
        i, r = torch.arange(robot.nq) + 0.5, torch.arange(self.causes)
        return {MIXING: torch.cos(math.pi / robot.nq * i[:, None] * r).to(robot.mass)}

    def with_parameters(self, params: Mapping[str, Tensor]) -> CoregionalPrior:
        if MIXING not in params:
            return self
        known = CoregionalPrior(self.kernel, self.causes, self.inputs, self.name)
        object.__setattr__(known, "_mixing", params[MIXING])
        return known

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        robot = system.robot
        W = self.initial_parameters(robot)[MIXING] if self._mixing is None else self._mixing
        # Unit columns: their length is the standard deviation of the cause.
        columns = W / W.norm(dim=0).clamp(min=1e-12)
        eye = torch.eye(robot.nq, dtype=at.q.dtype, device=at.q.device)
        return torch.cat([columns.to(at.q), eye], dim=-1).expand(len(at.q), -1, -1)
