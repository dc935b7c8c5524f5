"""Arithmetic on many small vectors and matrices, with the batch as the last dimension.

Public tensors have their batch dimensions first. Inside kinematics and dynamics, the batch is flattened and
comes last, so that element-wise operations run over contiguous memory. The shapes are `(3, nq, B)` for
vectors per link, `(3, 3, nq, B)` for matrices per link, and `(nq, B)` for joint-space vectors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from forcegp.errors import MassMatrixError

_SMALL = 4096
"""Number of elements below which overhead dominates the run time of an operation."""


def batch_last(x: Tensor, tail: int) -> Tensor:
    """Convert a tensor `(*batch, *tail)` with `tail` trailing dimensions to a contiguous `(*tail, B)`."""
    shape = x.shape[x.ndim - tail :]
    flat = x.reshape((math.prod(x.shape[: x.ndim - tail]), *shape))
    return flat.movedim(0, -1).contiguous()


def batch_first(x: Tensor, batch: torch.Size) -> Tensor:
    """View a tensor `(*tail, B)` as a tensor `(*batch, *tail)`."""
    return x.movedim(-1, 0).reshape((*batch, *x.shape[:-1]))


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross product a × b over the first dimension, broadcasting over the others."""
    if a.numel() < _SMALL:
        return torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=0)
    (ax, ay, az), (bx, by, bz) = a, b
    x = torch.addcmul(ay * bz, az, by, value=-1)
    y = torch.addcmul(az * bx, ax, bz, value=-1)
    return torch.stack([x, y, torch.addcmul(ax * by, ay, bx, value=-1)])


def skew(v: Tensor) -> Tensor:
    """Return the skew-symmetric matrices [v]× `(3, 3, …)`, which satisfy [v]× w = v × w."""
    x, y, z = v
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).unflatten(0, (3, 3))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return Σ_k a_k b_k over the first dimension, broadcasting over the others."""
    if a.numel() < _SMALL and b.numel() < _SMALL:
        return (a * b).sum(0)
    total = a[0] * b[0]
    for k in range(1, len(a)):
        total = torch.addcmul(total, a[k], b[k])
    return total


def apply(A: Tensor, v: Tensor) -> Tensor:
    """Return the products A v of matrices `(r, k, …)` and vectors `(k, …)`."""
    return dot(A.transpose(0, 1), v.unsqueeze(1))


def product(A: Tensor, X: Tensor) -> Tensor:
    """Return the products A X of matrices `(r, k, …)` and `(k, c, …)`."""
    return dot(A.transpose(0, 1).unsqueeze(2), X.unsqueeze(1))


def sum_over(E: Tensor, x: Tensor) -> Tensor:
    """Return Σ_j E_ij x_j, summed over the joint dimension of x `(…, nq, B)`."""
    return E @ x


def take(x: Tensor, joints: Sequence[int]) -> Tensor:
    """Return the entries of x `(…, nq, B)` for the given joints; a view if the joints are evenly spaced."""
    first, last, count = joints[0], joints[-1], len(joints)
    step = (last - first) // (count - 1) if count > 1 else 1
    if step > 0 and list(joints) == list(range(first, last + 1, step)):
        return x[..., first : last + 1 : step, :]
    return x[..., list(joints), :]


def solve_spd(M: Tensor, rhs: Tensor) -> Tensor:
    """Return M⁻¹ rhs for symmetric positive definite matrices M `(n, n, B)` and rhs `(n, k, B)`.

    Large batches are solved by elimination without pivoting, which is stable for such matrices.
    """
    n, B = M.shape[0], M.shape[-1]
    if M.numel() < _SMALL:
        try:
            factor = torch.linalg.cholesky(M.movedim(-1, 0))
        except torch.linalg.LinAlgError as cause:  # pyright: ignore[reportPrivateImportUsage]
            raise MassMatrixError(cause) from cause
        return torch.cholesky_solve(rhs.movedim(-1, 0), factor).movedim(0, -1)
    rest, rows = torch.cat([M, rhs], dim=1), []
    for _ in range(n):
        rows.append(rest[0, 1:] / rest[0, 0])
        rest = torch.addcmul(rest[1:, 1:], rest[1:, :1], rows[-1], value=-1)
    x = rows[-1].unsqueeze(0)
    for row in reversed(rows[:-1]):
        solved = len(x)
        x = torch.cat([(row[solved:] - dot(row[:solved, None], x)).unsqueeze(0), x])
    return x.reshape(n, -1, B)
