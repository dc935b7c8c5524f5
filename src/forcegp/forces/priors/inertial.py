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
import warnings
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ConvergenceWarning, ModelError, check_name
from forcegp.forces.priors.base import JOINT
from forcegp.forces.priors.joint import ConstantForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Constant, Kernel
from forcegp.identification import MASS_SHARE, MOMENT_ARM, PARAMETER_NAMES, regressor
from forcegp.robot.inertia import from_pseudo_inertia, inertial_parameters, pseudo_inertia, pseudo_inertia_of
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
        delay: time by which logged torques precede the motion, identified with the robot [s].
        is_error: whether the robot has the most probable parameters, so that their errors have zero mean.

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
    delay: float = 0.0
    is_error: bool = False

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
        robot, kept = system.robot, at.kept.get(self.name)
        if kept is not None and kept[0] is robot and kept[1] is self:
            return kept[2]
        # Without a measured acceleration, that of the analytical model is used.
        qdd = at.eom.acceleration(at.eom.Q_K + at.tau) if at.qdd is None else at.qdd
        columns = regressor(robot, at.q, at.qd, qdd)
        if self.drives:
            # Cᵀ diag(C q̈)
            drives = robot.joint_torque(torch.diag_embed(robot.drive_motion(qdd))).mT
            columns = torch.cat([columns, drives], dim=-1)
        columns = -columns * self.scale(robot)
        at.kept[self.name] = robot, self, columns
        return columns

    def scale(self, robot: RobotModel) -> Tensor:
        """Return the standard deviations S without learned scales: `(10 nq,)`, or `(11 nq,)` with drives."""
        if self.scales is not None:
            return robot.mass.new_tensor((*self.scales, *self.drives))
        m, J = robot.mass[:, None], inertial_parameters(robot.mass, robot.com, robot.inertia)
        gyration = J[:, [4, 7, 9]].clamp(min=0.0).sqrt()
        row, column = torch.triu_indices(3, 3)
        products = gyration[:, row] * gyration[:, column]
        parts = [self.mass * m, (self.length * m).expand(-1, 3), self.inertia * products]
        return torch.cat([torch.cat(parts, dim=-1).flatten().detach(), m.new_tensor(self.drives)])

    def difference(self, robot: RobotModel, other: RobotModel) -> Tensor:
        """Return the components δ of another robot; 0 where S is zero."""
        links = [inertial_parameters(x.mass, x.com, x.inertia).flatten() for x in (robot, other)]
        change = [links[1] - links[0], *([other.armature - robot.armature] if self.drives else [])]
        scale = self.scale(robot)
        return torch.where(scale > 0.0, torch.cat(change) / scale.clamp(min=1e-300), 0.0)

    def curvature(self, robot: RobotModel, weight: float | None = None) -> Tensor:
        """Return the second derivative of the divergence in `updated` with respect to δ, `(10 nq, 10 nq)`.

        γ ∂²(−log |J|)/∂δ_a ∂δ_b = γ tr(J⁻¹ J_a J⁻¹ J_b), as J is linear in δ; it is 0 for unphysical links.
        """
        J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
        sound = torch.linalg.eigvalsh(J)[:, 0] > 0.0
        J = torch.where(sound[:, None, None], J, torch.eye(4).to(J))
        scale = sound[:, None] * self.scale(robot)[: PER_LINK * robot.nq].view(robot.nq, PER_LINK)
        each = torch.linalg.solve(J[:, None], pseudo_inertia_of(torch.diag_embed(scale)))
        weight = DIVERGENCE if weight is None else weight
        return torch.block_diag(*weight * torch.einsum("kaij,kbji->kab", each, each))

    def updated(
        self,
        robot: RobotModel,
        mean: Tensor,
        precision: Tensor,
        weight: float | None = None,
    ) -> tuple[RobotModel, Tensor]:
        """Return the most probable physically consistent robot given δ ~ N(mean, precision⁻¹).

        The convex objective ½ (δ − mean)ᵀ precision (δ − mean) + γ Σ_k [tr(J₀⁻¹J) − log |J₀⁻¹J| − 4] is
        minimised over the pseudo-inertias J > 0 of the links. If the log does not determine the inertia of a
        link, the second term (the divergence of Lee, Wensing and Park, 2019, with weight γ = 0.01 by default)
        keeps this inertia from vanishing.

        Args:
            robot: robot with the parameters π₀.
            mean: mean of δ `(10 nq,)`.
            precision: precision of δ `(10 nq, 10 nq)`.
            weight: weight γ of the divergence.

        Returns:
            The robot and its error δ `(10 nq,)`. Links that are not physically consistent in the robot file
            remain unchanged.
        """
        J0 = pseudo_inertia(robot.mass, robot.com, robot.inertia).double()
        links = (torch.linalg.eigvalsh(J0)[:, 0] > 0.0).nonzero()[:, 0]
        if not len(links):
            return robot, torch.zeros_like(mean)
        index = (PER_LINK * links[:, None] + torch.arange(PER_LINK).to(links)).flatten()
        P, r, scale = (x[index].double() for x in (precision[:, index], precision @ mean, self.scale(robot)))
        E = pseudo_inertia_of(scale.view(-1, PER_LINK, 1) * torch.eye(PER_LINK).to(scale))

        def robot_of(J: Tensor) -> RobotModel:
            parts = zip(("mass", "com", "inertia"), from_pseudo_inertia(J.to(mean)), strict=True)
            return robot.replace(**{name: getattr(robot, name).index_put((links,), x) for name, x in parts})

        x, J = _most_probable(P, r, J0[links], E, DIVERGENCE if weight is None else weight)
        return robot_of(J), torch.zeros_like(mean).index_put((index,), x.to(mean))


