"""Measurement noise in a log: noise of accelerations, motor torques, and states.

State noise is propagated to first order. At a measured state x + δ with δ ~ N(0, Σ_x), the model predicts z(x
+ δ) ≈ z(x) + G δ with G = ∂z/∂(q, q̇), so the rows of a sample have additional noise with covariance G Σ_x Gᵀ
(McHutchon and Rasmussen, *Gaussian process training with input noise*, 2011). G is first computed from the
equations of motion of the robot file under the measured torque. Once forces have been learned, it is computed
from q̈ = L b + H F̄ with their posterior mean F̄ (`learning/noise_learning.py`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.measurements import Measurement, NoiseStd, Training
from forcegp.forces.posterior import STICK_NOISE, STICK_SPEED
from forcegp.forces.priors.base import NOISE, ForcePrior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.quantities import AffineMap, ForceField, States, linearize_field
from forcegp.forces.term import NEAR_REST, JointTerm
from forcegp.robot.model import RobotModel
from forcegp.robust import MAD_TO_STD


@dataclass(frozen=True)
class Noise:
    """Noise of measured accelerations, motor torques and states.

    Args:
        acceleration: standard deviation of measured accelerations [rad/s², m/s²], one number or one per
            joint. Defaults to the value in the log (`qdd_std` or the header), or to 0.1.
        learn: whether to learn the acceleration noise, starting from `acceleration`.
        torque: standard deviation of the motor torque's white noise [N m, N], one number or one per joint.
            `"learn"` learns it, `"auto"` learns it with priors for real robots, and `None` means no noise.
        state: standard deviations of the white noise of measured q and q̇ [rad, rad/s], each one number or
            one per joint; `None` for no noise.
        degrees_of_freedom: degrees of freedom ν > 2 of a Student t distribution for the noise of each sample;
            4 is suitable for logs with impacts and other outliers. `None` for Gaussian noise.
        external: standard deviations of unknown forces [N m, N], keyed by joint name, for example for joints
            that have no torque sensor or are moved by hand. For joints without a logged torque, the default
            is the size of the force that moves them.

    Example:
        >>> Noise(0.1, torque="learn").learns_torque
        True

    Raises:
        ModelError: a value is out of range.
    """

    acceleration: NoiseStd | None = None
    learn: bool = False
    torque: NoiseStd | str | None = "auto"
    state: tuple[NoiseStd, NoiseStd] | None = None
    degrees_of_freedom: float | None = None
    external: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        torque, nu = self.torque, self.degrees_of_freedom
        for joint, size in (self.external or {}).items():
            if not 0.0 < size < math.inf:
                raise ModelError(
                    f"the unknown force on joint {joint!r} has an invalid standard deviation",
                    expected="a positive finite standard deviation [N m, N]",
                    got=size,
                )
        valid = torque is None or (isinstance(torque, str) and torque in ("auto", "learn"))
        if not valid and (isinstance(torque, str) or not bool((torch.as_tensor(torque) > 0.0).all())):
            raise ModelError(
                "the noise of the motor torque is not valid",
                expected="'auto', 'learn', None, or positive standard deviations [N m, N]",
                got=torque,
            )
        if nu is not None and not 2.0 < nu < float("inf"):
            raise ModelError(
                "the degrees of freedom of the noise are not valid",
                expected="a finite number above 2, or None for Gaussian noise",
                got=nu,
            )

    @classmethod
    def of(cls, noise: NoiseStd | Noise | None) -> Noise:
        """Return a given `Noise` unchanged, or construct one from the given acceleration noise."""
        return noise if isinstance(noise, cls) else cls(noise)  # pyright: ignore[reportArgumentType]

    @property
    def learns_torque(self) -> bool:
        """Whether the motor torque noise is learned."""
        return self.torque == "learn" if isinstance(self.torque, str) else False

    def for_priors(self, priors: Sequence[ForcePrior]) -> Noise:
        """Resolve `torque="auto"`. Torque noise is learned if there are friction or inertial priors."""
        if not isinstance(self.torque, str) or self.torque != "auto":
            return self
        measured = any(isinstance(prior, JointTerm | InertialPrior) for prior in priors)
        return dataclasses.replace(self, torque="learn" if measured else None)


TORQUE_NOISE = f"{NOISE}.torque.log_noise_std"
"""Name of the learned motor torque noise."""


EXACT = 1e-8
"""Standard deviation of torques that is stored in place of zero [N m, N]."""


def initial_torque_noise(residual: Tensor, driven: Tensor) -> dict[str, Tensor]:
    """Return the initial torque noise, given the RMS `(nq,)` of the unexplained torque [N m, N].

    A free base has no drive, and therefore no torque and no noise.
    """
    std = (0.5 * residual).clamp(min=1e-4).where(driven, EXACT).log().double()
    return {
        TORQUE_NOISE: std,
        STICK_NOISE: std.clone(),
        STICK_SPEED: torch.full_like(std, math.log(NEAR_REST)),
    }


def external_std(external: Mapping[str, float] | None, robot: RobotModel) -> Tensor | None:
    """Return the standard deviation of unknown forces on the joints `(nq,)`, or `None` if there are none.

    Raises:
        UnknownNameError: a joint does not exist.
    """
    for joint in external or {}:
        if joint not in robot.joint_names:
            raise UnknownNameError("joint with an unknown force", joint, robot.joint_names)
    if not external:
        return None
    return robot.mass.new_tensor([external.get(joint, 0.0) for joint in robot.joint_names])


ForceNoise = Callable[[States], Tensor]
"""Function that returns the variance `(n, nq)` of the white noise on the joint force at given states."""


@dataclass(frozen=True, eq=False)
class SampleNoise:
    """Noise of the samples in one measurement, with covariance (diag σ² + Σ_k N_k N_kᵀ)/w.

    Attributes:
        std: standard deviation σ of each component, `(d,)` or `(n, d)`.
        force: function that returns the variance Σ_τ of the joint force.
        tips: function that returns the factor of the covariance of contact forces at rest, if there are any.
        torque: `(n, nq)` standard deviation of individual torques in addition to Σ_τ.
        state: factor G Σ_x½ `(n, d, 2 nq)` of the state noise.
        weight: weight w of each sample `(n,)`; `None` if all are 1.
    """

    std: Tensor
    force: ForceNoise | None = None
    state: Tensor | None = None
    weight: Tensor | None = None
    torque: Tensor | None = None
    tips: Callable[[States], Tensor | None] | None = None

    def factors(self, at: States, z: AffineMap) -> list[Tensor]:
        """Return the factors N_k `(n, d, ·)` for the measured quantity."""
        # N = (G Σ_x½, B_Q Σ_τ½, B_z Σ_z½)
        terms = [] if self.state is None else [self.state]
        tips = None if self.tips is None else self.tips(at)
        if tips is not None:
            terms.append(z.B_z @ tips)
        if self.torque is not None:
            terms.append(z.B_Q * self.torque[:, None, :])
        return terms if self.force is None else [*terms, z.B_Q * self.force(at).sqrt()[:, None, :]]

    def covariance(self, at: States, z: AffineMap) -> Tensor:
        """Return Σ_y + B_Q Σ_τ B_Qᵀ + G Σ_x Gᵀ of each sample `(n, d, d)`, ignoring the weights."""
        white = torch.diag_embed(self.std.square().expand_as(z.o))
        return sum((N @ N.mT for N in self.factors(at, z)), start=white)

    def __getitem__(self, rows: Tensor) -> SampleNoise:
        """Return the noise of the given samples."""
        std = self.std if self.std.ndim == 1 else self.std[rows]
        parts = (None if x is None else x[rows] for x in (self.state, self.weight, self.torque))
        return SampleNoise(std, self.force, *parts, tips=self.tips)


def state_jacobian(
    system: ConstrainedSystem, m: Measurement, force: ForceField | None = None
) -> Tensor | None:
    """Return G = dz/d(q, q̇) `(n, d, 2 nq)` for accelerations or multipliers; `None` for other quantities.

    Args:
        force: all impressed forces; defaults to those of the robot file plus the measured torque.
    """
    if m.quantity not in ("qdd", "multiplier"):
        return None
    if force is None:
        at = system.linearize(m.q, m.qd, system.robot.true_torque(m.tau), m.active)
    else:
        at = linearize_field(force, system, m.q, m.qd, m.tau, m.active)
    pair = (at.dq, at.dqd) if m.quantity == "qdd" else (at.multiplier_dq, at.multiplier_dqd)
    return torch.cat(pair, dim=-1)


def learned_slopes(training: Training, system: ConstrainedSystem, force: ForceField) -> Training:
    """Return the training data with G computed at each sample for a given force field."""
    slopes = tuple(state_jacobian(system, m, force) for m in training.measurements)
    return dataclasses.replace(training, slopes=slopes)


def state_std_of(state: Sequence[NoiseStd] | None, robot: RobotModel) -> Tensor | None:
    """Return the standard deviations of q and q̇ as one vector `(2 nq,)`, or `None` if none are given.

    Raises:
        ModelError: `state` is not a pair of standard deviations ≥ 0 (one number or one per joint each).
    """
    if state is None:
        return None
    try:
        std = [torch.as_tensor(x, dtype=robot.dtype, device=robot.device).expand(robot.nq) for x in state]
        valid = len(std) == 2 and all(bool(((x >= 0.0) & torch.isfinite(x)).all()) for x in std)
    except (TypeError, ValueError, RuntimeError):
        valid, std = False, []
    if not valid:
        raise ModelError(
            "the noise of the state is not valid",
            expected=f"two standard deviations, of q and q̇, each one number or {robot.nq}, 0 or above",
            got=state,
        )
    return torch.cat(std)


def white_noise_std(x: Tensor, whole: Tensor) -> Tensor:
    """Return the standard deviation σ `(d,)` of the white noise in each column of a smooth signal `(n, d)`.

    The deviation from the cubic through the neighbours, x_i − (−x_{i−2} + 4 x_{i−1} + 4 x_{i+1} − x_{i+2})/6,
    has variance 35/18 σ². Its median absolute value is robust to jumps. `whole`, shape `(n − 4,)`, marks the
    first of every five samples that are consecutive.
    """
    a, b, middle, c, d = (x[k : len(x) - 4 + k][whole] for k in range(5))
    departure = middle - (4.0 * (b + c) - a - d) / 6.0
    return MAD_TO_STD * departure.abs().median(0).values / (35.0 / 18.0) ** 0.5
