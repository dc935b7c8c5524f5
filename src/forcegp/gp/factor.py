"""Cholesky factors that follow added rows."""

from __future__ import annotations

import numpy as np
import scipy.linalg.lapack
import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.threads import threads_of_pytorch

PANEL = 24
"""Columns that LAPACK's triangular-pentagonal QR takes at a time."""


def extended(L: Tensor, rows: Tensor) -> Tensor:
    """Lower factor of L Lᵀ + ΦᵀΦ, from the QR factorisation of Lᵀ above the rows Φ, in O(r n²).

    Its diagonal may be negative, which solves do not mind.

    Args:
        L: lower factor on the CPU `(n, n)`.
        rows: Φ `(r, n)`.

    Raises:
        NumericalError: LAPACK refuses the arguments.
    """
    upper, below = np.array(L.numpy().T, order="F"), np.array(rows.numpy(), order="F")
    (tpqrt,) = scipy.linalg.lapack.get_lapack_funcs(("tpqrt",), (upper,))
    with threads_of_pytorch():
        R, _, _, info = tpqrt(0, min(PANEL, len(L)), upper, below, overwrite_a=1, overwrite_b=1)
    if info != 0:
        raise NumericalError("a Cholesky factor could not be updated", got=f"LAPACK tpqrt info {info}")
    return torch.from_numpy(R).mT
