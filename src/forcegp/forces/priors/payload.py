"""A mass that is attached to a link: an unknown payload, marginalised in closed form.

Its equations of motion are linear in its mass and first moment, so it acts like a joint force −Y_k δ with
constant δ and the columns Y_k of the regressor that belong to the link (Atkeson, An, Hollerbach 1986).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import UnknownNameError
from forcegp.forces.priors.base import JOINT, ForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Constant, Kernel
from forcegp.identification import PARAMETER_NAMES, regressor
from forcegp.robot.model import RobotModel

PER_LINK = len(PARAMETER_NAMES)
MASS_AND_MOMENT = 4
"""Mass and first moment; weight shows them, and noise of accelerations is not taken for them."""


@dataclass(frozen=True)
class PayloadPrior(ForcePrior):
    """Q = −Y_k(q, q̇, q̈) S δ, δ ~ N(0, s² I): a point mass on the link that a joint moves.

    With `update` and `forget` it follows a payload that is picked up or put down. A log without payload says
    that there is none, so leave its scale as it is while other priors learn:
    `model.fit(data, learn=["joint"])`.

    Args:
        joint: whose link carries it; the last joint by default.
        mass: standard deviation of the mass [kg].
        length: standard deviation of the first moment over that of the mass [m].
        kernel: covariance of the constants.
        name: prefix of the hyperparameters.
    """

    joint: str | None = None
    mass: float = 1.0
    length: float = 0.1
    kernel: Kernel = field(default_factory=lambda: Constant(group=MASS_AND_MOMENT))
    name: str = "payload"
    target: str = JOINT

    def outputs(self, robot: RobotModel) -> int:
        return MASS_AND_MOMENT

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return {"one": at.q.new_zeros(len(at.q), 1)}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        # Not the measured one: where the arm hardly accelerates, its noise would be taken for a payload.
        qdd = at.eom.acceleration(at.eom.Q_K + at.tau)
        first = PER_LINK * self._link(system.robot)
        Y = regressor(system.robot, at.q, at.qd, qdd)[..., first : first + MASS_AND_MOMENT]
        return -Y * at.q.new_tensor([self.mass, *3 * [self.mass * self.length]])

    def check(self, system: ConstrainedSystem) -> None:
        self._link(system.robot)

    def _link(self, robot: RobotModel) -> int:
        if self.joint is None:
            return robot.nq - 1
        if self.joint not in robot.joint_names:
            raise UnknownNameError("joint that carries a payload", self.joint, robot.joint_names)
        return robot.joint_names.index(self.joint)
