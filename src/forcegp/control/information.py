"""Information that a motion provides about the unknown forces of a robot.

The torque is linear in the unknowns, τ = τ₀ + Φ(q, q̇, q̈) θ with θ ~ N(0, U Uᵀ). The unknowns are the base
parameters of the links, the functions of each joint, drive inertia if a fit has learned it, and the delay s
of the torque, τ(t + s) ≈ τ + s dτ/dt. Each joint has a function of its speed (viscous friction, dry friction,
a deviation at low speed and Gaussian bumps) and a function of its position (bumps). After a motion x with
torque noise Σ,

    Cov θ = U (1 + Uᵀ G U)⁻¹ Uᵀ,    G = Σ_i Φ(x_i)ᵀ Σ⁻¹ Φ(x_i),

The sum extends over independent samples i. Criterion `A` is the geometric mean over joints of the standard
deviation of the torque in a region, and `D` is the entropy of θ. Criterion `V` is the same as `A` for least
squares, which fit links, viscous and dry friction and are biased by all other unknowns. Sources: Swevers et
al., *Optimal robot excitation and identification* (IEEE T-RA 1997); Pukelsheim, *Optimal Design of
Experiments* (1993); Box and Draper, *A basis for the selection of a response surface design* (JASA 1959).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from forcegp.dynamics import damping_force
from forcegp.errors import ParameterError
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.identification import BaseParameters, base_parameters, parameter_vector, regressor
from forcegp.robot.model import RobotModel

LOOK = 0.1
"""Time after which torque errors are independent [s]."""
NOISE = 0.01
"""Standard deviation of torque noise, relative to the RMS torque in the region."""
FRICTION, BUMP = 0.1, 0.03
"""Prior standard deviations of friction and of every other function, relative to the same torque."""
SLOW = 0.1
"""Speed at which the deviation at low speed is largest, relative to the maximum speed of a joint."""
DELAY = 0.002
"""Prior standard deviation of the delay: half a period of a controller that acts every 4 ms [s]."""
SPEEDS, PLACES = 7, 5
"""Number of bumps over the range of speeds, and over the range of positions, of a joint."""
DRY = 0.02
"""Speed scale on which dry friction changes sign, relative to the maximum speed of a joint."""

States = tuple[Tensor, Tensor, Tensor]
"""Positions, velocities and accelerations, each `(n, nq)`."""
Criterion = Callable[[Tensor, "Unknowns"], Tensor]
"""Objective to minimise, as a function of the information matrix G `(p, p)` of a motion and the unknowns."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknown forces of a robot before a motion.

    Attributes:
        robot: the robot that defines the kinematics, gravity, the drives, and the prior mean of the links.
        base: the combinations of inertial parameters that affect the motion.
        low, high, fastest: range of positions and largest speeds over which the functions extend, `(nq,)`.
        region: states at which the torque is to be predicted, `(m, nq)`.
        noise: standard deviation of the noise in a torque sample, `(nq,)` [N m, N].
        root: matrix U `(p, p)`, where U Uᵀ is the covariance of θ before the motion.
    """

    robot: RobotModel
    base: BaseParameters
    low: Tensor
    high: Tensor
    fastest: Tensor
    region: States
    noise: Tensor
    root: Tensor

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        low: Tensor,
        high: Tensor,
        fastest: Tensor,
        region: States,
        noise: Tensor | None = None,
    ) -> Unknowns:
        """Return the unknown forces of a robot before any data were recorded.

        Args:
            robot: the robot from the file.
            low, high, fastest, region: see the attributes.
            noise: torque noise. The default is 1 % of each joint's RMS torque in the region, at least 0.1 %
                of the largest.

        Raises:
            ParameterError: the region is empty.
        """
        robot.check_own_drives("the plan of a motion")
        if not len(region[0]):
            raise ParameterError("the region has no states", expected="one state or more", got="none")
        torque = rigid_torque(robot, *region).square().mean(0).sqrt()
        torque = torch.maximum(torque, 0.1 * torque.max()).clamp(min=1e-9)
        functions = torque.new_tensor([FRICTION] * 2 + [BUMP] * (1 + SPEEDS + PLACES))
        base = base_parameters(robot)
        # β = B π
        B = torch.from_numpy(base.combination) * InertialPrior().scale(robot)
        links = torch.linalg.cholesky(B @ B.mT)
        friction, drives = (torque[:, None] * functions).flatten().diag(), torch.zeros_like(torque).diag()
        root = torch.block_diag(links, friction, drives, torque.new_tensor([[DELAY]]))
        noise = NOISE * torque if noise is None else noise
        return cls(robot, base, low, high, fastest, region, noise, root)

    @property
    def parts(self) -> dict[str, slice]:
        """Positions of links, joint functions and drives in θ. The delay is last."""
        links, last = self.base.rank, len(self.root) - 1
        drives = last - self.robot.nq
        return {"links": slice(0, links), "friction": slice(links, drives), "drives": slice(drives, last)}

    def basis(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the functions of each joint `(n, nq, k)`, in the order given above."""
        u, place = qd / self.fastest, 2.0 * (q - self.low) / (self.high - self.low) - 1.0
        slow = u / SLOW
        bumps = [
            torch.exp(-0.5 * ((x[..., None] - torch.linspace(-1.0, 1.0, k).to(x)) * (k - 1) / 2.0) ** 2)
            for x, k in ((u, SPEEDS), (place, PLACES))
        ]
        smooth = torch.stack([u, torch.tanh(u / DRY), slow * torch.exp(0.5 - 0.5 * slow.square())], dim=-1)
        return torch.cat([smooth, *bumps], dim=-1)

    def columns(self, q: Tensor, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the regressor Y of the links, and Φ `(n, nq, p)` for all parameters, at states `(n, nq)`.

        The column for the delay is zero, since states alone do not determine the rate of the torque.
        """
        Y = regressor(self.robot, q, qd, qdd)
        functions = torch.diag_embed(self.basis(q, qd).movedim(-1, 1)).movedim(1, -1)
        links, delay = Y[..., list(self.base.columns)], torch.zeros_like(q[..., None])
        return Y, torch.cat([links, functions.flatten(-2), torch.diag_embed(qdd), delay], dim=-1)

    def information(self, Phi: Tensor, seconds: float, rate: Tensor | None = None) -> Tensor:
        """Return the information matrix G `(p, p)` of a motion.

        Args:
            Phi: Φ at states along the motion.
            seconds: duration of the motion.
            rate: time derivative of the torque at these states `(n, nq)`; zero by default.
        """
        if rate is not None:
            Phi = torch.cat([Phi[..., :-1], rate[..., None]], dim=-1)
        A = (Phi / self.noise[:, None]).flatten(0, 1)
        return A.mT @ A * (seconds / LOOK / len(Phi))

    @cached_property
    def wanted(self) -> Tensor:
        """Mean of φᵀφ over the region `(nq, p, p)`, where φ is the row of Φ for a joint."""
        Phi = self.columns(*self.region)[1].movedim(1, 0)
        return Phi.mT @ Phi / Phi.shape[1]

    def covariance_root(self, G: Tensor) -> Tensor:
        """Return R such that R Rᵀ is the covariance of θ after a motion with information G."""
        eye = torch.eye(self.root.shape[1], dtype=G.dtype)
        L = torch.linalg.cholesky(eye + self.root.mT @ G @ self.root)
        return torch.linalg.solve_triangular(L, self.root.mT, upper=False).mT

    def of_least_squares(self) -> Unknowns:
        """Return the unknowns with viscous and dry friction as the only functions, and without a delay."""
        known = torch.ones_like(self.root[:, 0])
        known[-1] = 0.0
        functions = known[self.parts["friction"]].view(self.robot.nq, -1)
        functions[:, 2:] = 0.0
        return replace(self, root=known[:, None] * self.root)

    def after(self, G: Tensor) -> Unknowns:
        """Return the remaining unknowns after a motion with information G."""
        return replace(self, root=self.covariance_root(G))

    def torque_std(self) -> Mapping[str, Tensor]:
        """Return the RMS of the torque standard deviation over the region, `(nq,)` [N m, N].

        The keys are `all` for all parameters, and `links`, `friction` and `drives` for each group alone.
        """
        Phi = self.columns(*self.region)[1]
        parts = {"all": slice(None), **self.parts}
        spread = {name: Phi[..., part] @ self.root[part] for name, part in parts.items()}
        return {name: x.square().sum(-1).mean(0).sqrt() for name, x in spread.items()}


def rigid_torque(robot: RobotModel, q: Tensor, qd: Tensor, qdd: Tensor, Y: Tensor | None = None) -> Tensor:
    """Return the torque that a motion requires, Y π + armature q̈ − Q_D, `(n, nq)` [N m, N]."""
    Y = regressor(robot, q, qd, qdd) if Y is None else Y
    return Y @ parameter_vector(robot) + qdd @ robot.drive_inertia - damping_force(robot, qd)


def a_optimal(G: Tensor, unknowns: Unknowns) -> Tensor:
    """Return the log of the RMS torque standard deviation over the region, averaged over the joints."""
    return _log_std(unknowns.covariance_root(G), unknowns)


def v_optimal(G: Tensor, unknowns: Unknowns) -> Tensor:
    """Return `a_optimal` for least squares, whose error has covariance C + C G U_g U_gᵀ G C.

    C is the covariance if the other unknowns, with covariance U_g U_gᵀ, were zero. They bias the estimate.
    """
    fitted = unknowns.of_least_squares()
    R = fitted.covariance_root(G)
    bias = R @ (R.mT @ (G @ (unknowns.root - fitted.root)))
    return _log_std(torch.cat([R, bias], dim=-1), unknowns)


def _log_std(R: Tensor, unknowns: Unknowns) -> Tensor:
    return 0.5 * (R * (unknowns.wanted @ R)).sum((-2, -1)).log().mean()


def d_optimal(G: Tensor, unknowns: Unknowns) -> Tensor:
    """Return ½ log det Cov θ relative to the prior, per parameter."""
    eye = torch.eye(unknowns.root.shape[1], dtype=G.dtype)
    return -0.5 * torch.logdet(eye + unknowns.root.mT @ G @ unknowns.root) / len(eye)


CRITERIA: dict[str, Criterion] = {"A": a_optimal, "V": v_optimal, "D": d_optimal}
