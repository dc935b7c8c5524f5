"""Factorisations that report what they did: Cholesky with counted jitter, inverses in place, null spaces."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg.lapack
import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.threads import threads_of_pytorch

JITTER_STEPS = (0.0, 1e-14, 1e-12, 1e-10, 1e-8)
"""Fractions of the mean diagonal that are tried, in order, until the factorisation succeeds."""


def cholesky(K: Tensor) -> tuple[Tensor, float]:
    """Lower Cholesky factor of K + ε I, with the smallest ε of `JITTER_STEPS` that succeeds.

    Args:
        K: `(n, n)` symmetric; the lower triangle is read.

    Returns:
        The factor `(n, n)` and the ε that was added, 0.0 where none was needed.

    Raises:
        NumericalError: K is not finite, or not positive definite within the largest jitter.
    """
    scale = float(K.diagonal().mean()) if K.shape[-1] else 1.0
    if not torch.isfinite(K.diagonal()).all():
        raise NumericalError(
            "the covariance matrix is not finite", hint="look for extreme inputs or hyperparameters"
        )
    for step in JITTER_STEPS:
        jitter = step * scale
        shifted = K if jitter == 0.0 else K + jitter * torch.eye(len(K), dtype=K.dtype, device=K.device)
        L, info = torch.linalg.cholesky_ex(shifted)
        if int(info) == 0 and bool(torch.isfinite(L.diagonal()).all()):
            return L, jitter
    raise NumericalError(
        "the covariance matrix is not positive definite",
        expected=f"a smallest eigenvalue above −{JITTER_STEPS[-1]:g} of the mean diagonal",
        hint="drop duplicated rows, or raise the noise standard deviation",
    )


def cholesky_inverse_(L: Tensor) -> Tensor:
    """Lower triangle of (L Lᵀ)⁻¹, written over the factor L (LAPACK potri); the upper one is undefined."""
    if L.device.type != "cpu":
        return torch.cholesky_inverse(L)
    if L.shape[0] == 0:
        return L
    # A row-major lower triangle is the upper triangle in LAPACK's column-major order.
    array = L.numpy().T
    (potri,) = scipy.linalg.lapack.get_lapack_funcs(("potri",), (array,))
    with threads_of_pytorch():
        inverse, info = potri(array, lower=0, overwrite_c=1)
    if info != 0:
        raise NumericalError("a Cholesky factor is singular", got=f"zero pivot in row {info}")
    if not np.shares_memory(inverse, array):
        L.copy_(torch.from_numpy(inverse.T))
    return L


class _NullSpaceBasis(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, A: Tensor, rank: int) -> Tensor:
        left, values, Vh = torch.linalg.svd(A, full_matrices=True)
        U = Vh.mT[..., :, rank:].contiguous()
        # The rank is given, so the pseudo-inverse needs no tolerance of its own.
        pinv = (Vh.mT[..., :, :rank] / values[..., None, :rank]) @ left[..., :, :rank].mT
        ctx.save_for_backward(pinv, U)
        return U

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None]:
        pinv, U = ctx.saved_tensors
        return -(pinv.mT @ grad[0]) @ U.mT, None


def null_space_basis(A: Tensor, rank: int) -> Tensor:
    """Orthonormal basis U of the null space of matrices that share a rank, A U = 0, UᵀU = I.

    The basis is defined up to a rotation U R, so only functions that do not depend on R have a
    derivative; for these dU = −A⁺ dA U.

    Args:
        A: `(*batch, m, n)`.
        rank: the rank of every matrix of the batch.

    Returns:
        `(*batch, n, n − rank)`.
    """
    if A.shape[-2] == 0 or rank == 0:
        eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
        return eye.expand(*A.shape[:-2], *eye.shape)
    return _NullSpaceBasis.apply(A, rank)  # pyright: ignore[reportReturnType]