def _change(x: Tensor, E: Tensor) -> Tensor:
    """Return Σ_p x_p E_p of each link, `(k, 4, 4)`, for x `(10 k,)` and E `(k, 10, 4, 4)`."""
    return torch.einsum("kp,kpij->kij", x.view(-1, PER_LINK), E)


def _most_probable(P: Tensor, r: Tensor, J0: Tensor, E: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Minimise ½ xᵀP x − rᵀx + γ Σ_k [tr(J₀⁻¹J) − log |J|] over J = J₀ + Σ_p x_p E_p > 0.

    The logarithm is the barrier of an interior-point method: γ decreases from a value at which x = 0 is close
    to the minimum. Steps of Newton's method are J ← L (1 + Y) Lᵀ with J = L Lᵀ, since the barrier has unit
    curvature at Y = 0. Source: Boyd and Vandenberghe, *Convex Optimization* (2004), section 11.3.
    """
    row, column = torch.triu_indices(4, 4)
    one, D = torch.eye(4).to(J0), torch.zeros(PER_LINK, 4, 4).to(J0)
    D[range(PER_LINK), row, column] = torch.where(row == column, 0.5, 0.5**0.5).to(J0)
    D = D + D.mT  # orthonormal basis of symmetric matrices
    coordinates, inverse = torch.linalg.inv(E[..., row, column].mT), torch.linalg.inv(J0)
    x, J, weight = torch.zeros_like(r), J0, 0.0
    for _ in range(MOST_STEPS):
        L = torch.linalg.cholesky(J)
        moved = L[:, None] @ D @ L[:, None].mT
        T = torch.block_diag(*(coordinates @ moved[..., row, column].mT))
        slope, bend = T.mT @ (P @ x - r), T.mT @ P @ T
        weight = weight or max(least, float(slope.norm()))
        divergence = (inverse[:, None] * moved - D * one).sum((-1, -2)).flatten()
        bend = bend + weight * torch.eye(len(r)).to(r)
        y = -torch.linalg.solve(bend, slope + weight * divergence)
        decrement = float(y @ bend @ y)
        if decrement <= CENTRAL * weight:
            if weight <= least:
                break
            weight = max(least, REDUCED * weight)
            continue
        Y, step = _change(y, D.expand_as(E)), T @ y
        stretch = torch.linalg.eigvalsh(Y)
        share = min(1.0, -INSIDE / float(stretch.min().clamp(max=-INSIDE)))
        while share > LEAST:
            # The divergence changes by tr(J₀⁻¹ΔJ) − log |1 + s Y|.
            barrier = share * (divergence @ y + stretch.sum()) - torch.log1p(share * stretch).sum()
            quadratic = share * step @ (P @ (x + 0.5 * share * step) - r)
            if float(quadratic + weight * barrier) <= -ENOUGH * share * decrement:
                break
            share *= 0.5
        x, J = x + share * step, L @ (one + share * Y) @ L.mT
    else:
        text = "physically consistent links may not be the most probable ones: the search ended after"
        warnings.warn(f"{text} {MOST_STEPS} steps", ConvergenceWarning, stacklevel=3)
    return x, J


DIVERGENCE = 0.01
"""Weight of the divergence, which keeps the inertia of undetermined links from vanishing."""
MOST_STEPS, REDUCED, CENTRAL = 1000, 0.8, 1e-2
"""Maximum number of steps, reduction of γ, and squared Newton decrement over γ below which γ is reduced."""
INSIDE, ENOUGH, LEAST = 0.9, 0.1, 1e-9
"""Largest fraction of the way to an unphysical body in one step, smallest decrease of the objective over that
of its linear model, and smallest fraction of a step."""


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
        rigid: whether the payload also has moments of inertia, as a rigid body. For a point mass at 0.1 m,
            they are as large as those of a wrist.

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
    rigid: bool = False

    def __post_init__(self) -> None:
        if self.rigid and self.kernel == Constant(group=MASS_AND_MOMENT):
            object.__setattr__(self, "kernel", Constant(group=PER_PAYLOAD))
        if self.known and not (len(self.known) == MASS_AND_MOMENT and self.known[0] > 0.0):
            raise ModelError(
                f"force prior {self.name!r} has an invalid known payload",
                expected="a positive mass and three components of its first moment, or nothing",
                got=self.known,
            )

    def outputs(self, robot: RobotModel) -> int:
        return PER_PAYLOAD if self.rigid else MASS_AND_MOMENT

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        qdd = at.qdd
        if qdd is None or not self.measured:
            eom = at.eom
            if self.known:
                eom = system.with_robot(self.loaded(system.robot)).equations(at.q, at.qd, at.active)
            qdd = eom.acceleration(eom.Q_K + at.tau)
        first = PER_PAYLOAD * self.link(system.robot)
        Y = regressor(system.robot, at.q, at.qd, qdd)[..., first : first + self.outputs(system.robot)]
        return -Y * self.units(at.q)

    def around(self, mean: Tensor) -> PayloadPrior:
        """Return the prior linearized at the estimated payload.

        Args:
            mean: mean of the latent constants `(4,)` or `(10,)`. If they do not describe a point mass near
                the link, no payload is assumed.
        """
        mass, *moment = (mean * self.units(mean))[:MASS_AND_MOMENT].tolist()
        near = mass > 0.0 and math.hypot(*moment) <= FARTHEST * self.length * mass
        return dataclasses.replace(self, known=(mass, *moment) if near else ())

    def units(self, like: Tensor) -> Tensor:
        """Return the mass, first moment and, if rigid, inertia per unit of the latent constants."""
        moments = 6 * [self.mass * self.length**2] if self.rigid else []
        return like.new_tensor([self.mass, *3 * [self.mass * self.length], *moments])

    def loaded(self, robot: RobotModel) -> RobotModel:
        """Return the robot with the known payload, if any, as a point mass."""
        if not self.known:
            return robot
        J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
        point = J.new_tensor([*self.known[1:], self.known[0]])
        body = (point.outer(point) / point[3])[None]
        J = J.index_add(0, torch.tensor([self.link(robot)], device=J.device), body)
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
