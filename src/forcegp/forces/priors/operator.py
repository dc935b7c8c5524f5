"""A prior on any force, carried by an operator of the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.priors.base import JOINT, ForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, SquaredExponential
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class OperatorForcePrior(ForcePrior):
    """A prior on any force, carried by a user-given operator ("any analytical tensor of appropriate size").

    Args:
        name: prefix of the hyperparameters.
        size: number of components of f.
        operator_function: maps `(system, states)` to E(x) `(n, nq, size)`.
        feature_function: maps `(system, states)` to named inputs `(n, w)`; q, q̇, τ by default.
        kernel: covariance of each component.
        target: `joint`, `contact` or `constraint`: whether the force is part of Q, Q_z or Q along the
            constraint.

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
