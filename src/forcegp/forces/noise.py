"""Measurement noise of a log: accelerations, motor torques, and the state.

**Noise of the state**, to first order. At a measured state x + δ, with δ ~ N(0, Σ_x), the model predicts
z(x + δ) ≈ z(x) + G δ, so a sample's rows have the additional noise G Σ_x Gᵀ, with G = ∂z/∂(q, q̇) (McHutchon
and Rasmussen, *Gaussian process training with input noise*, 2011). G is that of the robot file's equations of
motion under the measured torque, or, once forces have been learned, that of q̈ = L b + H F̄ with their
posterior mean F̄ (`forces/noise_learning.py`).
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
from forcegp.forces.posterior import STICK_NOISE, STICK_SPEED, STICKING
from forcegp.forces.priors.base import NOISE, ForcePrior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.quantities import AffineMap, ForceField, States, linearize_field
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class Noise:
    """Noise of measured accelerations, motor torques and states.

    Args:
        acceleration: standard deviation of measured accelerations [rad/s², m/s²], one or one per joint; by
            default the value in the log (`qdd_std` by sample, else its header), else 0.1.
        learn: whether it is a hyperparameter, starting at this value.
        torque: standard deviation of the motor torque's white noise [N m, N], one or one per joint;
            `"learn"`, `None` for none, or `"auto"`: learned with the priors of measured robots.
        state: standard deviations of the white noise of measured q and q̇ [rad, rad/s], each one number or
            one per joint; `None` for none. It counts to first order (`forces/noise.py`).
        degrees_of_freedom: ν > 2 of a Student t distribution of each sample's noise, such as 4, for logs with
            impacts and other outliers; `None` for Gaussian noise (`forces/noise_learning.py`).
        external: standard deviation of an unknown force on some joints, by name [N m, N]: of a joint without
            a torque sensor, or one that somebody moves by hand. Joints without a logged torque get the size
            of the force that moves them.

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
                    f"the unknown force on joint {joint!r} has no such size",
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
        """The given `Noise`, or one of accelerations alone."""
        return noise if isinstance(noise, cls) else cls(noise)  # pyright: ignore[reportArgumentType]

    @property
    def learns_torque(self) -> bool:
        """Whether the noise of the motor torque is learned."""
        return self.torque == "learn" if isinstance(self.torque, str) else False

    def for_priors(self, priors: Sequence[ForcePrior]) -> Noise:
        """The noise with `torque="auto"` resolved: learned with the priors of measured robots."""
        if not isinstance(self.torque, str) or self.torque != "auto":
            return self
        measured = any(isinstance(prior, JointFrictionPrior | InertialPrior) for prior in priors)
        return dataclasses.replace(self, torque="learn" if measured else None)


TORQUE_NOISE = f"{NOISE}.torque.log_noise_std"
"""Name of the learned noise of the motor torque."""


def initial_torque_noise(residual: Tensor) -> dict[str, Tensor]:
    """Start of learning, from the root mean square of unexplained torque `(nq,)` [N m, N]."""
    std = (0.5 * residual).clamp(min=1e-4).log().double()
    return {
        TORQUE_NOISE: std,
        STICK_NOISE: std.clone(),
        STICK_SPEED: torch.full_like(std, math.log(STICKING)),
    }


def external_std(external: Mapping[str, float] | None, robot: RobotModel) -> Tensor | None:
    """Standard deviation of unknown forces on the joints `(nq,)`; `None` where there are none.

    Raises:
        UnknownNameError: the robot has no such joint.
    """
    for joint in external or {}:
        if joint not in robot.joint_names:
            raise UnknownNameError("joint with an unknown force", joint, robot.joint_names)
    if not external:
        return None
    return robot.mass.new_tensor([external.get(joint, 0.0) for joint in robot.joint_names])


ForceNoise = Callable[[States], Tensor]
"""Variance of the white noise on the joint force at states, `(n, nq)`."""


@dataclass(frozen=True, eq=False)
class SampleNoise:
    """Noise of the samples of one measurement, a sum of independent terms: (diag σ² + Σ_k N_k N_kᵀ)/w.

    Attributes:
        std: σ of each component, `(d,)` or `(n, d)`.
        force: Σ_τ, the variance of the joint force.
        torque: `(n, nq)` standard deviation of single torques beside it.
        state: G Σ_x½ `(n, d, 2 nq)`, factor of the noise of the state.
        weight: w of each sample `(n,)`; `None` for one.
    """

    std: Tensor
    force: ForceNoise | None = None
    state: Tensor | None = None
    weight: Tensor | None = None
    torque: Tensor | None = None

    def factors(self, at: States, z: AffineMap) -> list[Tensor]:
        """The terms N_k `(n, d, ·)` beside σ, at the states of the samples, of the quantity measured."""
        # N = (G Σ_x½, B_Q Σ_τ½)
        terms = [] if self.state is None else [self.state]
        if self.torque is not None:
            terms.append(z.B_Q * self.torque[:, None, :])
        return terms if self.force is None else [*terms, z.B_Q * self.force(at).sqrt()[:, None, :]]

    def covariance(self, at: States, z: AffineMap) -> Tensor:
        """Σ_y + B_Q Σ_τ B_Qᵀ + G Σ_x Gᵀ of each sample `(n, d, d)`, without its weight."""
        white = torch.diag_embed(self.std.square().expand_as(z.o))
        return sum((N @ N.mT for N in self.factors(at, z)), start=white)

    def __getitem__(self, rows: Tensor) -> SampleNoise:
        """The noise of some of the samples."""
        std = self.std if self.std.ndim == 1 else self.std[rows]
        parts = (None if x is None else x[rows] for x in (self.state, self.weight, self.torque))
        return SampleNoise(std, self.force, *parts)


def state_jacobian(
    system: ConstrainedSystem, m: Measurement, force: ForceField | None = None
) -> Tensor | None:
    """G = dz/d(q, q̇) `(n, d, 2 nq)` of measured accelerations or multipliers; `None` for other quantities.

    Args:
        force: all impressed forces; by default those of the robot file and the measured torque.
    """
    if m.quantity not in ("qdd", "multiplier"):
        return None
    if force is None:
        at = system.linearize(m.q, m.qd, m.tau, m.active)
    else:
        at = linearize_field(force, system, m.q, m.qd, m.tau, m.active)
    pair = (at.dq, at.dqd) if m.quantity == "qdd" else (at.multiplier_dq, at.multiplier_dqd)
    return torch.cat(pair, dim=-1)


def learned_slopes(training: Training, system: ConstrainedSystem, force: ForceField) -> Training:
    """Training data with G of a force field at each sample."""
    slopes = tuple(state_jacobian(system, m, force) for m in training.measurements)
    return dataclasses.replace(training, slopes=slopes)


def state_std_of(given: Sequence[NoiseStd] | None, robot: RobotModel) -> Tensor | None:
    """Standard deviation of the noise of q and q̇ as one vector `(2 nq,)`; `None` for none.

    Raises:
        ModelError: these are no two standard deviations, each one number or one per joint, 0 or above.
    """
    if given is None:
        return None
    try:
        std = [torch.as_tensor(x, dtype=robot.dtype, device=robot.device).expand(robot.nq) for x in given]
        valid = len(std) == 2 and all(bool(((x >= 0.0) & torch.isfinite(x)).all()) for x in std)
    except (TypeError, ValueError, RuntimeError):
        valid, std = False, []
    if not valid:
        raise ModelError(
            "the noise of the state is not valid",
            expected=f"two standard deviations, of q and q̇, each one number or {robot.nq}, 0 or above",
            got=given,
        )
    return torch.cat(std)
