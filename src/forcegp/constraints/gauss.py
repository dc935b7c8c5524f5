"""Equations of motion under implicit constraints (Gauss; Udwadia and Kalaba): A, b → L, T, P, H, λ.

From M q̈ = Q̄ + Aᵀλ and A q̈ = b follow q̈ = L b + H Q̄ and λ = (A M⁻¹ Aᵀ)⁺(b − A M⁻¹ Q̄).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from forcegp import dynamics, kinematics
from forcegp.constraints.baumgarte import Baumgarte
from forcegp.constraints.contact import Constraint, ContactPoint
from forcegp.errors import ForceGPError, ShapeError, UnknownNameError
from forcegp.kinematics import LinkMotion, LinkPoses
from forcegp.robot.model import RobotModel
from forcegp.types import ConstraintInverse, ConstraintMatrix, ConstraintVector, JointMatrix, JointVector

RANK_TOLERANCE = 1e-10
"""Eigenvalues of A M⁻¹ Aᵀ below this fraction of the largest count as redundant constraints."""


@dataclass(frozen=True, eq=False)
class Equations:
    """The constrained equations of motion at a batch of states.

    Attributes:
        M: `(*batch, nq, nq)` mass matrix.
        A: `(*batch, m, nq)`; rows of inactive contacts are zero.
        b: `(*batch, m)` with A q̈ = b, Baumgarte terms included.
        c, cd: `(*batch, m)` constraint error and its rate, of all contacts, active or not.
        Q_C, Q_G, Q_D: `(*batch, nq)` bias, gravity and dissipative joint force.
        contact_points: the touching point of each surface contact, by name.
        poses, motion: the links at the states, for whoever needs more of the kinematics.
    """

    M: JointMatrix
    A: ConstraintMatrix
    b: ConstraintVector
    c: ConstraintVector
    cd: ConstraintVector
    Q_C: JointVector
    Q_G: JointVector
    Q_D: JointVector
    contact_points: dict[str, ContactPoint]
    poses: LinkPoses
    motion: LinkMotion

    @cached_property
    def M_cholesky(self) -> JointMatrix:
        """Lower Cholesky factor of M."""
        return torch.linalg.cholesky(self.M)

    @cached_property
    def M_inv_At(self) -> ConstraintInverse:
        """M⁻¹ Aᵀ `(*batch, nq, m)`."""
        return torch.cholesky_solve(self.A.mT, self.M_cholesky)

    @cached_property
    def M_inv(self) -> JointMatrix:
        """M⁻¹."""
        eye = torch.eye(self.M.shape[-1], dtype=self.M.dtype, device=self.M.device)
        return torch.cholesky_solve(eye.expand_as(self.M), self.M_cholesky)

    @cached_property
    def constraint_inertia(self) -> Tensor:
        """(A M⁻¹ Aᵀ)⁺ `(*batch, m, m)`; the pseudo-inverse serves redundant and inactive rows."""
        S = self.A @ self.M_inv_At
        if S.shape[-1] == 0:
            return S
        if S.shape[-1] == 1:
            inactive = S == 0.0
            return torch.where(inactive, 0.0, 1.0 / torch.where(inactive, 1.0, S))
        return torch.linalg.pinv(S, hermitian=True, rtol=RANK_TOLERANCE)

    @cached_property
    def rank(self) -> Tensor:
        """`(*batch,)` number of independent active constraint rows."""
        if self.A.shape[-2] == 0:
            return torch.zeros(self.A.shape[:-2], dtype=torch.int64, device=self.A.device)
        S = self.A @ self.M_inv_At
        return torch.linalg.matrix_rank(S, hermitian=True, rtol=RANK_TOLERANCE)

    @cached_property
    def L(self) -> ConstraintInverse:
        """L = M⁻¹Aᵀ(A M⁻¹ Aᵀ)⁺ `(*batch, nq, m)` (remark 1.1)."""
        return self.M_inv_At @ self.constraint_inertia

    @cached_property
    def T(self) -> JointMatrix:
        """The oblique projector T = I − L A on the null space of A (remark 1.3)."""
        return torch.eye(self.M.shape[-1], dtype=self.M.dtype, device=self.M.device) - self.L @ self.A

    @property
    def P(self) -> JointMatrix:
        """The oblique projector P = Tᵀ."""
        return self.T.mT

    @cached_property
    def H(self) -> JointMatrix:
        """H = M⁻¹P = T M⁻¹, symmetric, from force to constrained acceleration."""
        return self.M_inv - self.L @ self.M_inv_At.mT

    @property
    def Q_K(self) -> JointVector:
        """Q_C + Q_G + Q_D, the force that the robot file knows, without actuation."""
        return self.Q_C + self.Q_G + self.Q_D

    def free_acceleration(self, Q: JointVector) -> JointVector:
        """q̈′ = M⁻¹ Q, the acceleration without contact (eq. 1)."""
        return torch.cholesky_solve(Q[..., None], self.M_cholesky)[..., 0]

    def acceleration(self, Q_bar: JointVector) -> JointVector:
        """q̈ = L b + H Q̄ (eq. 4), as the correction q̈′ + L(b − A q̈′) of the free acceleration.

        Args:
            Q_bar: `(*batch, nq)` all impressed generalized forces Q + Q_z [N m, N].
        """
        free = self.free_acceleration(Q_bar)
        return free + (self.L @ (self.b - (self.A @ free[..., None])[..., 0])[..., None])[..., 0]

    def multiplier(self, Q_bar: JointVector) -> ConstraintVector:
        """λ = (A M⁻¹ Aᵀ)⁺(b − A M⁻¹ Q̄) (eq. 16, with all impressed forces), `(*batch, m)`."""
        residual = self.b - (self.A @ self.free_acceleration(Q_bar)[..., None])[..., 0]
        return (self.constraint_inertia @ residual[..., None])[..., 0]

    def constraint_force(self, Q_bar: JointVector) -> JointVector:
        """Q_I = Aᵀ λ (eq. 17), `(*batch, nq)` [N m, N]."""
        return (self.A.mT @ self.multiplier(Q_bar)[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class ConstrainedSystem:
    """A robot with its constraints.

    Args:
        robot: the robot.
        contacts: the constraints; an empty sequence is free motion.
        baumgarte: stabilization of the constraint error, or `None`.

    Raises:
        UnknownNameError: a contact names a frame that the robot has not.
        ForceGPError: two contacts share a name.
    """

    robot: RobotModel
    contacts: Sequence[Constraint] = ()
    baumgarte: Baumgarte | None = None

    def __post_init__(self) -> None:
        names = [contact.name for contact in self.contacts]
        for name in names:
            if names.count(name) > 1:
                raise ForceGPError(f"two contacts are named {name!r}", hint="give each contact its own name")
        for contact in self.contacts:
            contact.check(self.robot)

    @property
    def contact_names(self) -> tuple[str, ...]:
        """Names of the constraints, in order."""
        return tuple(contact.name for contact in self.contacts)

    @property
    def m(self) -> int:
        """Number of constraint rows."""
        return sum(contact.rows for contact in self.contacts)

    def contact(self, name: str) -> Constraint:
        """A constraint by name.

        Raises:
            UnknownNameError: no such contact.
        """
        for contact in self.contacts:
            if contact.name == name:
                return contact
        raise UnknownNameError("contact", name, self.contact_names)

    def with_robot(self, robot: RobotModel) -> ConstrainedSystem:
        """The same constraints on a robot with other parameters."""
        return dataclasses.replace(self, robot=robot)

    def active_rows(self, active: Tensor | None, batch: torch.Size) -> Tensor:
        """`(*batch, m)` bool from `(*batch, n_contacts)` bool, all active for `None`.

        Raises:
            ShapeError: not boolean, or a shape that does not fit the contacts and the batch.
        """
        n, device = len(self.contacts), self.robot.device
        if active is None:
            return torch.ones(*batch, self.m, dtype=torch.bool, device=device)
        sizes = zip(reversed(active.shape), reversed((*batch, n)), strict=False)
        fits = (
            0 < active.ndim <= len(batch) + 1 and active.shape[-1] == n and all(a in (1, b) for a, b in sizes)
        )
        if not fits or active.dtype != torch.bool:
            raise ShapeError(
                f"active does not fit the contacts {', '.join(self.contact_names) or '(none)'}",
                expected=f"bool of shape {(*batch, n)}",
                got=f"{str(active.dtype).removeprefix('torch.')} of shape {tuple(active.shape)}",
            )
        repeats = torch.tensor([contact.rows for contact in self.contacts], dtype=torch.int64, device=device)
        return active.repeat_interleave(repeats, dim=-1).expand(*batch, self.m)

    def equations(self, q: JointVector, qd: JointVector, active: Tensor | None = None) -> Equations:
        """The equations of motion at states (q, q̇).

        Args:
            q, qd: `(*batch, nq)` joint positions and velocities.
            active: `(*batch, n_contacts)` bool, which contacts are closed in each sample; default all.

        Raises:
            ShapeError: an argument does not fit.
        """
        robot = self.robot
        robot.check_state(q=q, qd=qd)
        if q.shape != qd.shape:
            raise ShapeError("q and qd are not one batch", expected=tuple(q.shape), got=tuple(qd.shape))
        poses = kinematics.link_poses(robot, q)
        motion = kinematics.link_motion(robot, poses, qd)
        links = dynamics.link_inertia(robot, poses)
        terms = {contact.name: contact.terms(robot, poses, motion, qd) for contact in self.contacts}
        c, A, b = self._stack(q, list(terms.values()))
        cd = (A @ qd[..., None])[..., 0]
        if self.baumgarte is not None:
            b = self.baumgarte.stabilized(b, c, cd)
        rows = self.active_rows(active, q.shape[:-1])
        return Equations(
            M=dynamics.mass_matrix_of_poses(robot, poses, links),
            A=torch.where(rows[..., None], A, 0.0),
            b=torch.where(rows, b, 0.0),
            c=c,
            cd=cd,
            Q_C=dynamics.bias_force_of_motion(robot, poses, links, motion),
            Q_G=dynamics.gravity_force_of_poses(robot, poses, links),
            Q_D=dynamics.damping_force(robot, qd),
            contact_points={name: term.point for name, term in terms.items() if term.point is not None},
            poses=poses,
            motion=motion,
        )

    def _stack(self, q: Tensor, terms: list) -> tuple[Tensor, Tensor, Tensor]:
        """c, A, b of all contacts, concatenated over rows."""
        if not terms:
            empty = q.new_zeros(*q.shape[:-1], 0)
            return empty, q.new_zeros(*q.shape[:-1], 0, q.shape[-1]), empty
        return (
            torch.cat([t.c for t in terms], dim=-1),
            torch.cat([t.A for t in terms], dim=-2),
            torch.cat([t.b for t in terms], dim=-1),
        )
