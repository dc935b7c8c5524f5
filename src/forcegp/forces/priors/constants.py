"""Priors on drive constants, and priors on constants that differ between recordings."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.priors.base import JOINT, ForcePrior
from forcegp.forces.priors.joint import ConstantForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Constant, Kernel
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
class PerRecording(ForcePrior):
    """A prior on constants that differ between recordings, such as a payload.

    All other priors are common to the recordings, so a fit to several recordings learns friction from all of
    them. Predictions use the constants of the last recording.

    Args:
        prior: prior on the force in each recording; it also provides the names of the hyperparameters.
        starts: first segment of each recording, as in `Dataset.segment`.

    Example:
        >>> import forcegp
        >>> prior = PerRecording(forcegp.PayloadPrior(measured=True), starts=(0, 1))
        >>> prior.outputs(forcegp.load_robot("ur5"))
        8

    Raises:
        ModelError: `starts` is not increasing, or `prior` is not a prior on constants.
    """

    prior: ForcePrior
    starts: tuple[int, ...]
    name: str = field(init=False)
    kernel: Kernel = field(init=False)
    target: str = field(init=False)

    def __post_init__(self) -> None:
        if not self.starts or list(self.starts) != sorted(set(self.starts)):
            raise ModelError("recordings need ascending first segments", expected="(0, 1)", got=self.starts)
        if not isinstance(self.prior.kernel, Constant):
            raise ModelError(
                f"force prior {self.prior.name!r} is not a prior on constants",
                expected="a prior with a Constant kernel, such as PayloadPrior()",
                got=type(self.prior.kernel).__name__,
            )
        for name in ("name", "kernel", "target"):
            object.__setattr__(self, name, getattr(self.prior, name))

    def outputs(self, robot: RobotModel) -> int:
        return len(self.starts) * self.prior.outputs(robot)

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return self.prior.features(system, at)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        recording = torch.full((len(at.q),), len(self.starts) - 1, device=at.q.device)
        if at.time is not None:
            starts, segment = torch.tensor(self.starts, device=at.q.device), at.time[:, 1].long()
            recording = (segment[:, None] >= starts).sum(-1).sub(1).clamp(min=0)
        mine = torch.nn.functional.one_hot(recording, len(self.starts)).to(at.q)
        return (mine[:, None, :, None] * self.prior.operator(system, at)[:, :, None]).flatten(2)

    def check(self, system: ConstrainedSystem) -> None:
        self.prior.check(system)
