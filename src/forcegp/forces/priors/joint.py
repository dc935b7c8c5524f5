"""The prior mean of the joint force Q, computed from the robot file, and priors on the remainder.

- `JointForcePrior`: an arbitrary force with one process per joint.
- `JointFrictionPrior`: friction missing from the robot file (viscous, Coulomb, a transition between the two,
  and a part that increases with the load) and the offset of the torque sensor. The friction of a joint
  depends only on the velocity of that joint, so the prior extrapolates to new motions of other joints.
  Friction does not depend on τ, since in closed loop the most likely force would cancel torque-sensor noise.
- `DisturbancePrior`: slowly varying torques caused by temperature or hysteresis, which functions of the state
  would overfit and white noise would underestimate.
- `CoregionalPrior`: common causes of several joint forces, such as a cable or a contact missing from the
  scene, which independent processes would have to learn separately for each joint.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.dynamics import damping_force
from forcegp.errors import ModelError, check_name
from forcegp.forces.priors.base import JOINT, MIXING, ForcePrior, check_inputs
from forcegp.forces.quantities import States
from forcegp.gp.kernels import SEGMENT, TIME, Kernel, Linear, OrnsteinUhlenbeck, SquaredExponential
from forcegp.robot.model import RobotModel

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


class PerJointPrior(ForcePrior):
    """A prior on one force per joint with E = I; subclasses may have a different operator."""

    per_joint = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.per_joint = cls.operator is PerJointPrior.operator

    def outputs(self, robot: RobotModel) -> int:
        return robot.nq

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return torch.eye(at.q.shape[-1], dtype=at.q.dtype, device=at.q.device).expand(len(at.q), -1, -1)


@dataclass(frozen=True)
class JointForcePrior(PerJointPrior):
    """A prior with an independent process for each joint force Q_i (eq. 31) and E = I.

    Args:
        kernel: covariance of each component.
        inputs: inputs of the force, from `q`, `qd` and `tau`.
        periodic: whether to replace the angle of each revolute joint by its sine and cosine.
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

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        x = {name: getattr(at, name) for name in self.inputs}
        if self.periodic and "q" in x:
            turns = system.robot.revolute.bool()
            angle = x["q"][:, turns]
            x["q"] = torch.cat([torch.sin(angle), torch.cos(angle), x["q"][:, ~turns]], dim=-1)
        return x


SPEEDS = (0.02, 0.1, 0.5)
"""Saturation speeds of the Coulomb features [rad/s, m/s]: a sharp step and two more gradual transitions."""
OFFSET = 0.3
"""Initial standard deviation of an offset, relative to that of a friction weight."""


@dataclass(frozen=True)
class JointFrictionPrior(PerJointPrior):
    """A prior on the viscous, Coulomb and load-dependent friction and the offset of each joint.

    Q_i = w_i·φ(q̇_i) + c_i with φ = (q̇_i, tanh(q̇_i/v_1), tanh(q̇_i/v_2), …, |Q_G,i| tanh(q̇_i/v_1)). The
    weights w_i and the offset c_i are Gaussian and are marginalised. Three kinds of scales are learned: the
    friction of each joint, the relevance of each feature, and the ratio of offsets to friction. All joints
    share the last two. If a joint moved in only one direction, its offset and friction cannot be separated,
    but the other joints indicate which is likely. With a separate standard deviation for each weight,
    learning would set most of them to zero, and the model would be overconfident on new motions. A kernel
    such as `Linear(shared=True, offset=0.3) + SquaredExponential(("velocity",))` adds a smooth remainder.

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
        """Index of the Coulomb feature that models dry friction of a sticking joint."""
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


NEW_MOTION = -1.0
"""Trajectory number assigned to states that are not in the training log."""


@dataclass(frozen=True)
class DisturbancePrior(PerJointPrior):
    """A prior on slow disturbances Q_i = d_i(t), with one Ornstein–Uhlenbeck process per joint.

    Different trajectories have independent disturbances. The standard deviations σ_i and correlation times
    T_i are learned. Disturbances cannot be predicted on new motions, so they add σ_i² to the variance of the
    joint force. Inference must be exact, since sparse inference assumes independent samples.

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


@dataclass(frozen=True)
class CoregionalPrior(ForcePrior):
    """A prior on joint forces with common causes and covariance k(x, x′) (W Wᵀ + diag κ) between joints.

    Q_i = Σ_r W_ir g_r(x) + h_i(x). The causes g_r and the remainders h_i are independent processes with the
    same length-scales, W has one column per cause, and κ is the variance of the remainders. This is the
    intrinsic coregionalisation model (Álvarez, Rosasco and Lawrence, *Kernels for vector-valued functions*,
    2012, section 4.2). All of these parameters are learned. The norm of a column of W is the standard
    deviation of the cause.

    Args:
        kernel: covariance of each process.
        causes: number of columns of W.
        inputs: inputs of the force, from `q`, `qd` and `tau`.
        name: prefix of the hyperparameters.

    Example:
        >>> import forcegp
        >>> CoregionalPrior(causes=2).outputs(forcegp.load_robot("kuka_iiwa"))
        9

    Raises:
        ModelError: the number of causes is not positive.
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
            raise ModelError(
                "a coregionalised force needs at least one cause", expected="1 or more", got=self.causes
            )

    def outputs(self, robot: RobotModel) -> int:
        return self.causes + robot.nq

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return {name: getattr(at, name) for name in self.inputs}

    def initial_parameters(self, robot: RobotModel) -> dict[str, Tensor]:
        """Return the columns of a cosine transform. The first has equal weights for all joints."""
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
        # Columns of unit length: the standard deviation of a cause is a separate factor.
        columns = W / W.norm(dim=0).clamp(min=1e-12)
        eye = torch.eye(robot.nq, dtype=at.q.dtype, device=at.q.device)
        return torch.cat([columns.to(at.q), eye], dim=-1).expand(len(at.q), -1, -1)
