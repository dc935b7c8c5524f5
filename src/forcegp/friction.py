"""Joint friction: viscous, Coulomb (smoothed at zero speed) and the Stribeck effect.

Q_D = −d q̇ − (f_c + f_s e^{−(q̇/v_s)²}) tanh(q̇/v_0); see Armstrong-Hélouvry, Dupont, Canudas de Wit,
*A survey of models, analysis tools and compensation methods for the control of machines with friction*
(Automatica 30, 1994). It is smooth, so it can be integrated and differentiated everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from forcegp.robot.model import RobotModel
from forcegp.types import JointVector


@dataclass(frozen=True)
class JointFriction:
    """Friction of each joint as a function of its velocity.

    Args:
        viscous: `(nq,)` d [N m s/rad, N s/m].
        coulomb: `(nq,)` f_c [N m, N].
        stribeck: `(nq,)` f_s, static friction above the Coulomb level [N m, N].
        stribeck_velocity: `(nq,)` v_s [rad/s, m/s].
        smoothing_velocity: `(nq,)` v_0 [rad/s, m/s].
    """

    viscous: JointVector
    coulomb: JointVector
    stribeck: JointVector
    stribeck_velocity: JointVector
    smoothing_velocity: JointVector

    @classmethod
    def of(cls, robot: RobotModel) -> JointFriction:
        """The friction that a robot carries."""
        return cls(
            robot.damping, robot.friction, robot.stribeck, robot.stribeck_velocity, robot.friction_velocity
        )

    def force(self, qd: JointVector) -> JointVector:
        """Q_D(q̇), opposed to the motion, `(*batch, nq)` [N m, N]."""
        dry = self.coulomb + self.stribeck * torch.exp(-((qd / self.stribeck_velocity) ** 2))
        return -self.viscous * qd - dry * torch.tanh(qd / self.smoothing_velocity)
