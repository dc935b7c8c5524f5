"""Equations of motion under implicit constraints (Gauss; Udwadia and Kalaba): A, b → L, T, P, H, λ.

M q̈ = Q̄ + Aᵀλ and A q̈ = b imply q̈ = L b + H Q̄ and λ = (A M⁻¹ Aᵀ)⁺(b − A M⁻¹ Q̄). With the Cholesky
factorization M = G Gᵀ and W = A G⁻ᵀ, L = G⁻ᵀ W⁺ and (A M⁻¹ Aᵀ)⁺ = W⁺ᵀ W⁺. The rank is determined from the
singular values of W. Those of A M⁻¹ Aᵀ are their squares, which are too small in single precision to
distinguish redundant constraints from rounding errors.

Differentiating M q̈ − Q_C − Q_G − Q_D − Aᵀλ = Q and A q̈ = b at fixed q̈ and λ gives the residuals r_f = ∂Q −
∂ID + ∂Q_D + ∂(Aᵀ)λ and r_c = ∂b − ∂A q̈, from which ∂q̈ = H r_f + L r_c and ∂λ = (A M⁻¹ Aᵀ)⁺(r_c − A M⁻¹
r_f). The derivatives of inverse dynamics have a closed form; those of the few constraint rows are computed by
autograd. The pseudo-inverse itself is not differentiated, so redundant constraints of constant rank are
handled correctly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vecdot
from torch.nn.functional import normalize

from forcegp import dynamics
from forcegp.derivatives import inverse_dynamics_derivatives
from forcegp.errors import MassMatrixError
from forcegp.kinematics import LinkMotion, LinkPoses, PointMotion
from forcegp.robot.model import RobotModel
from forcegp.types import ConstraintInverse, ConstraintMatrix, ConstraintVector, JointMatrix, JointVector

RANK_TOLERANCE = 1e-5
"""Singular value of A G⁻ᵀ with M = G Gᵀ, relative to the largest, below which constraints are redundant."""
RANK_ROUNDING = 1e3
"""The same threshold in units of the machine epsilon ε, used if it is larger: 1.2e-4 in single precision.
Redundant contacts of the bundled arms give 2 ε; closed loops and ill-conditioned M give more."""


def rank_tolerance(dtype: torch.dtype) -> float:
    """Return the relative singular value of A G⁻ᵀ below which a constraint is redundant."""
    return max(RANK_TOLERANCE, RANK_ROUNDING * torch.finfo(dtype).eps)


def nothing(dtype: torch.dtype) -> float:
    """Return the norm below which a row of A G⁻ᵀ is treated as zero [1/√kg] because its point cannot move."""
    return RANK_ROUNDING * torch.finfo(dtype).eps


FACING_DOWN = 1e-6
"""Value of 1 + n_z below which a normal is treated as −e_z, to which the smallest rotation is not unique."""


def tangent_frame(n: Tensor) -> Tensor:
    """Return two unit tangents of the surface `(*batch, 3, 2)` for unit normals n `(*batch, 3)`.

    The columns are R e_x and R e_y, where R = 1 + [w]ₓ + [w]ₓ²/(1 + n_z) with w = e_z × n is the smallest
    rotation for which R e_z = n. At n = −e_z, R is half a turn about e_x.
    """
    x, y, z = n.unbind(-1)
    down = 1.0 + z < FACING_DOWN
    share = torch.where(down, 0.0, 1.0 / torch.where(down, 1.0, 1.0 + z))
    first = torch.stack([1.0 - x * x * share, -x * y * share, -x], dim=-1)
    second = torch.stack([-x * y * share, torch.where(down, -1.0, 1.0) - y * y * share, -y], dim=-1)
    return torch.stack([first, second], dim=-1)


@dataclass(frozen=True, eq=False)
class ContactPoint:
    """The point on the robot that touches a surface. For a rounded tip, it is the material point in contact.

    Attributes:
        position, velocity: `(*batch, 3)` position [m] and velocity [m/s] in the world.
        jacobian: J_E `(*batch, 3, nq)`, in world axes.
        normal: ∇c `(*batch, 3)` at the point.
        sticks: `(*batch,)` bool, whether the point sticks to the surface; `None` if it never sticks.
    """

    position: Tensor
    velocity: Tensor
    jacobian: Tensor
    normal: Tensor
    sticks: Tensor | None = None

    @cached_property
    def unit_normal(self) -> Tensor:
        """Unit normal n `(*batch, 3)`, parallel to ∇c."""
        return normalize(self.normal, dim=-1)

    @cached_property
    def sliding(self) -> tuple[Tensor, Tensor]:
        """Tangential Jacobian (1 − n nᵀ) J_E `(*batch, 3, nq)` and velocity (1 − n nᵀ) ṗ `(*batch, 3)`."""
        n, J, v = self.unit_normal, self.jacobian, self.velocity
        return J - n[..., None] * (n[..., None, :] @ J), v - n * vecdot(n, v)[..., None]

    def directions(self, rows: int) -> Tensor:
        """Return the multiplier directions `(*batch, 3, rows)`: ∇c, and tangents if the point may stick."""
        normal = self.normal[..., None]
        return normal if rows == 1 else torch.cat([normal, tangent_frame(self.unit_normal)], dim=-1)


@dataclass(frozen=True, eq=False)
class Equations:
    """The constrained equations of motion at a batch of states.

    Attributes:
        M: `(*batch, nq, nq)` mass matrix.
        A: `(*batch, m, nq)` constraint matrix; rows of inactive contacts are zero.
        b: `(*batch, m)` right-hand side of A q̈ = b, including Baumgarte terms.
        c, cd: `(*batch, m)` constraint error and its rate for all contacts, whether active or not.
        Q_C, Q_G, Q_D: `(*batch, nq)` bias force, gravity force and dissipative joint force.
        contact_points: contact point of each surface contact, keyed by name.
        point_motion: function that returns the motion of a point, given as `(frame, point)`, at the states.
        links: function that returns the poses and the motion of the links at the states.
        holds: `(*batch, m)` bool, rows of A that apply, namely those of closed contacts, including the
            tangential rows of sticking contacts.
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
    point_motion: Callable[[str, Sequence[float]], PointMotion]
    links: Callable[[], tuple[LinkPoses, LinkMotion]]
    holds: Tensor

    @cached_property
    def _links(self) -> tuple[LinkPoses, LinkMotion]:
        return self.links()

    @property
    def poses(self) -> LinkPoses:
        """Poses of the links."""
        return self._links[0]

    @property
    def motion(self) -> LinkMotion:
        """Velocities of the links."""
        return self._links[1]

    @cached_property
    def M_cholesky(self) -> JointMatrix:
        """Lower Cholesky factor of M; raises `NumericalError` if M is not positive definite."""
        try:
            return torch.linalg.cholesky(self.M)
        except torch.linalg.LinAlgError as cause:  # pyright: ignore[reportPrivateImportUsage]
            raise MassMatrixError(cause) from cause

    @cached_property
    def M_inv_At(self) -> ConstraintInverse:
        """M⁻¹ Aᵀ `(*batch, nq, m)`."""
        return torch.cholesky_solve(self.A.mT, self.M_cholesky)

    @cached_property
    def M_inv(self) -> JointMatrix:
        """M⁻¹ `(*batch, nq, nq)`."""
        eye = torch.eye(self.M.shape[-1], dtype=self.M.dtype, device=self.M.device)
        return torch.cholesky_solve(eye.expand_as(self.M), self.M_cholesky)

    @cached_property
    def scaled_jacobian(self) -> ConstraintMatrix:
        """W = A G⁻ᵀ `(*batch, m, nq)` with M = G Gᵀ, so that A M⁻¹ Aᵀ = W Wᵀ."""
        return torch.linalg.solve_triangular(self.M_cholesky, self.A.mT, upper=False).mT

    @cached_property
    def scaled_inverse(self) -> ConstraintInverse:
        """W⁺ `(*batch, nq, m)`, a pseudo-inverse that handles redundant and inactive rows."""
        W = self.scaled_jacobian
        if W.shape[-2] == 0:
            return W.mT
        if W.shape[-2] == 1:
            # w⁺ = w/|w|²
            square = W.square().sum(-1, keepdim=True)
            # The row of an inactive contact, or of a point that cannot move, is zero and remains zero.
            return (W / square.masked_fill(square <= nothing(W.dtype) ** 2, torch.inf)).mT
        return torch.linalg.pinv(W, atol=nothing(W.dtype), rtol=rank_tolerance(W.dtype))

    @cached_property
    def constraint_inertia(self) -> Tensor:
        """(A M⁻¹ Aᵀ)⁺ = W⁺ᵀ W⁺ `(*batch, m, m)`."""
        return self.scaled_inverse.mT @ self.scaled_inverse

    @cached_property
    def rank(self) -> Tensor:
        """Number of independent active constraint rows `(*batch,)`."""
        W = self.scaled_jacobian
        if W.shape[-2] <= 1:
            return (W.square().sum(-1) > nothing(W.dtype) ** 2).sum(-1)
        return torch.linalg.matrix_rank(W, atol=nothing(W.dtype), rtol=rank_tolerance(W.dtype))

    @cached_property
    def hidden(self) -> Tensor:
        """Projector `(*batch, m, m)` onto multipliers μ that do not affect the motion, Aᵀμ = 0.

        Diagonal entries are 1 for fixed points, and between 0 and 1 for contacts that share a load.
        """
        # R = 1 − W W⁺
        return torch.diag_embed(self.holds.to(self.M)) - self.scaled_jacobian @ self.scaled_inverse

    @cached_property
    def L(self) -> ConstraintInverse:
        """L = M⁻¹Aᵀ(A M⁻¹ Aᵀ)⁺ = G⁻ᵀ W⁺ `(*batch, nq, m)` (remark 1.1)."""
        return torch.linalg.solve_triangular(self.M_cholesky.mT, self.scaled_inverse, upper=True)

    @cached_property
    def T(self) -> JointMatrix:
        """The oblique projector T = I − L A onto the null space of A (remark 1.3)."""
        return torch.eye(self.M.shape[-1], dtype=self.M.dtype, device=self.M.device) - self.L @ self.A

    @property
    def P(self) -> JointMatrix:
        """The oblique projector P = Tᵀ."""
        return self.T.mT

    @property
    def N(self) -> JointMatrix:
        """The orthogonal projector N = I − A⁺A onto the null space of A, the free directions."""
        eye = torch.eye(self.A.shape[-1], dtype=self.A.dtype, device=self.A.device)
        return eye - torch.linalg.pinv(self.A) @ self.A

    @cached_property
    def H(self) -> JointMatrix:
        """Symmetric map H = M⁻¹P = T M⁻¹ = M⁻¹ − L A M⁻¹ from forces to constrained accelerations."""
        return self.M_inv - self.L @ self.M_inv_At.mT

    @property
    def Q_K(self) -> JointVector:
        """Force Q_C + Q_G + Q_D computed from the robot file, excluding the motor torque."""
        return self.Q_C + self.Q_G + self.Q_D

    def free_acceleration(self, Q: JointVector) -> JointVector:
        """Return q̈′ = M⁻¹ Q, the acceleration without contact (eq. 1)."""
        return torch.cholesky_solve(Q[..., None], self.M_cholesky)[..., 0]

    def _gap(self, free: JointVector) -> ConstraintVector:
        """Return b − A q̈′ `(*batch, m)`, the constraint violation of the free motion."""
        return self.b - (self.A @ free[..., None])[..., 0]

    def acceleration(self, Q_bar: JointVector) -> JointVector:
        """Return q̈ = L b + H Q̄ (eq. 4), computed as q̈′ + L(b − A q̈′) from the free acceleration q̈′.

        Args:
            Q_bar: `(*batch, nq)` sum Q + Q_z of all impressed generalized forces [N m, N].
        """
        free = self.free_acceleration(Q_bar)
        return free + (self.L @ self._gap(free)[..., None])[..., 0]

    def motion_under(self, Q_bar: JointVector) -> tuple[JointVector, ConstraintVector]:
        """Return the acceleration q̈ = q̈′ + M⁻¹Aᵀ λ and the multiplier λ for one step of a rollout."""
        free = self.free_acceleration(Q_bar)
        multiplier = (self.constraint_inertia @ self._gap(free)[..., None])[..., 0]
        return free + (self.M_inv_At @ multiplier[..., None])[..., 0], multiplier

    def multiplier(self, Q_bar: JointVector) -> ConstraintVector:
        """Return λ = (A M⁻¹ Aᵀ)⁺(b − A M⁻¹ Q̄) `(*batch, m)` (eq. 16, including all impressed forces)."""
        return (self.constraint_inertia @ self._gap(self.free_acceleration(Q_bar))[..., None])[..., 0]

    def constraint_force(self, Q_bar: JointVector) -> JointVector:
        """Return Q_I = Aᵀ λ (eq. 17), `(*batch, nq)` [N m, N]."""
        return (self.A.mT @ self.multiplier(Q_bar)[..., None])[..., 0]


