"""The joint force Q before data: its mean from the robot file, and priors on the rest.

- `JointForcePrior`: any force, one process per joint.
- `JointFrictionPrior`: friction that no robot file declares (viscous, Coulomb, a transition between the two,
  a part that grows with the load) and the offset of the torque sensor. Each joint reads only its own
  velocity, so the prior extrapolates to new motions of other joints. It does not depend on τ: in closed loop
      the most likely force would cancel the noise of the torque sensor.
- `DisturbancePrior`: slowly varying torques (temperature, hysteresis). As a function of the state they would
be overfitted, and as white noise they would be underestimated.
- `CoregionalPrior`: common causes of several joint forces, such as a cable or a contact that the scene lacks;
  independent processes must learn such a force once per joint.
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
from forcegp.gp.kernels import Kernel, Linear, SquaredExponential
from forcegp.gp.ornstein_uhlenbeck import SEGMENT, TIME, OrnsteinUhlenbeck
from forcegp.robot.model import RobotModel

TERMS = ("bias", "gravity", "friction", "actuation")
"""Q_C, Q_G, Q_D and Q_u: the known parts of Q."""


@dataclass(frozen=True)
class AnalyticalMean:
    """m(x; θ_A) = Q_K, the sum of some of Q_C, Q_G, Q_D and Q_u.

    Args:
        terms: which of `bias`, `gravity`, `friction`, `actuation` are known; none is the zero mean.

    Example:
        >>> AnalyticalMean(("gravity", "actuation")).terms
        ('gravity', 'actuation')

    Raises:
        UnknownNameError: a term does not exist.
        ModelError: a term is named twice.
    """

    terms: tuple[str, ...] = TERMS

    def __post_init__(self) -> None:
        for term in self.terms:
            check_name("term of the analytical mean", term, TERMS)
            if self.terms.count(term) > 1:
                raise ModelError(f"term {term!r} of the analytical mean is named twice", got=self.terms)

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """The mean of Q at states, `(n, nq)` [N m, N]."""
        Q_D = at.eom.Q_D if at.slip is None else damping_force(system.robot, at.qd, at.slip)
        known = {"bias": at.eom.Q_C, "gravity": at.eom.Q_G, "friction": Q_D, "actuation": at.tau}
        return sum((known[term] for term in self.terms), start=torch.zeros_like(at.q))


def mean_of(mean: str | AnalyticalMean) -> AnalyticalMean:
    """The mean named `"zero"` or `"analytical"`, or a given mean.

    Raises:
        UnknownNameError: no such mean.
    """
    if isinstance(mean, AnalyticalMean):
        return mean
    named = {"zero": AnalyticalMean(()), "analytical": AnalyticalMean()}
    check_name("mean", mean, named)
    return named[mean]


class PerJointPrior(ForcePrior):
    """A force of each joint, E = I; a subclass may have another operator."""

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
    """An independent process for each joint's force Q_i (eq. 31), E = I.

    Args:
        kernel: covariance of each component.
        inputs: which of `q`, `qd`, `tau` the force depends on.
        periodic: replace the angle of each revolute joint by its sine and cosine.
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
"""Velocities at which the Coulomb features saturate [rad/s, m/s]: a sharp step, and two slower
transitions."""
OFFSET = 0.3
"""Initial standard deviation of an offset, as a fraction of that of a friction weight."""


@dataclass(frozen=True)
class JointFrictionPrior(PerJointPrior):
    """Q_i = w_i·φ(q̇_i) + c_i with φ = (q̇_i, tanh(q̇_i/v_1), tanh(q̇_i/v_2), …, |Q_G,i| tanh(q̇_i/v_1)).

    The weights w_i and the offset c_i are Gaussian and marginalised. Three scales are learned: the friction
        of each joint, the relevance of each feature, and the offsets relative to friction; the last two are
        shared by all joints. A joint that moved in one direction only does not separate offset and
    friction, but the other joints indicate which is likely. With a separate standard deviation for each
    weight, learning would set most of them to zero, and be overconfident on new motions. A kernel with a
    smooth part, such as `Linear(shared=True, offset=0.3) + SquaredExponential(("velocity",))`, adds a smooth
    remainder.

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
        """Index of the Coulomb feature that is the dry friction of a joint that may stick."""
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
"""Number of the trajectory of states that are not of the training log."""


@dataclass(frozen=True)
class DisturbancePrior(PerJointPrior):
    """Q_i = d_i(t), an Ornstein–Uhlenbeck process of each joint, independent between trajectories.

    Its standard deviation σ_i and correlation time T_i are learned. It cannot be predicted on new
    motions, so it adds σ_i² to the variance of the joint force there, and zero to the mean. Inference is
    exact, since sparse inference assumes independent samples.

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
