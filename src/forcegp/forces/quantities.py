"""Every measured or predicted quantity as an affine map of the forces, z = B_Q Q + B_z Q_z + o.

The operators follow from M q̈ = Q̄ + Aᵀλ and A q̈ = b (eqs. 19 to 25, with the signs put right: the
operator from force to λ is −Lᵀ, and λ answers to all impressed forces Q + Q_z).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.states import States


class AffineMap(NamedTuple):
    """z = B_Q Q + B_z Q_z + o at each state.

    Attributes:
        B_Q, B_z: `(n, d, nq)` operators on the joint force Q and the contact's dissipative force Q_z.
        o: `(n, d)` offset.
    """

    B_Q: Tensor
    B_z: Tensor
    o: Tensor


def _identity(at: States) -> tuple[Tensor, Tensor, Tensor]:
    """I, 0 and the offset 0 in joint space."""
    eye = torch.eye(at.q.shape[-1], dtype=at.q.dtype, device=at.q.device).expand(len(at.q), -1, -1)
    return eye, torch.zeros_like(eye), torch.zeros_like(at.q)


def _acceleration(system: ConstrainedSystem, at: States) -> AffineMap:
    """q̈ = L b + H (Q + Q_z)."""
    H = at.eom.H
    return AffineMap(H, H, (at.eom.L @ at.eom.b[..., None])[..., 0])


def _free_acceleration(system: ConstrainedSystem, at: States) -> AffineMap:
    """q̈′ = M⁻¹ Q."""
    _, zero, nothing = _identity(at)
    return AffineMap(at.eom.M_inv, zero, nothing)


def _multiplier(system: ConstrainedSystem, at: States) -> AffineMap:
    """λ = (A M⁻¹ Aᵀ)⁺ b − Lᵀ (Q + Q_z)."""
    B = -at.eom.L.mT
    return AffineMap(B, B, (at.eom.constraint_inertia @ at.eom.b[..., None])[..., 0])


def _constraint_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """Q_I = Aᵀ λ."""
    B_Q, B_z, o = _multiplier(system, at)
    At = at.eom.A.mT
    return AffineMap(At @ B_Q, At @ B_z, (At @ o[..., None])[..., 0])


def _contact_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """F_I = ∇c λ of each surface contact, three Cartesian components a contact, in the order of contacts."""
    multiplier = _multiplier(system, at)
    rows, columns = [], []
    first = 0
    for contact in system.contacts:
        if contact.name in at.eom.contact_points:
            rows.append(first)
            columns.append(at.eom.contact_points[contact.name].normal)
        first += contact.rows
    normals = at.q.new_zeros(len(at.q), 3 * len(rows), system.m)
    for i, (row, normal) in enumerate(zip(rows, columns, strict=True)):
        normals = normals.slice_scatter(
            normals[:, 3 * i : 3 * i + 3].select_scatter(normal, 2, row), 1, 3 * i, 3 * i + 3
        )
    return AffineMap(
        normals @ multiplier.B_Q, normals @ multiplier.B_z, (normals @ multiplier.o[..., None])[..., 0]
    )


def _total_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """Q̄ = Q + Q_z."""
    eye, _, nothing = _identity(at)
    return AffineMap(eye, eye, nothing)


def _joint_force(system: ConstrainedSystem, at: States) -> AffineMap:
    """Q."""
    return AffineMap(*_identity(at))


def _contact_friction(system: ConstrainedSystem, at: States) -> AffineMap:
    """Q_z."""
    eye, zero, nothing = _identity(at)
    return AffineMap(zero, eye, nothing)


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
"""The quantities that can be measured and predicted, by name."""


def affine_maps(system: ConstrainedSystem, at: States, quantity: str | Sequence[str]) -> dict[str, AffineMap]:
    """The affine map of a quantity, or of each of several, by name.

    Raises:
        UnknownNameError: no such quantity.
        ModelError: none is named.
    """
    names = [quantity] if isinstance(quantity, str) else list(quantity)
    if not names:
        raise ModelError("no quantity is named", expected="one of " + ", ".join(QUANTITIES))
    for name in names:
        if name not in QUANTITIES:
            raise UnknownNameError("quantity", name, QUANTITIES)
    return {name: QUANTITIES[name](system, at) for name in names}


def stack(maps: Mapping[str, AffineMap]) -> tuple[AffineMap, dict[str, slice]]:
    """Several affine maps one above the other, and the rows of each."""
    rows, first = {}, 0
    for name, z in maps.items():
        rows[name] = slice(first, first + z.o.shape[-1])
        first += z.o.shape[-1]
    if len(maps) == 1:
        return next(iter(maps.values())), rows
    return AffineMap(*(torch.cat(parts, dim=1) for parts in zip(*maps.values(), strict=True))), rows


def affine_map(system: ConstrainedSystem, at: States, quantity: str | Sequence[str]) -> AffineMap:
    """The affine map of a quantity, or of several one above the other; errors as of `affine_maps`."""
    return stack(affine_maps(system, at, quantity))[0]
