"""The noise of what a log measures, as a model states it: accelerations, motor torques, and the state."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from forcegp.errors import ModelError
from forcegp.forces.observations import NoiseStd
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint_friction import JointFrictionPrior


@dataclass(frozen=True)
class Noise:
    """Noise of measured accelerations, motor torques and states.

    Args:
        acceleration: standard deviation of measured accelerations [rad/s², m/s²], one or one per joint; by
            default what the log states (`qdd_std` by sample, else its header), else 0.1.
        learn: whether it is a hyperparameter, which starts there.
        torque: standard deviation of the motor torque's white noise [N m, N], one or one per joint;
            `"learn"`, `None` for none, or `"auto"`: learned with the priors of measured robots.
        state: standard deviations of the white noise of measured q and q̇ [rad, rad/s], each one number or
            one per joint; `None` for none. It counts to first order (`forces/state_noise.py`).
        degrees_of_freedom: ν > 2 of a Student t distribution of each sample's noise, such as 4, for logs with
            impacts and other outliers; `None` for Gaussian noise (`forces/student_t.py`).

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

    def __post_init__(self) -> None:
        torque, nu = self.torque, self.degrees_of_freedom
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
        """A noise as given, or that of accelerations alone."""
        return noise if isinstance(noise, cls) else cls(noise)  # pyright: ignore[reportArgumentType]

    @property
    def learns_torque(self) -> bool:
        """Whether the noise of the motor torque is learned."""
        return self.torque == "learn" if isinstance(self.torque, str) else False

    def for_priors(self, priors: Sequence[ForcePrior]) -> Noise:
        """The noise with that of the torque learned beside priors of measured robots, if it was left open."""
        if not isinstance(self.torque, str) or self.torque != "auto":
            return self
        measured = any(isinstance(prior, JointFrictionPrior | InertialPrior) for prior in priors)
        return dataclasses.replace(self, torque="learn" if measured else None)
