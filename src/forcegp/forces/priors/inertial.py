"""Gaussian priors on errors of inertial parameters and on a payload, marginalised in closed form.

Inverse dynamics is linear in the inertial parameters π = π₀ + δ, so M₀ q̈ − Q_C,0 − Q_G,0 + Y(q, q̇, q̈) δ =
Q holds exactly at the measured acceleration. The error δ therefore acts like a joint force −Y δ with a
constant latent δ ~ N(0, S²). Least-squares identification with a ridge penalty towards the robot file is a
special case. Predictions use the robot with updated parameters, and the remaining uncertainty enters through
Y at the predicted acceleration. An unknown mass attached to link k is treated in the same way, with the
columns Y_k for the mass and first moment of that link (Atkeson, An, Hollerbach 1986).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, check_name
from forcegp.forces.priors.base import JOINT
from forcegp.forces.priors.joint import ConstantForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Constant, Kernel
from forcegp.gp.optimise import LearningOptions, minimise
from forcegp.identification import MASS_SHARE, MOMENT_ARM, PARAMETER_NAMES, regressor
from forcegp.robot.inertia import (
    from_log_cholesky,
    from_pseudo_inertia,
    inertial_parameters,
    log_cholesky,
    pseudo_inertia,
    pseudo_inertia_of,
)
from forcegp.robot.model import RobotModel

PER_LINK = 10
"""Number of parameters per link: m, m c, and the inertia about the link origin."""


@dataclass(frozen=True)
class InertialPrior(ConstantForcePrior):
    """A prior on errors of inertial parameters, with one learned scale s_k (initially 1) per link k.

    Q = −[Y(q, q̇, q̈), diag q̈] S δ with δ ~ N(0, diag(s_k²)). If `drives` is not given, Q = −Y S δ.

    Args:
        mass: relative standard deviation of each link's mass.
        length: standard deviation of the first moment divided by the mass [m].
        inertia: relative standard deviation of the moments of inertia of each link, and standard deviation of
            the products of inertia I_ab divided by √(I_aa I_bb).
        kernel: covariance of the constants.
        name: prefix of the hyperparameters.
        scales: scales S `(10 nq,)`; computed from the robot by default.
        drives: standard deviation of the drive inertia of each joint [kg m², kg]; by default, all are known.
        per_gain: change of the identified parameters of links, then drives, per relative error of the gain of
            each torque sensor, `11 nq` rows of `nq`; empty if the robot was not identified from torques.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> InertialPrior().outputs(robot)
        20
    """

    mass: float = MASS_SHARE
    length: float = MOMENT_ARM
    inertia: float = 0.15
    kernel: Kernel = field(default_factory=lambda: Constant(group=PER_LINK))
    name: str = "inertial"
    target: str = JOINT
    scales: tuple[float, ...] | None = None
    drives: tuple[float, ...] = ()
    per_gain: tuple[tuple[float, ...], ...] = ()

    def around(self, robot: RobotModel) -> InertialPrior:
        """Return the prior with its scales S fixed to those of the given robot."""
        return dataclasses.replace(self, scales=tuple(self.scale(robot)[: PER_LINK * robot.nq].tolist()))

    def with_drives(self, std: Tensor) -> InertialPrior:
        """Return the prior with uncertain drive inertia, given the standard deviation of each joint `(nq,)`.

        Drive inertia and link inertia have similar effects on the motion. If drive inertia were treated as
        known, its errors would be attributed to the links, with too small a standard deviation.
        """
        return dataclasses.replace(self, drives=tuple(std.tolist()), kernel=Constant())

    def outputs(self, robot: RobotModel) -> int:
        return PER_LINK * robot.nq + len(self.drives)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        # Without a measured acceleration, that of the analytical model is used.
        qdd = at.qdd
        if qdd is None:
            qdd = at.eom.acceleration(at.eom.Q_K + at.tau)
        columns = regressor(system.robot, at.q, at.qd, qdd)
        if self.drives:
            columns = torch.cat([columns, torch.diag_embed(qdd)], dim=-1)
        return -columns * self.scale(system.robot)

    def scale(self, robot: RobotModel) -> Tensor:
        """Return the standard deviations S without learned scales: `(10 nq,)`, or `(11 nq,)` with drives."""
        if self.scales is not None:
            return robot.mass.new_tensor((*self.scales, *self.drives))
        m, J = robot.mass[:, None], inertial_parameters(robot.mass, robot.com, robot.inertia)
        gyration = J[:, [4, 7, 9]].clamp(min=0.0).sqrt()
        products = [
            gyration[:, a] * gyration[:, b] for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        ]
        parts = [self.mass * m, (self.length * m).expand(-1, 3), self.inertia * torch.stack(products, dim=-1)]
        return torch.cat([torch.cat(parts, dim=-1).flatten().detach(), m.new_tensor(self.drives)])

    def curvature(self, robot: RobotModel) -> Tensor:
        """Return the second derivative of the divergence in `updated` with respect to δ, `(10 nq, 10 nq)`.

        γ ∂²(−log |J|)/∂δ_a ∂δ_b = γ tr(J⁻¹ J_a J⁻¹ J_b), as J is linear in δ; it is 0 for unphysical links.
        """
        J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
        sound = torch.linalg.eigvalsh(J)[:, 0] > 0.0
        J = torch.where(sound[:, None, None], J, torch.eye(4).to(J))
        scale = sound[:, None] * self.scale(robot)[: PER_LINK * robot.nq].view(robot.nq, PER_LINK)
        each = torch.linalg.solve(J[:, None], pseudo_inertia_of(torch.diag_embed(scale)))
        return torch.block_diag(*DIVERGENCE * torch.einsum("kaij,kbji->kab", each, each))

    def updated(
        self,
        robot: RobotModel,
        mean: Tensor,
        precision: Tensor,
        log_volume: Callable[[RobotModel], Tensor] = lambda _: torch.zeros(()),
    ) -> tuple[RobotModel, Tensor]:
        """Return the most probable physically consistent robot given δ ~ N(mean, precision⁻¹).

        The objective ½ (δ − mean)ᵀ precision (δ − mean) + γ Σ_k [tr(J₀⁻¹J) − log |J₀⁻¹J| − 4] − V(δ) is
        minimised over the log-Cholesky coordinates of the pseudo-inertias J of the links. If the log does not
        determine the inertia of a link, the second term (the divergence of Lee, Wensing and Park, 2019, with
        weight γ = 0.01) keeps this inertia from vanishing.

        Args:
            robot: robot with the parameters π₀.
            mean: mean of δ `(10 nq,)`.
            precision: precision of δ `(10 nq, 10 nq)`.
            log_volume: function V that converts the density of torques to that of accelerations.

        Returns:
            The robot and its error δ `(10 nq,)`. Links that are not physically consistent in the robot file
            remain unchanged.
        """
        J0 = pseudo_inertia(robot.mass, robot.com, robot.inertia)
        sound = torch.linalg.eigvalsh(J0)[:, 0] > 0.0
        pi0 = inertial_parameters(robot.mass, robot.com, robot.inertia)
        scale = self.scale(robot).unflatten(0, (robot.nq, PER_LINK))
        inverse = torch.linalg.inv(J0[sound])

        rows = (sound.nonzero()[:, 0],)

        def delta_of(x: Tensor) -> Tensor:
            # δ = (π − π₀)/s
            bodies = from_pseudo_inertia(from_log_cholesky(x))
            pi = torch.zeros_like(pi0).index_put(rows, inertial_parameters(*bodies))
            return torch.where(sound[:, None], (pi - pi0) / scale, 0.0).flatten()

        def robot_of(x: Tensor) -> RobotModel:
            mass, com, inertia = from_pseudo_inertia(from_log_cholesky(x))
            return robot.replace(
                mass=robot.mass.index_put(rows, mass),
                com=robot.com.index_put(rows, com),
                inertia=robot.inertia.index_put(rows, inertia),
            )

        def objective(tensors: dict[str, Tensor]) -> Tensor:
            # ½ (δ − mean)ᵀ precision (δ − mean) + γ Σ_k [tr(J₀⁻¹J) − log |J| + const] − V(δ)
            x = tensors["x"]
            error = delta_of(x) - mean
            ratio = inverse @ from_log_cholesky(x)
            log_det = 8.0 * x[:, 0] + 2.0 * x[:, 1:4].sum(-1)
            divergence = ratio.diagonal(dim1=-2, dim2=-1).sum(-1) - log_det
            fit = 0.5 * error @ (precision @ error) + DIVERGENCE * divergence.sum()
            return fit - log_volume(robot_of(x))

        if not bool(sound.any()):
            return robot, torch.zeros_like(mean)
        with torch.enable_grad():
            theta = minimise(objective, {"x": log_cholesky(J0[sound])}, CONSISTENT).tensors["x"]
        return robot_of(theta), delta_of(theta).detach()


DIVERGENCE = 0.01
"""Weight of the divergence, which keeps the inertia of undetermined links from vanishing."""
CONSISTENT = LearningOptions(tolerance=1e-12, max_evaluations=500)
"""Options of the search for the physically consistent robot."""


PER_PAYLOAD = len(PARAMETER_NAMES)
MASS_AND_MOMENT = 4
"""Number of entries for the mass and first moment, which gravity determines without bias due to noisy q̈."""
FARTHEST = 3.0
"""Largest distance of a point mass from the origin of the link, in units of `length`."""


@dataclass(frozen=True)
class PayloadPrior(ConstantForcePrior):
    """A prior on a point mass attached to a link, Q = −Y_k(q, q̇, q̈) S δ with δ ~ N(0, s² I).

    q̈ is the acceleration of the arm with the payload `known` (by default, no payload). The force is exact
    for this payload and accurate to first order for others. `around` linearizes at the current estimate.

    With `update` and `forget`, a model tracks a payload that is picked up or put down. Fitting to a log
    without a payload would set the scale s to zero. To keep it, list the other priors: `model.fit(data,
    learn=["joint"])`.

    Args:
        joint: joint that moves the link with the payload; defaults to the last joint.
        mass: standard deviation of the mass [kg].
        length: ratio of the standard deviations of the first moment and the mass [m].
        kernel: covariance of the constants.
        name: prefix of the hyperparameters.
        known: mass [kg] and first moment [kg m] of the payload with which the acceleration is computed.
        measured: whether to use the measured acceleration, if available. The force is then exact for any
            payload, but noise biases the estimate towards zero if the accelerations are small.

    Raises:
        ModelError: `known` does not consist of a mass and a first moment.
    """

    joint: str | None = None
    mass: float = 1.0
    length: float = 0.1
    kernel: Kernel = field(default_factory=lambda: Constant(group=MASS_AND_MOMENT))
    name: str = "payload"
    target: str = JOINT
    known: tuple[float, ...] = ()
    measured: bool = False

    def __post_init__(self) -> None:
        if self.known and not (len(self.known) == MASS_AND_MOMENT and self.known[0] > 0.0):
            raise ModelError(
                f"force prior {self.name!r} has an invalid known payload",
                expected="a positive mass and three components of its first moment, or nothing",
                got=self.known,
            )

    def outputs(self, robot: RobotModel) -> int:
        return MASS_AND_MOMENT

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        qdd = at.qdd
        if qdd is None or not self.measured:
            eom = at.eom
            if self.known:
                eom = system.with_robot(self.loaded(system.robot)).equations(at.q, at.qd, at.active)
            qdd = eom.acceleration(eom.Q_K + at.tau)
        first = PER_PAYLOAD * self.link(system.robot)
        Y = regressor(system.robot, at.q, at.qd, qdd)[..., first : first + MASS_AND_MOMENT]
        return -Y * self.units(at.q)

    def around(self, mean: Tensor) -> PayloadPrior:
        """Return the prior linearized at the estimated payload.

        Args:
            mean: mean of the latent constants `(4,)`. If they do not describe a point mass near the link, no
                payload is assumed.
        """
        mass, *moment = (mean * self.units(mean)).tolist()
        near = mass > 0.0 and math.hypot(*moment) <= FARTHEST * self.length * mass
        return dataclasses.replace(self, known=(mass, *moment) if near else ())

    def units(self, like: Tensor) -> Tensor:
        """Return the mass and first moment `(4,)` per unit of the latent constants."""
        return like.new_tensor([self.mass, *3 * [self.mass * self.length]])

    def loaded(self, robot: RobotModel) -> RobotModel:
        """Return the robot with the known payload, if any, as a point mass."""
        if not self.known:
            return robot
        J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
        point = J.new_tensor([*self.known[1:], self.known[0]])
        J = J.index_add(
            0, torch.tensor([self.link(robot)], device=J.device), (point.outer(point) / point[3])[None]
        )
        mass, com, inertia = from_pseudo_inertia(J)
        return robot.replace(mass=mass, com=com, inertia=inertia)

    def check(self, system: ConstrainedSystem) -> None:
        self.link(system.robot)

    def link(self, robot: RobotModel) -> int:
        """Return the index of the joint that moves the link with the payload."""
        if self.joint is None:
            return robot.nq - 1
        check_name("joint that carries a payload", self.joint, robot.joint_names)
        return robot.joint_names.index(self.joint)
