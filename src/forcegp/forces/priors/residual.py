"""A force on the state (q, q̇) that no law names.

Laws extrapolate to other motions, and a smooth function of the state does not. If both were learned together,
the function would take over part of the laws on the training motion: on a real iiwa, torque errors on other
recordings are 13 to 30 % larger. The force is therefore learned from what all laws leave.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from forcegp.forces.priors.joint import JointForcePrior
from forcegp.gp.kernels import Kernel, SquaredExponential


@dataclass(frozen=True)
class ResidualPrior(JointForcePrior):
    """A prior on a smooth joint force Q_i = f_i(q, q̇) that is learned from what all other forces leave.

    It does not depend on the motor torque, because in closed loop it would learn to cancel this torque.

    Args:
        kernel: covariance of each component, with stated length-scales.
        inputs: the inputs.
        periodic: whether to replace angles by their sine and cosine.
        name: prefix of the hyperparameters.
        scaled: whether to standardize the inputs.

    Example:
        >>> ResidualPrior().inputs
        ('q', 'qd')
    """

    kernel: Kernel = field(default_factory=lambda: SquaredExponential(shared=True))
    inputs: tuple[str, ...] = ("q", "qd")
    name: str = "residual"

    remainder = True
