"""Cholesky factors with reported jitter, updates of factors for added rows, and spectra."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
import scipy.linalg.lapack
import torch
from torch import Tensor

from forcegp.errors import MissingDependencyError, NumericalError
from forcegp.native import load_library
from forcegp.resources import threads_of_pytorch

JITTER_STEPS = (0.0, 1e-14, 1e-12, 1e-10, 1e-8)
"""Fractions of the mean diagonal, tried in order until the factorisation succeeds."""
PANEL = 24
"""Block size of LAPACK's triangular-pentagonal QR."""
TRUNCATION = 1e-12
"""Fraction of the largest eigenvalue of the inducing-point covariance below which eigenvalues are dropped.
Kernels are accurate to about 10⁻¹⁵ of their scale, so an eigenvalue at the threshold is accurate to 10⁻³. If
the prior is a million times as strong as the noise, a threshold of 10⁻¹⁰ would discard information.
"""


def cholesky(K: Tensor) -> tuple[Tensor, float]:
    """Return the lower Cholesky factor of K + ε I for the smallest ε in `JITTER_STEPS` that succeeds.

    Args:
        K: `(n, n)` symmetric matrix; only the lower triangle is used.

    Returns:
        The factor `(n, n)` and the added ε, which is usually 0.0.

    Raises:
        NumericalError: K is not finite, or not positive definite even with the largest jitter.
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


def extended(L: Tensor, rows: Tensor) -> Tensor:
    """Return the lower factor of L Lᵀ + ΦᵀΦ in O(r n²), by QR factorisation of Lᵀ stacked on the rows Φ.

    If a C++ compiler is available, a compiled kernel is used; for a few rows, it is three to four times as
    fast as LAPACK. LAPACK may return negative diagonal entries, which are harmless in solves.

    Args:
        L: lower factor `(n, n)` on the CPU; contiguous columns are fastest.
        rows: additional rows Φ `(r, n)`.

    Raises:
        NumericalError: LAPACK rejects the arguments.
    """
    plain = all(x.dtype == torch.float64 and x.device.type == "cpu" for x in (L, rows))
    fits = L.shape[0] == L.shape[1] == rows.shape[1] and len(rows) > 0
    kernel = _kernel() if plain and fits else None
    if kernel is None:
        return _extended_by_lapack(L, rows)
    upper, below = L.mT.contiguous(), rows.clone(memory_format=torch.contiguous_format)
    result = torch.empty_like(upper)
    kernel(upper.data_ptr(), result.data_ptr(), below.data_ptr(), len(upper), len(below))
    return result.mT


@cache
def _kernel() -> Callable[[int, int, int, int, int], None] | None:
    """Return `extend` from `factor_rows.cpp`, or `None` if there is no compiler."""
    source = files("forcegp.gp").joinpath("factor_rows.cpp").read_text(encoding="utf-8")
    try:
        function = load_library(source, level="-O3").extend
    except MissingDependencyError:
        return None
    function.restype, function.argtypes = None, [ctypes.c_void_p] * 3 + [ctypes.c_int64] * 2
    return function


def _extended_by_lapack(L: Tensor, rows: Tensor) -> Tensor:
    upper, below = np.array(L.numpy().T, order="F"), np.array(rows.numpy(), order="F")
    (tpqrt,) = scipy.linalg.lapack.get_lapack_funcs(("tpqrt",), (upper,))
    # [Lᵀ; Φ] = Q R, so that Rᵀ R = L Lᵀ + Φᵀ Φ
    with threads_of_pytorch():
        R, _, _, info = tpqrt(0, min(PANEL, len(L)), upper, below, overwrite_a=1, overwrite_b=1)
    if info != 0:
        raise NumericalError("a Cholesky factor could not be updated", got=f"LAPACK tpqrt info {info}")
    return torch.from_numpy(R).mT


def bordered(L: Tensor, cross: Tensor, corner: Tensor) -> tuple[Tensor, float]:
    """Return the lower factor of [[L Lᵀ, C], [Cᵀ, K]], in O(r n²) for r new rows.

    Args:
        L: lower factor `(n, n)`.
        cross: C `(n, r)`.
        corner: K `(r, r)`; only its lower triangle is used.

    Returns:
        The factor `(n + r, n + r)` and the jitter added for the new rows.

    Raises:
        NumericalError: the matrix is not positive definite.
    """
    n, r = cross.shape
    # B = Cᵀ L⁻ᵀ
    below = torch.linalg.solve_triangular(L, cross, upper=False).mT
    # K − B Bᵀ = L_K L_Kᵀ
    corner_factor, jitter = cholesky(corner - below @ below.mT)
    # [[L, 0], [B, L_K]]
    whole = L.new_zeros(n + r, n + r)
    whole[:n, :n], whole[n:, :n], whole[n:, n:] = L, below, corner_factor
    return whole, jitter


@dataclass(frozen=True)
class Spectrum:
    """Eigendecomposition U Λ Uᵀ of K_zz for one component.

    Attributes:
        values: all eigenvalues, in ascending order `(m,)`.
        vectors: U `(m, m)`.
        dropped: number of dropped eigenvalues, which are the smallest ones.
    """

    values: Tensor
    vectors: Tensor
    dropped: int

    @classmethod
    def of(cls, K: Tensor) -> Spectrum:
        """Decompose a symmetric matrix `(m, m)`."""
        values, vectors = torch.linalg.eigh(K)
        kept = values > TRUNCATION * values[-1] if len(values) else values > 0.0
        return cls(values, vectors, int((~kept).sum()))

    @property
    def root(self) -> Tensor:
        """R = U Λ^{−1/2} `(m, kept)` for the eigenvalues kept; R Rᵀ is the pseudo-inverse of K_zz."""
        return self.vectors[:, self.dropped :] * self.values[self.dropped :].rsqrt()
