"""Quantities as affine maps of the forces, z = B_Q Q + B_z Q_z + o.

The operators follow from M q̈ = Q̄ + Aᵀλ and A q̈ = b. They are those of eqs. 19 and 20 with two corrections:
the operator from force to λ is −Lᵀ, and λ depends on all impressed forces Q + Q_z.

`linearize_field` differentiates q̈ and λ under a force field with respect to the state and the torque.
Linearization at a fixed force (`constraints/gauss.py`) neglects the change in the force. Let F = Q̄ − Q_C −
Q_G − Q_D be the impressed forces missing from the robot file. Then

    dq̈/dx = ∂q̈/∂x + H ∂F/∂x,   dλ/dx = ∂λ/∂x − Lᵀ ∂F/∂x   for x = q, q̇, τ.

The mechanics are differentiated in closed form, and the force field is differentiated by autograd.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp.constraints import ConstrainedSystem, Equations
from forcegp.errors import ModelError, ShapeError, UnknownNameError
from forcegp.robot.model import RobotModel


@dataclass(frozen=True)
class States:
    """A batch of robot states with their equations of motion.

    Attributes:
        q, qd, tau: `(n, nq)` positions, velocities and motor torques.
        active: `(n, n_contacts)` bool, closed contacts.
        eom: equations of motion at these states.
        qdd: `(n, nq)` measured accelerations, if known.
        slip: `(n, nq)` sliding direction of each joint, which replaces tanh(q̇/v₀) in dry friction.
        recording: `(n, 1)` number of the recording, for states along a log (`Dataset.recording`).
        history: `(n, nq, 2 k)` states of bristles for states along a log (`forces/priors/memory.py`).
        kept: operators that were computed at these states, with their robots and priors, keyed by prior.
    """

    q: Tensor
    qd: Tensor
    tau: Tensor
    active: Tensor
    eom: Equations
    qdd: Tensor | None = None
    slip: Tensor | None = None
    recording: Tensor | None = None
    history: Tensor | None = None
    kept: dict[str, tuple[RobotModel, object, Tensor]] = field(init=False, repr=False, default_factory=dict)


def states(
    system: ConstrainedSystem,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    active: Tensor,
    qdd: Tensor | None = None,
    recording: Tensor | None = None,
) -> States:
    """Evaluate the equations of motion at a batch of states with nominal torques."""
    tau = system.robot.true_torque(tau)
    return States(q, qd, tau, active, system.equations(q, qd, active), qdd, recording=recording)


ForceField = Callable[[ConstrainedSystem, States], Tensor]
"""Function that returns the impressed force Q̄ `(n, nq)` at states; k samples take n/k rows each."""


class FlatStates(NamedTuple):
    """Flattened states of any batch shape.

    Attributes:
        q, qd, tau: `(n, nq)` positions, velocities and motor torques.
        active: `(n, n_contacts)` bool, closed contacts.
        batch: original batch shape; its product is n.
        history: `(n, nq, k)` states of bristles, for states along a log.
        recording: `(n, 1)` number of the recording, for states along a log.
    """

    q: Tensor
    qd: Tensor
    tau: Tensor
    active: Tensor
    batch: torch.Size
    history: Tensor | None = None
    recording: Tensor | None = None

    def rows(self, index: slice) -> FlatStates:
        """Return the states in the given slice."""
        q, qd, tau, active = (x[index] for x in (self.q, self.qd, self.tau, self.active))
        along = (x if x is None else x[index] for x in (self.history, self.recording))
        return FlatStates(q, qd, tau, active, self.batch, *along)

    def with_equations(self, system: ConstrainedSystem) -> States:
        """Return the states with their equations of motion."""
        at = states(system, self.q, self.qd, self.tau, self.active, recording=self.recording)
        return at if self.history is None else replace(at, history=self.history)


def flat_states(
    system: ConstrainedSystem, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor | None
) -> FlatStates:
    """Broadcast states `(*batch, nq)` against each other and flatten them. By default, contacts are closed.

    Raises:
        ShapeError: an argument does not match the system, or is not finite.
    """
    inputs = {"q": q, "qd": qd, "tau": tau}
    system.robot.check_state(**inputs)
    for name, x in inputs.items():
        if not bool(torch.isfinite(x).all()):
            raise ShapeError(f"{name} contains values that are not finite", expected="finite numbers")
    try:
        batch = torch.broadcast_shapes(*(x.shape[:-1] for x in inputs.values()))
    except RuntimeError as cause:
        got = {name: tuple(x.shape) for name, x in inputs.items()}
        raise ShapeError(
            "q, qd and tau do not broadcast", expected="shapes that broadcast to one batch", got=got
        ) from cause
    contacts = len(system.contacts)
    if active is None:
        active = torch.ones(contacts, dtype=torch.bool, device=q.device)
    system.active_rows(active, batch)
    rows = batch.numel()
    q, qd, tau = (x.expand(*batch, x.shape[-1]).reshape(rows, x.shape[-1]) for x in inputs.values())
    return FlatStates(q, qd, tau, active.expand(*batch, contacts).reshape(rows, contacts), batch)


def states_at(
    system: ConstrainedSystem, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor | None
) -> tuple[States, torch.Size]:
    """Return flattened states with equations of motion, and the batch shape (see `flat_states`)."""
    flat = flat_states(system, q, qd, tau, active)
    return flat.with_equations(system), flat.batch


class AffineMap(NamedTuple):
    """The affine map z = B_Q Q + B_z Q_z + o at each state.

    Attributes:
        B_Q: `(n, d, nq)` operator on the joint force Q.
        B_z: `(n, d, nq)` operator on the dissipative contact force Q_z.
        B_N: `(n, d, nq)` operator on the part of Q in the range of Aᵀ. It equals B_Q for all quantities
            except q̈, for which it is `None` because H Aᵀ = 0.
        o: `(n, d)` offset.
        B_F: `(n, d, nq)` operator that acts on the joint friction alone, in addition to B_Q.
    """

    B_Q: Tensor
    B_z: Tensor
    B_N: Tensor | None
    o: Tensor
    B_F: Tensor | None = None


def _times(C: Tensor, z: AffineMap) -> AffineMap:
    """Return C z for matrices C `(n, c, d)`."""
    # C z = C B_Q Q + C B_z Q_z + C o
    B = C @ z.B_Q
    return AffineMap(B, C @ z.B_z, B, (C @ z.o[..., None])[..., 0])


def _acceleration(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return the map q̈ = L b + H (Q + Q_z) (eqs. 4 and 15)."""
    H = at.eom.H
    return AffineMap(H, H, None, vecdot(at.eom.L, at.eom.b[..., None, :]))