class Linearization(NamedTuple):
    """q̈ and λ at a state, and their Jacobians, which have one row per component of q̈ or λ.

    Attributes:
        qdd: `(*batch, nq)` constrained acceleration.
        dq, dqd, dforce: `(*batch, nq, nq)` Jacobians ∂q̈/∂q, ∂q̈/∂q̇ and ∂q̈/∂Q = H.
        multiplier: `(*batch, m)` multiplier λ.
        multiplier_dq, multiplier_dqd, multiplier_dforce: `(*batch, m, nq)` Jacobians of λ. Redundant
            constraints determine only Aᵀλ, so the λ of minimum norm is used.
    """

    qdd: JointVector
    dq: JointMatrix
    dqd: JointMatrix
    dforce: JointMatrix
    multiplier: ConstraintVector
    multiplier_dq: ConstraintMatrix
    multiplier_dqd: ConstraintMatrix
    multiplier_dforce: ConstraintMatrix


def linearize(
    robot: RobotModel,
    eom: Equations,
    rows: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    q: JointVector,
    qd: JointVector,
    force: JointVector,
) -> Linearization:
    """Linearize at states (q, q̇) with known equations of motion; `rows` returns A and b at given states."""
    with torch.no_grad():
        Q_bar = eom.Q_K + force
        qdd, multiplier = eom.acceleration(Q_bar), eom.multiplier(Q_bar)
        inverse = inverse_dynamics_derivatives(robot, q, qd, qdd)
    r_c, r_f = _residuals(robot, rows, torch.cat([q, qd], -1), qdd, multiplier)
    with torch.no_grad():
        r_f = r_f - torch.cat([inverse.dq, inverse.dqd], dim=-1)
        # ∂q̈ = H r_f + L r_c, ∂λ = (A M⁻¹ Aᵀ)⁺ (r_c − A M⁻¹ r_f)
        by_q, by_qd = (eom.H @ r_f + eom.L @ r_c).chunk(2, -1)
        along_q, along_qd = (eom.constraint_inertia @ (r_c - eom.M_inv_At.mT @ r_f)).chunk(2, -1)
        return Linearization(qdd, by_q, by_qd, eom.H, multiplier, along_q, along_qd, -eom.L.mT)


def _residuals(
    robot: RobotModel,
    rows: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    state: Tensor,
    qdd: Tensor,
    multiplier: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the Jacobians of b − A q̈ and Aᵀλ + Q_D with respect to (q, q̇) at fixed q̈ and λ."""
    with torch.enable_grad():
        state = state.detach().clone().requires_grad_()
        q, qd = state.chunk(2, -1)
        A, b = rows(q, qd)
        along = b - (A @ qdd[..., None])[..., 0]
        force = (A.mT @ multiplier[..., None])[..., 0] + dynamics.damping_force(robot, qd)
        sums = (component.sum() for component in torch.cat([along, force], dim=-1).unbind(-1))
        slopes = [torch.autograd.grad(x, state, retain_graph=True)[0] for x in sums]
    jacobian = torch.stack(slopes, dim=-2)
    return jacobian[..., : b.shape[-1], :], jacobian[..., b.shape[-1] :, :]
