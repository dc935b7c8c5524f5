"""A prior on torques that are correlated in time and no function of the state.

Temperature, hysteresis and filters leave residuals that last for a while and are another time different. A
function of the state would take them for signal, white noise for more evidence than there is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.priors.base import JOINT
from forcegp.forces.priors.joint import PerJointPrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Kernel
from forcegp.gp.ornstein_uhlenbeck import SEGMENT, TIME, OrnsteinUhlenbeck

NEW_MOTION = -1.0
"""Number of the trajectory of states that are not of the training log."""


@dataclass(frozen=True)
class DisturbancePrior(PerJointPrior):
    """Q_i = d_i(t), an Ornstein–Uhlenbeck process of each joint, independent from one trajectory to the next.

    Its standard deviation σ_i and correlation time T_i are learned. A new motion tells nothing of it, so it
    adds σ_i² to the variance of the joint force there, and zero to the mean. Inference is exact: sums over
    samples, as in sparse inference, take samples to be independent.

    Args:
        kernel: covariance over time.
        name: prefix of the hyperparameters.

    Example:
        >>> import forcegp
        >>> DisturbancePrior().outputs(forcegp.load_robot("kuka_iiwa"))
        7
    """

    kernel: Kernel = field(default_factory=OrnsteinUhlenbeck)
    name: str = "disturbance"
    target: str = JOINT

    scaled = False
    in_time = True

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        if at.time is None:
            return {TIME: torch.zeros_like(at.q[:, :1]), SEGMENT: torch.full_like(at.q[:, :1], NEW_MOTION)}
        return {TIME: at.time[:, :1], SEGMENT: at.time[:, 1:]}
