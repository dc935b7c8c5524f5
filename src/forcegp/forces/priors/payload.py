"""A mass that is attached to a link: an unknown payload, marginalised in closed form.

Its equations of motion are linear in its mass and first moment, so it acts like a joint force −Y_k δ with
constant δ and the columns Y_k of the regressor that belong to the link (Atkeson, An, Hollerbach 1986).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.priors.base import JOINT, ForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Constant, Kernel
from forcegp.identification import PARAMETER_NAMES, regressor
from forcegp.robot.inertia import from_pseudo_inertia, pseudo_inertia
from forcegp.robot.model import RobotModel

PER_LINK = len(PARAMETER_NAMES)
MASS_AND_MOMENT = 4
"""Mass and first moment; weight shows them, and noise of accelerations is not taken for them."""
FARTHEST = 3.0
"""A point mass is at most so many standard lengths from the origin of its link."""


@dataclass(frozen=True)
class PayloadPrior(ForcePrior):
    """Q = −Y_k(q, q̇, q̈) S δ, δ ~ N(0, s² I): a point mass on the link that a joint moves.

    q̈ is the acceleration of the arm with the payload `known`, none at first. So the force is exact for that
    payload, and to first order in what it differs by; `around` moves to the present estimate.

    With `update` and `forget` it follows a payload that is picked up or put down. A log without payload says
    that there is none, so leave its scale as it is while other priors learn:
    `model.fit(data, learn=["joint"])`.

    Args:
        joint: whose link carries it; the last joint by default.
        mass: standard deviation of the mass [kg].
        length: standard deviation of the first moment over that of the mass [m].
        kernel: covariance of the constants.
        name: prefix of the hyperparameters.
        known: mass [kg] and first moment [kg m] of the payload that the acceleration is taken with.

    Raises:
        ModelError: the known payload is not a mass and a moment.
    """

    joint: str | None = None
    mass: float = 1.0
    length: float = 0.1
    kernel: Kernel = field(default_factory=lambda: Constant(group=MASS_AND_MOMENT))
    name: str = "payload"
    target: str = JOINT
    known: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.known and not (len(self.known) == MASS_AND_MOMENT and self.known[0] > 0.0):
            raise ModelError(
                f"force prior {self.name!r} has no such known payload",
                expected="a positive mass and three components of its first moment, or nothing",
                got=self.known,
            )

    def outputs(self, robot: RobotModel) -> int:
        return MASS_AND_MOMENT

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return {"one": at.q.new_zeros(len(at.q), 1)}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        # Not the measured one: where the arm hardly accelerates, its noise would be taken for a payload.
        eom = at.eom
        if self.known:
            eom = system.with_robot(self._loaded(system.robot)).equations(at.q, at.qd, at.active)
        qdd = eom.acceleration(eom.Q_K + at.tau)
        first = PER_LINK * self._link(system.robot)
        Y = regressor(system.robot, at.q, at.qd, qdd)[..., first : first + MASS_AND_MOMENT]
        return -Y * self._units(at.q)

    def around(self, mean: Tensor) -> PayloadPrior:
        """The prior with the acceleration of the arm with the estimated payload.

        Args:
            mean: of the latent constants `(4,)`; where it is not a point mass near the link, the arm is taken
                without payload.
        """
        mass, *moment = (mean * self._units(mean)).tolist()
        near = mass > 0.0 and math.hypot(*moment) <= FARTHEST * self.length * mass
        return dataclasses.replace(self, known=(mass, *moment) if near else ())

    def _units(self, like: Tensor) -> Tensor:
        """Mass and first moment for each unit of the latent constants, `(4,)`."""
        return like.new_tensor([self.mass, *3 * [self.mass * self.length]])

    def _loaded(self, robot: RobotModel) -> RobotModel:
        """The robot with the known payload, a point mass."""
        J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
        point = J.new_tensor([*self.known[1:], self.known[0]])
        J = J.index_add(
            0, torch.tensor([self._link(robot)], device=J.device), (point.outer(point) / point[3])[None]
        )
        mass, com, inertia = from_pseudo_inertia(J)
        return robot.replace(mass=mass, com=com, inertia=inertia)

    def check(self, system: ConstrainedSystem) -> None:
        self._link(system.robot)

    def _link(self, robot: RobotModel) -> int:
        if self.joint is None:
            return robot.nq - 1
        if self.joint not in robot.joint_names:
            raise UnknownNameError("joint that carries a payload", self.joint, robot.joint_names)
        return robot.joint_names.index(self.joint)
