"""A Gaussian prior on the errors of the robot file's inertial parameters, marginalised in closed form.

Inverse dynamics is linear in the inertial parameters π: with π = π₀ + δ, M₀ q̈ − Q_C,0 − Q_G,0 + Y(q, q̇, q̈) δ = Q
is an identity at the measured acceleration. So δ acts like a joint force −Y δ with a constant latent δ ~ N(0, S²),
and least-squares identification with a ridge towards the file is a special case. A prediction takes the robot with
the updated parameters; what remains uncertain acts through Y at the predicted acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.priors.base import JOINT, ForcePrior
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Constant, Kernel
from forcegp.identification import regressor
from forcegp.robot.inertia import inertial_parameters
from forcegp.robot.model import RobotModel

PER_LINK = 10
"""m, m c and the inertia about the link origin."""


@dataclass(frozen=True)
class InertialPrior(ForcePrior):
    """Q = −Y(q, q̇, q̈) S δ, δ ~ N(0, diag(s_k²)): one learned scale s_k per link k, 1 at the start.

    Args:
        mass: relative standard deviation of each link's mass.
        length: standard deviation of the first moment over the mass, and radius of gyration of the error of the
            inertia [m].
        kernel: covariance of the constants.
        name: prefix of the hyperparameters.
    """

    mass: float = 0.3
    length: float = 0.1
    kernel: Kernel = field(default_factory=lambda: Constant(group=PER_LINK))
    name: str = "inertial"
    target: str = JOINT

    def outputs(self, robot: RobotModel) -> int:
        return PER_LINK * robot.nq

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return {"one": torch.zeros_like(at.q[:, :1])}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        # A state without a measured acceleration has the one that the analytical model predicts.
        qdd = at.qdd
        if qdd is None:
            qdd = at.eom.acceleration(at.eom.Q_K + at.tau)
        return -regressor(system.robot, at.q, at.qd, qdd) * self.scale(system.robot)

    def scale(self, robot: RobotModel) -> Tensor:
        """S `(10 nq,)`: standard deviations of π before a link's scale is learned."""
        m, r = robot.mass, self.length
        parts = [self.mass * m, *3 * [m * r], *6 * [m * r * r]]
        return torch.stack(parts, dim=-1).flatten().detach()

    def updated(self, robot: RobotModel, latent: Tensor) -> tuple[RobotModel, Tensor]:
        """The robot at π₀ + S δ, moved no further than where every link stays physically consistent.

        Args:
            robot: with π₀.
            latent: δ `(10 nq,)`.

        Returns:
            The robot, and the δ that it contains `(10 nq,)`.
        """
        pi = inertial_parameters(robot.mass, robot.com, robot.inertia)
        step = (self.scale(robot) * latent).unflatten(0, (robot.nq, PER_LINK))
        kept = torch.stack([_consistent_share(p, d) for p, d in zip(pi, step, strict=True)])
        mass, com, inertia = _bodies(pi + kept[:, None] * step)
        share = kept.repeat_interleave(PER_LINK)
        return robot.replace(mass=mass, com=com, inertia=inertia), share * latent


MARGIN = 1e-6
"""Smallest eigenvalue of a pseudo-inertia, relative to its trace, that counts as consistent."""
HALVINGS = 30


def _consistent_share(pi: Tensor, step: Tensor) -> Tensor:
    """Largest share 2⁻ᵏ of a step that keeps a link's pseudo-inertia positive definite; 0 for none."""
    share = torch.ones((), dtype=pi.dtype, device=pi.device)
    for _ in range(HALVINGS):
        J = _pseudo(pi + share * step)
        if bool(torch.linalg.eigvalsh(J)[0] > MARGIN * J.diagonal().sum()):
            return share
        share = 0.5 * share
    return torch.zeros_like(share)


def _pseudo(pi: Tensor) -> Tensor:
    """Pseudo-inertia `(4, 4)` of π `(10,)`."""
    xx, xy, xz, yy, yz, zz = pi[4:].unbind(-1)
    I = torch.stack([torch.stack(row) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))])
    Sigma = 0.5 * I.diagonal().sum() * torch.eye(3, dtype=pi.dtype, device=pi.device) - I
    top = torch.cat([Sigma, pi[1:4, None]], dim=-1)
    return torch.cat([top, torch.cat([pi[1:4], pi[:1]])[None]], dim=0)


def _bodies(pi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mass, centre of mass, and inertia about it, of π `(n, 10)`."""
    m, com = pi[:, 0], pi[:, 1:4] / pi[:, :1]
    xx, xy, xz, yy, yz, zz = pi[:, 4:].unbind(-1)
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    I = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    eye = torch.eye(3, dtype=pi.dtype, device=pi.device)
    square = (com * com).sum(-1)[:, None, None] * eye - com[:, :, None] * com[:, None, :]
    return m, com, I - m[:, None, None] * square
