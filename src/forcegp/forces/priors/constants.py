"""Priors on drive constants, and priors on constants that differ between recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data.fields import recording_number
from forcegp.errors import ModelError
from forcegp.forces.priors.base import JOINT, ForcePrior
from forcegp.forces.priors.joint import OFFSET, ConstantForcePrior
from forcegp.forces.quantities import States
from forcegp.forces.term import FORCE, Array, JointState, JointTerm, Units, constants
from forcegp.gp.kernels import Columns, Constant, Kernel
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class DrivePrior(ConstantForcePrior):
    """A prior on relative errors s δ_i of drive constants (torque constant times gear ratio).

    Q_i = s τ_i δ_i with δ_i ~ N(0, 1). Logged currents are converted to torques with nominal drive constants
    (`torque_constant` and `gear_ratio` in a mapping). The true constants are 1 + s δ_i times the nominal
    ones. Since motion depends only on the ratio of drive constants to inertia, specify known masses or record
    a log with a known payload.

    Args:
        std: relative standard deviation s of the drive constants.
        spread: standard deviation of each s δ_i over blocks of the log, if it was identified together with
            the inertia.
        is_error: whether the robot has the most probable scales, so that their errors have zero mean.
        nominal: nominal torque of each joint per current [N m/A, N/A], if known.
        kernel: covariance of δ.
        name: prefix of the hyperparameters.

    Example:
        >>> import forcegp
        >>> DrivePrior().outputs(forcegp.load_robot("ur5"))
        6

    Raises:
        ModelError: the standard deviation is not positive.
    """

    is_stated = True

    std: float = 0.2
    kernel: Kernel = field(default_factory=Constant)
    name: str = "drives"
    target: str = JOINT
    spread: tuple[float, ...] = ()
    is_error: bool = False
    nominal: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.std > 0.0:
            raise ModelError(
                f"force prior {self.name!r} has an invalid standard deviation",
                expected="a positive number",
                got=self.std,
            )

    def outputs(self, robot: RobotModel) -> int:
        return robot.nq

    def stated(self, initial: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: torch.zeros_like(value) for name, value in initial.items()}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        robot, tau = system.robot, at.tau
        if self.is_error and at.qdd is not None:
            # Noise of τ favours δ = −1 / s, where nothing of it is left. In contact, τ carries a force too.
            model = (at.eom.M @ at.qdd[..., None])[..., 0] - at.eom.Q_K
            tau = torch.where(at.active.any(-1, keepdim=True), tau, model)
        return self.std * robot.joint_torque(torch.diag_embed(robot.drive_torque(tau))).mT


@dataclass(frozen=True)
class OffsetPrior(JointTerm):
    """A prior on offsets of each torque that differ between recordings, such as those of a torque sensor.

    Q_i = o_ir in recording r, with o_ir ~ N(0, s_i²). The evidence determines s_i from all recordings. In a
    recording that is not in the training data, o_i is unknown, with the standard deviation s_i. If a fit is
    updated with such a recording, o_i is that of this recording.

    Args:
        recordings: names of the recordings, as in `Dataset.recordings`.
        moves: whether each joint moves both ways in each recording; by default, all do. Otherwise, an offset
            cannot be separated from friction. A joint that does so in fewer than two recordings has none.
        kernel: covariance of each component.
        name: prefix of the hyperparameters.

    Example:
        >>> OffsetPrior(recordings=("monday", "tuesday")).name
        'recordings'
    """

    recordings: tuple[str, ...] = ()
    moves: tuple[tuple[bool, ...], ...] = ()
    kernel: Kernel = field(default_factory=lambda: Columns(ard=False))
    name: str = "recordings"

    sticks = False
    scaled = False
    units: ClassVar[Units] = {"offset": FORCE}

    def columns(self, x: JointState) -> dict[str, Array]:
        every, zero = np.array(self.separable, dtype=float), x.qd * 0.0
        moves = [*(self.moves or [every] * len(self.recordings)), every]
        each = zip((*self.recordings, ""), shares(self.recordings, x.recording), moves, strict=True)
        return {
            f"offset_{name}" if name else "offset": (zero + share) * constants(x.qd, every * moving)
            for name, share, moving in each
        }

    @property
    def separable(self) -> list[bool]:
        """Whether each joint has offsets."""
        return [sum(column) > 1 for column in zip(*self.moves, strict=True)] or [True]

    def stated(self, initial: dict[str, Tensor]) -> dict[str, Tensor]:
        log_scale = math.log(OFFSET) + 0.5 * math.log(1 + len(self.recordings))
        return {name: value + log_scale for name, value in initial.items()}


def shares(
    recordings: Sequence[str], numbers: Tensor | None, reference: str | None = None
) -> Sequence[Tensor | float]:
    """Return for each recording whether it is that of each state, and whether none of them is.

    Args:
        recordings: names of the recordings.
        numbers: numbers of the recordings of the states `(n, 1)`, or `None` if they are unknown.
        reference: name of a further recording, in which all shares are zero.
    """
    if numbers is None:
        return [*(0.0 for _ in recordings), 1.0]
    known = recordings if reference is None else (*recordings, reference)
    matches = [(numbers == recording_number(name)).double() for name in known]
    return [*matches[: len(recordings)], 1.0 - sum(matches)]


@dataclass(frozen=True)
class PerRecording(ForcePrior):
    """A prior on constants that differ between recordings, such as a payload.

    All other priors are common to the recordings, so a fit to several recordings learns friction from all of
    them. The constants of all recordings have common scales. In a recording that is not in the training data,
    the constants are unknown.

    Args:
        prior: prior on the force in each recording; it also provides the names of the hyperparameters.
        recordings: names of the recordings, as in `Dataset.recordings`.
        reference: name of a further recording, in which the constants are zero. Those of the others are then
            differences from it.
        spread: standard deviations of the constants of each recording over blocks of the log [SI units], if
            they were identified together with the inertia.

    Example:
        >>> import forcegp
        >>> prior = PerRecording(forcegp.priors.PayloadPrior(measured=True), ("monday", "tuesday"))
        >>> prior.outputs(forcegp.load_robot("ur5"))
        12

    Raises:
        ModelError: a recording is named twice, or `prior` is not a prior on constants.
    """

    prior: ForcePrior
    recordings: tuple[str, ...]
    reference: str | None = None
    spread: tuple[tuple[float, ...], ...] = ()
    name: str = field(init=False)
    kernel: Kernel = field(init=False)
    target: str = field(init=False)

    def __post_init__(self) -> None:
        names = self.recordings if self.reference is None else (self.reference, *self.recordings)
        if not self.recordings or len(set(names)) < len(names):
            raise ModelError("recordings need distinct names", expected="one or more", got=names)
        if not isinstance(self.prior.kernel, Constant):
            raise ModelError(
                f"force prior {self.prior.name!r} is not a prior on constants",
                expected="a prior with a Constant kernel, such as PayloadPrior()",
                got=type(self.prior.kernel).__name__,
            )
        for name in ("name", "target"):
            object.__setattr__(self, name, getattr(self.prior, name))
        places = len(self.recordings) + 1
        object.__setattr__(self, "kernel", Constant(group=places * self.prior.kernel.group))

    def outputs(self, robot: RobotModel) -> int:
        return (len(self.recordings) + 1) * self.prior.outputs(robot)

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return self.prior.features(system, at)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        E = self.prior.operator(system, at)
        each = shares(self.recordings, at.recording, self.reference)
        mine = torch.cat([torch.as_tensor(x).to(E).expand(len(E), 1) for x in each], dim=-1)
        return (E[..., None] * mine[:, None, None]).flatten(2)

    def check(self, system: ConstrainedSystem) -> None:
        self.prior.check(system)
