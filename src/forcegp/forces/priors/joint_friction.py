"""A prior on the friction of each joint, a function of its own velocity, and on the offset of its torque
sensor.

Friction that no robot file declares is the rule: viscous, Coulomb, a transition between the two (Stribeck),
and a part that grows with the load on the bearing. Each joint reads only its own velocity, so the prior
extrapolates to
motions in which other joints do something new, and it never reads τ: in a closed loop the likeliest force
would be the one that cancels the noise of the torque sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.priors.base import JOINT
from forcegp.forces.priors.joint import PerJointPrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel, Linear

SPEEDS = (0.02, 0.1, 0.5)
"""Velocities at which the Coulomb features saturate [rad/s, m/s]: a sharp step, and two slower
transitions."""
OFFSET = 0.3
"""Where the standard deviation of an offset starts, as a fraction of that of a friction weight."""


@dataclass(frozen=True)
class JointFrictionPrior(PerJointPrior):
    """Q_i = w_i·φ(q̇_i) + c_i with φ = (q̇_i, tanh(q̇_i/v_1), tanh(q̇_i/v_2), …, |Q_G,i| tanh(q̇_i/v_1)).

    The weights w_i and the offset c_i are Gaussian and marginalised. Three things are learned: how large the
    friction of each joint is, which features matter, and how large offsets are beside friction; the last two
    are the same for all joints. A joint that moved in one direction only does not tell its offset from its
    friction, but the other joints show which is likely. With a standard deviation for each weight alone,
    learning takes most of them for zero, and the joint is overconfident where it does something new. A kernel
    with a smooth part, such as `Linear(shared=True, offset=0.3) + SquaredExponential(("velocity",))`, adds a
    smooth remainder.

    Args:
        kernel: covariance of each component; linear in the features by default.
        speeds: v_1, v_2, … [rad/s, m/s].
        load: whether friction proportional to the load |Q_G,i| is a feature.
        name: prefix of the hyperparameters.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> prior = JointFrictionPrior()
        >>> prior.outputs(robot), prior.target
        (2, 'joint')

    Raises:
        ModelError: a speed is not positive and finite.
    """

    kernel: Kernel = field(default_factory=lambda: Linear(shared=True, offset=OFFSET))
    speeds: tuple[float, ...] = SPEEDS
    load: bool = True
    name: str = "joint_friction"
    target: str = JOINT

    centred = False
    sticks = True

    def __post_init__(self) -> None:
        if not self.speeds or not all(0.0 < v < float("inf") for v in self.speeds):
            raise ModelError(
                f"force prior {self.name!r} has an invalid speed",
                expected="positive finite speeds [rad/s]",
                got=self.speeds,
            )

    @property
    def sharpest(self) -> int:
        """Which Coulomb feature is the dry friction of a joint that may stick."""
        return self.speeds.index(min(self.speeds))

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        v = at.qd[..., None]
        columns = {"velocity": v}
        columns |= {f"coulomb_{i}": torch.tanh(v / speed) for i, speed in enumerate(self.speeds)}
        if at.slip is not None:
            columns[f"coulomb_{self.sharpest}"] = at.slip[..., None]
        if self.load:
            columns["load"] = at.eom.Q_G.abs()[..., None] * columns["coulomb_0"]
        return columns