def _free_acceleration(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return q̈′ = M⁻¹ Q (eq. 1)."""
    return _joint_force(system, at)._replace(B_Q=at.eom.M_inv, B_N=at.eom.M_inv)


def _multiplier(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return the map λ = (A M⁻¹ Aᵀ)⁺ b − Lᵀ (Q + Q_z) (eq. 16 with the two corrections)."""
    B = -at.eom.L.mT
    return AffineMap(B, B, B, (at.eom.constraint_inertia @ at.eom.b[..., None])[..., 0])


def _constraint_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return Q_I = Aᵀ λ (eq. 17)."""
    return _times(at.eom.A.mT, _multiplier(system, at))


def _contact_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return F_I = ∇c λ, plus (t_1, t_2) λ_t for sticking contacts, with three components per contact."""
    return _times(_directions(system, at), _multiplier(system, at))


def _directions(system: ConstrainedSystem, at: States) -> Tensor:
    """Return N `(n, 3 k, m)` such that F_I = N λ; it contains the directions of each surface contact."""
    blocks = [at.q.new_zeros(len(at.q), 0, system.m)]
    for name, rows in system.rows.items():
        if name in at.eom.contact_points:
            N = at.eom.contact_points[name].directions(rows.stop - rows.start)
            blocks.append(torch.nn.functional.pad(N, (rows.start, system.m - rows.stop)))
    return torch.cat(blocks, dim=1)


def _total_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return Q̄ = Q + Q_z (eq. 18)."""
    Q = _joint_force(system, at)
    return Q._replace(B_z=Q.B_Q)


def _joint_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return Q."""
    eye = torch.eye(at.q.shape[-1], dtype=at.q.dtype, device=at.q.device).expand(len(at.q), -1, -1)
    return AffineMap(eye, torch.zeros_like(eye), eye, torch.zeros_like(at.q))


def _contact_friction(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return Q_z."""
    Q = _joint_force(system, at)
    return AffineMap(Q.B_z, Q.B_Q, Q.B_z, Q.o)


QUANTITIES: dict[str, Callable[[ConstrainedSystem, States], AffineMap]] = {
    "qdd": _acceleration,
    "qdd_free": _free_acceleration,
    "multiplier": _multiplier,
    "constraint_force": _constraint_force,
    "contact_force": _contact_force,
    "total_force": _total_force,
    "joint_force": _joint_force,
    "contact_friction": _contact_friction,
}
"""Quantities that can be measured and predicted, keyed by name."""


def _joint_friction(system: ConstrainedSystem, at: States) -> AffineMap:
    """Return the friction in the joints, which is Q_D of the robot file plus the learned friction."""
    Q = _joint_force(system, at)
    return AffineMap(Q.B_z, Q.B_z, Q.B_z, at.eom.Q_D, Q.B_Q)


PREDICTED = QUANTITIES | {"joint_friction": _joint_friction}
"""Quantities that can be predicted; joint friction cannot be measured separately."""


def affine_maps(
    system: ConstrainedSystem, at: States, quantity: str | Sequence[str]
) -> tuple[AffineMap, dict[str, slice]]:
    """Return the affine map of one quantity or of several stacked quantities, and the rows of each quantity.

    Raises:
        UnknownNameError: a quantity does not exist.
        ModelError: no quantity is given.
    """
    names = list(quantity) if isinstance(quantity, Sequence) and not isinstance(quantity, str) else [quantity]
    if not names:
        raise ModelError("no quantity is named", expected="one of " + ", ".join(PREDICTED))
    for name in names:
        if not isinstance(name, str) or name not in PREDICTED:
            raise UnknownNameError("quantity", name, PREDICTED)
    maps = {name: PREDICTED[name](system, at) for name in names}
    rows, first = {}, 0
    for name, z in maps.items():
        rows[name] = slice(first, first + z.o.shape[-1])
        first += z.o.shape[-1]
    if len(maps) == 1:
        return next(iter(maps.values())), rows
    filled = [
        z._replace(**{x: torch.zeros_like(z.B_Q) for x in ("B_N", "B_F") if getattr(z, x) is None})
        for z in maps.values()
    ]
    return AffineMap(*(torch.cat(parts, dim=1) for parts in zip(*filled, strict=True))), rows


ROUNDED = 1e-6
"""Tolerance for deciding that entries of the projector onto hidden multipliers are 0 or 1."""
DOUBTS = (
    "contact {} is never closed in the training data: its force is not determined",
    "the point of contact {} cannot move in the direction of its force, which is not determined",
    "contacts {} hold the robot in the same direction: only the sum of their forces is determined",
)
"""Messages about contact forces that the motion does not determine."""


class Hidden(NamedTuple):
    """Parts of quantities that the motion does not determine.

    Attributes:
        whole: `(n, d)` bool, undetermined components.
        shared: `(n, d, d)` matrix C R Cᵀ of load sharing between contacts, where R projects onto Aᵀμ = 0.
        seen: `(n,)` number of directions of the shared load that the motion determines.
        doubts: warnings that describe the undetermined components.
    """

    whole: Tensor
    shared: Tensor
    seen: Tensor
    doubts: tuple[str, ...]

    def applied(self, mean: Tensor, covariance: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Return the mean `(n, d)` and the covariance, with NaN for undetermined components. Undetermined
        directions are assigned the mean square of the determined directions as variance.
        """
        if covariance is not None:
            square = mean.square() + covariance.diagonal(dim1=-2, dim2=-1)
            of_shared = square * (self.shared.diagonal(dim1=-2, dim2=-1) > 0.0)
            prior = of_shared.sum(-1) / self.seen.clamp(min=ROUNDED)
            covariance = covariance + prior[:, None, None] * self.shared
            covariance = covariance.masked_fill(self.whole[..., None] | self.whole[:, None], torch.nan)
        return mean.masked_fill(self.whole, torch.nan), covariance


def hidden_forces(
    system: ConstrainedSystem, at: States, parts: Mapping[str, slice], never: Sequence[str] = ()
) -> Hidden | None:
    """Return the undetermined parts of the given quantities, or `None` if everything is determined.

    Args:
        parts: rows of each quantity, as returned by `affine_maps`.
        never: contacts that are never closed in the training data.

    Raises:
        ModelError: all requested quantities are forces at contacts that are never closed.
    """
    names = [c.name for c in system.contacts for _ in range(c.rows)]
    if not names or not {"multiplier", "contact_force", "constraint_force"} & set(parts):
        return None
    unseen = torch.tensor([name in never for name in names], device=at.q.device)
    R = at.eom.hidden
    part = R.diagonal(dim1=-2, dim2=-1)
    fixed, shares = part > 1.0 - ROUNDED, (part > ROUNDED) & (part <= 1.0 - ROUNDED)
    cases = [rows.reshape(-1, system.m).any(0).tolist() for rows in (unseen, fixed & ~unseen, shares)]
    if not any(map(any, cases)):
        return None
    C = at.q.new_zeros(len(at.q), max(rows.stop for rows in parts.values()), system.m)
    whole = torch.zeros_like(C[..., 0], dtype=torch.bool)
    for quantity, rows in parts.items():
        if quantity == "multiplier":
            C[:, rows], whole[:, rows] = torch.eye(system.m).to(at.q), fixed | unseen
        elif quantity == "contact_force":
            C[:, rows] = _directions(system, at)
            affected = ((C[:, rows] != 0.0) & (fixed | unseen)[:, None]).any(-1).unflatten(-1, (-1, 3))
            whole[:, rows] = affected.any(-1, keepdim=True).expand_as(affected).flatten(1)
        elif quantity == "constraint_force":
            whole[:, rows] = unseen.any()
    if bool(whole.all()) and any(cases[0]):
        raise ModelError(
            DOUBTS[0].format(", ".join(never)),
            expected="motion in contact in the training data",
            hint="check the position of its surface (`forcegp check`), or, for forces learned in free "
            "motion, pass the system with the contact to `predict`",
        )
    listed = (
        ", ".join(dict.fromkeys(n for n, hit in zip(names, hits, strict=True) if hit)) for hits in cases
    )
    doubts = tuple(text.format(contacts) for text, contacts in zip(DOUBTS, listed, strict=True) if contacts)
    seen = ((1.0 - part) * shares).sum(-1) * len({"multiplier", "contact_force"} & set(parts))
    shared = C @ (R * shares[..., None]) @ C.mT
    return Hidden(whole, shared, seen, doubts) if bool(whole.any() | shared.any()) else None


def affine_map(system: ConstrainedSystem, at: States, quantity: str | Sequence[str]) -> AffineMap:
    """Return the affine map of one or several stacked quantities (see `affine_maps`)."""
    return affine_maps(system, at, quantity)[0]


class ForceLinearization(NamedTuple):
    """q̈ and λ at a state, and their Jacobians, which have one row per component of q̈ or λ.

    Attributes:
        qdd: `(*batch, nq)` acceleration [rad/s², m/s²].
        dq, dqd, dtau: `(*batch, nq, nq)` Jacobians dq̈/dq, dq̈/dq̇ and dq̈/dτ.
        multiplier: `(*batch, m)` multiplier λ.
        multiplier_dq, multiplier_dqd, multiplier_dtau: `(*batch, m, nq)` Jacobians dλ/dq, dλ/dq̇ and dλ/dτ.
    """

    qdd: Tensor
    dq: Tensor
    dqd: Tensor
    dtau: Tensor
    multiplier: Tensor
    multiplier_dq: Tensor
    multiplier_dqd: Tensor
    multiplier_dtau: Tensor


def linearize_field(
    force: Callable[[ConstrainedSystem, States], Tensor],
    system: ConstrainedSystem,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    active: Tensor | None = None,
) -> ForceLinearization:
    """Linearize the constrained motion under a force field.

    Args:
        force: function that returns the impressed force Q̄ `(n, nq)` at states.
        q, qd, tau: `(*batch, nq)` positions, velocities and motor torques.
        active: `(*batch, n_contacts)` bool, closed contacts; all by default.

    Raises:
        ShapeError: an argument does not match the system.
    """
    flat = flat_states(system, q, qd, tau, active)
    with torch.enable_grad():
        leaves = [x.detach().clone().requires_grad_() for x in (flat.q, flat.qd, flat.tau)]
        at = states(system, leaves[0], leaves[1], leaves[2], flat.active)
        # F = Q̄ − Q_C − Q_G − Q_D, ∂F/∂(q, q̇, τ) row by row
        F = force(system, at) - at.eom.Q_K
        rows = [
            torch.autograd.grad(component.sum(), leaves, retain_graph=True, materialize_grads=True)
            for component in F.unbind(-1)
        ]
    by_q, by_qd, by_tau = (torch.stack(parts, dim=-2) for parts in zip(*rows, strict=True))
    fixed = system.linearize(flat.q, flat.qd, F.detach(), flat.active)
    # dq̈/dx = ∂q̈/∂x + H ∂F/∂x, dλ/dx = ∂λ/∂x − Lᵀ ∂F/∂x
    H, minus_Lt = fixed.dforce, fixed.multiplier_dforce
    linearization = (
        fixed.qdd,
        fixed.dq + H @ by_q,
        fixed.dqd + H @ by_qd,
        H @ by_tau,
        fixed.multiplier,
        fixed.multiplier_dq + minus_Lt @ by_q,
        fixed.multiplier_dqd + minus_Lt @ by_qd,
        minus_Lt @ by_tau,
    )
    return ForceLinearization(*(x.reshape(*flat.batch, *x.shape[1:]) for x in linearization))
