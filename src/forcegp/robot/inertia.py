"""Inertial parameters of a rigid body, in coordinates that are always physically consistent.

A body has the ten parameters π = (m, m c, I_o), where I_o is the inertia about the link origin. They
correspond to a mass distribution if and only if the pseudo-inertia J = [[Σ, m c], [m cᵀ, m]] with Σ = ½
tr(I_o) 1 − I_o is positive definite (Wensing, Kim, Slotine, RA-L 2018). The log-Cholesky coordinates θ of
Rucker and Wensing, *Smooth parameterization of rigid-body inertia* (RA-L 2022), parametrise exactly these J.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InertiaError
from forcegp.types import Rotation, Scalars, Vector3

PseudoInertia = Float[Tensor, "*batch 4 4"]
InertialParameters = Float[Tensor, "*batch 10"]


def pseudo_inertia(mass: Scalars, com: Vector3, inertia: Rotation) -> PseudoInertia:
    """Return J = [[Σ, m c], [m cᵀ, m]] `(*batch, 4, 4)` with Σ = ½ tr(I_c) 1 − I_c + m c cᵀ.

    J is positive definite if the parameters are physical. `com` is the centre of mass in the link frame [m].
    `inertia` is the inertia about the centre of mass in link axes [kg m²].
    """
    eye = torch.eye(3, dtype=inertia.dtype, device=inertia.device)
    half_trace = 0.5 * inertia.diagonal(dim1=-2, dim2=-1).sum(-1)
    h = mass[..., None] * com
    Sigma = half_trace[..., None, None] * eye - inertia + h[..., :, None] * com[..., None, :]
    top = torch.cat([Sigma, h[..., :, None]], dim=-1)
    bottom = torch.cat([h, mass[..., None]], dim=-1)[..., None, :]
    return torch.cat([top, bottom], dim=-2)


def pseudo_inertia_of(pi: InertialParameters) -> PseudoInertia:
    """Return J `(*batch, 4, 4)`, which is linear in π `(*batch, 10)`."""
    I = pi[..., [4, 5, 6, 5, 7, 8, 6, 8, 9]].unflatten(-1, (3, 3))
    half_trace = 0.5 * I.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    top = torch.cat([half_trace * torch.eye(3).to(I) - I, pi[..., 1:4, None]], dim=-1)
    return torch.cat([top, torch.cat([pi[..., None, 1:4], pi[..., None, :1]], dim=-1)], dim=-2)


def from_pseudo_inertia(J: PseudoInertia) -> tuple[Scalars, Vector3, Rotation]:
    """Return the mass, centre of mass and inertia about it from J (the inverse of `pseudo_inertia`)."""
    mass = J[..., 3, 3]
    com = J[..., :3, 3] / mass[..., None]
    Sigma = J[..., :3, :3] - mass[..., None, None] * com[..., :, None] * com[..., None, :]
    eye = torch.eye(3, dtype=J.dtype, device=J.device)
    return mass, com, Sigma.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * eye - Sigma


def from_log_cholesky(theta: InertialParameters) -> PseudoInertia:
    """Return J = U Uᵀ from log-Cholesky coordinates θ = (α, d1, d2, d3, s12, s23, s13, t1, t2, t3).

    U = e^α [[e^{d1}, s12, s13, t1], [0, e^{d2}, s23, t2], [0, 0, e^{d3}, t3], [0, 0, 0, 1]]. J > 0 for all θ.
    """
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = theta.unbind(-1)
    zero, one = torch.zeros_like(alpha), torch.ones_like(alpha)
    rows = (
        (d1.exp(), s12, s13, t1),
        (zero, d2.exp(), s23, t2),
        (zero, zero, d3.exp(), t3),
        (zero, zero, zero, one),
    )
    U = alpha.exp()[..., None, None] * torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return U @ U.mT


def log_cholesky(J: PseudoInertia) -> InertialParameters:
    """Return θ `(*batch, 10)` from J (inverse of `from_log_cholesky`); raise `InertiaError` unless J > 0."""
    # An upper factor is the lower factor of the matrix with rows and columns reversed.
    lower, info = torch.linalg.cholesky_ex(J.flip(-1, -2))
    if bool((info != 0).any()):
        raise InertiaError(
            "the pseudo-inertia is not positive definite",
            expected="positive mass and principal moments that obey the triangle inequality strictly",
            got=f"smallest eigenvalue {float(torch.linalg.eigvalsh(J).min().detach()):.4g}",
        )
    U = lower.flip(-1, -2)
    scale = U[..., 3, 3]
    V = U / scale[..., None, None]
    d = V.diagonal(dim1=-2, dim2=-1)[..., :3].log()
    s = torch.stack([V[..., 0, 1], V[..., 1, 2], V[..., 0, 2]], dim=-1)
    return torch.cat([scale.log()[..., None], d, s, V[..., :3, 3]], dim=-1)


def inertial_parameters(mass: Scalars, com: Vector3, inertia: Rotation) -> InertialParameters:
    """Return π = (m, m c, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz) about the link origin, `(*batch, 10)`."""
    m = mass[..., None]
    eye = torch.eye(3, dtype=com.dtype, device=com.device)
    square = (com * com).sum(-1)[..., None, None] * eye - com[..., :, None] * com[..., None, :]
    I = inertia + m[..., None] * square
    rows, columns = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
    return torch.cat([m, m * com, I[..., rows, columns]], dim=-1)
