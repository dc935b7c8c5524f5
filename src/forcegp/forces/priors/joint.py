"""The prior mean of the joint force Q, computed from the robot file, and priors on the remainder.

- `JointForcePrior`: an arbitrary force with one process per joint.
- `JointFrictionPrior`: friction missing from the robot file (viscous, Coulomb, a transition between the two,
  and a part that increases with the load) and the offset of the torque sensor. The friction of a joint
  depends only on the velocity of that joint, so the prior extrapolates to new motions of other joints.
  Friction does not depend on τ, since in closed loop the most likely force would cancel torque-sensor noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import damping_force
from forcegp.errors import ModelError, check_name
from forcegp.forces.priors.base import JOINT, ForcePrior, check_inputs
from forcegp.forces.quantities import States
from forcegp.forces.term import FORCE, SPEEDS, Array, JointState, JointTerm, PerJointPrior, Units
from forcegp.gp.kernels import Kernel, Linear, SquaredExponential

TERMS = ("bias", "gravity", "friction", "actuation")
"""Names of the known parts of Q: Q_C, Q_G, Q_D and Q_u."""


class ConstantForcePrior(ForcePrior):
    """A prior on constants; its kernel has no inputs."""

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return {"one": at.q.new_zeros(len(at.q), 1)}


@dataclass(frozen=True)
class AnalyticalMean:
    """The prior mean m(x; θ_A) = Q_K, a sum of terms selected from Q_C, Q_G, Q_D and Q_u.

    Args:
        terms: known terms, chosen from `bias`, `gravity`, `friction` and `actuation`; empty for a zero mean.

    Example:
        >>> AnalyticalMean(("gravity", "actuation")).terms
        ('gravity', 'actuation')

    Raises:
        UnknownNameError: a term does not exist.
        ModelError: a term is listed twice.
    """

    terms: tuple[str, ...] = TERMS

    def __post_init__(self) -> None:
        for term in self.terms:
            check_name("term of the analytical mean", term, TERMS)
            if self.terms.count(term) > 1:
                raise ModelError(f"term {term!r} of the analytical mean is named twice", got=self.terms)

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Return the mean of Q at the given states, `(n, nq)` [N m, N]."""
        Q_D = at.eom.Q_D if at.slip is None else damping_force(system.robot, at.qd, at.slip)
        known = {"bias": at.eom.Q_C, "gravity": at.eom.Q_G, "friction": Q_D, "actuation": at.tau}
        return sum((known[term] for term in self.terms), start=torch.zeros_like(at.q))


def mean_of(mean: str | AnalyticalMean) -> AnalyticalMean:
    """Return the mean named `"zero"` or `"analytical"`, or return a given mean unchanged.

    Raises:
        UnknownNameError: the mean does not exist.
    """
    if isinstance(mean, AnalyticalMean):
        return mean
    named = {"zero": AnalyticalMean(()), "analytical": AnalyticalMean()}
    check_name("mean", mean, named)
    return named[mean]


@dataclass(frozen=True)
class JointForcePrior(PerJointPrior):
    """A prior with an independent process for each joint force Q_i (eq. 31) and E = I.

    Args:
        kernel: covariance of each component.
        inputs: inputs of the force, from `q`, `qd` and `tau`.
        periodic: whether to replace the angle of each revolute joint by its sine and cosine.
        name: prefix of the hyperparameters.
        scaled: whether to standardize the inputs, which the paper does not do.

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
    scaled: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        check_inputs(self.name, self.inputs, ("q", "qd", "tau"))

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        x = {name: getattr(at, name) for name in self.inputs}
        if self.periodic and "q" in x:
            turns = system.robot.revolute.bool()
            angle = x["q"][:, turns]
            x["q"] = torch.cat([torch.sin(angle), torch.cos(angle), x["q"][:, ~turns]], dim=-1)
        return x


OFFSET = 0.3
"""Stated standard deviation of an offset, relative to that of a friction weight. The two are collinear for a
joint that moves one way, and friction is the likelier cause."""


SHAPE = 0.1
"""Stated deviation of gradual transitions and of the load, relative to that of viscous and dry friction, of
which they are corrections. The log evidence of the training data, summed over an iiwa in two motions, a
pendulum with two robot files, and a simulated UR5 in contact, is within 1 nat of that with 0.1 for 0.03, and
9 and 42 nats lower for 0.3 and 1."""


@dataclass(frozen=True)
class JointFrictionPrior(JointTerm):
    """A prior on the viscous, Coulomb and load-dependent friction and the offset of each joint.

    Q_i = w_i·φ(q̇_i) + c_i with φ = (q̇_i, tanh(q̇_i/v_1), tanh(q̇_i/v_2), …, |Q_G,i| tanh(q̇_i/v_1)). The
    weights w_i and the offset c_i are Gaussian. The evidence determines the standard deviation of each
    (`learning/evidence.py`). If a joint moved in only one direction, its offset and friction cannot be
    separated, and the stated deviations divide their sum. A kernel such as `Linear() +
    SquaredExponential(("velocity",))` adds a smooth remainder.

    Args:
        kernel: covariance of each component; linear in the features by default.
        speeds: saturation speeds v_1, v_2, … [rad/s, m/s].
        load: whether to include the load-dependent feature |Q_G,i| tanh(q̇_i/v_1).
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

    kernel: Kernel = field(default_factory=lambda: Linear(constant=OFFSET))
    speeds: tuple[float, ...] = SPEEDS
    load: bool = True
    name: str = "joint_friction"
    target: str = JOINT

    units: ClassVar[Units] = {
        "velocity": ("N m s/rad", "N s/m"),
        "load": ("1", "1"),
        "coulomb_": FORCE,
        "offset": FORCE,
    }

    def __post_init__(self) -> None:
        if not self.speeds or not all(0.0 < v < float("inf") for v in self.speeds):
            raise ModelError(
                f"force prior {self.name!r} has an invalid speed",
                expected="positive finite speeds [rad/s]",
                got=self.speeds,
            )

    def stated(self, initial: dict[str, Tensor]) -> dict[str, Tensor]:
        if type(self.kernel) is not Linear or self.kernel.shared or not self.kernel.ard:
            return initial
        slopes = initial["log_slope_std"].clone()
        slopes[:, 2:] += math.log(SHAPE)
        return {**initial, "log_slope_std": slopes}

    def columns(self, x: JointState) -> dict[str, Array]:
        dry = {f"coulomb_{i}": x.direction(speed) for i, speed in enumerate(self.speeds)}
        load = {"load": x.load * dry["coulomb_0"]} if self.load else {}
        return {"velocity": x.qd, **dry, **load}
