"""Truncated square root of the inverse covariance of inducing points, and its derivative."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

TRUNCATION = 1e-12
"""Eigenvalues of the inducing points' covariance below this fraction of the largest are dropped.

Kernels are accurate to about 10⁻¹⁵ of their scale, so an eigenvalue at the threshold is to 10⁻³. Where the
prior is a million times as strong as the noise, a threshold of 10⁻¹⁰ loses what the data could tell.
"""


@dataclass(frozen=True)
class Spectrum:
    """Eigendecomposition of one component's K_zz, U Λ Uᵀ.

    Attributes:
        values: all eigenvalues, in ascending order `(m,)`.
        vectors: U `(m, m)`.
        dropped: how many of the smallest are dropped.
    """

    values: Tensor
    vectors: Tensor
    dropped: int

    @classmethod
    def of(cls, K: Tensor) -> Spectrum:
        """Of a symmetric matrix `(m, m)`."""
        values, vectors = torch.linalg.eigh(K)
        kept = values > TRUNCATION * values[-1] if len(values) else values > 0.0
        return cls(values, vectors, int((~kept).sum()))

    @property
    def root(self) -> Tensor:
        """R = U Λ^{−1/2} of the kept eigenvalues `(m, kept)`; R Rᵀ is the pseudo-inverse of K_zz."""
        return self.vectors[:, self.dropped :] * self.values[self.dropped :].rsqrt()

    def pull_back(self, dR: Tensor) -> Tensor:
        """Derivative for K_zz from that for R, of any function of the truncated pseudo-inverse R Rᵀ.

        Exact where no eigenvalue crosses the truncation: with E = UᵀdK U, dR = U X with
        X_jk = −½ E_jk λ_j⁻¹ λ_k^{−½} among kept ones and X_dk = E_dk λ_k^{−½} / (λ_k − λ_d) for dropped d.

        Args:
            dR: `(m, kept)`, or wider, filled up with columns that are not read.
        """
        values, first = self.values, self.dropped
        kept = values[first:]
        B = self.vectors.mT @ dR[:, : len(kept)]
        G = torch.zeros_like(self.vectors)
        G[first:, first:] = -0.5 * B[first:] * kept.rsqrt() / kept[:, None]
        G[:first, first:] = B[:first] * kept.rsqrt() / (kept - values[:first, None])
        dK = self.vectors @ G @ self.vectors.mT
        return 0.5 * (dK + dK.mT)
