"""Which part of a kernel is a finite number of features, and which part needs inducing points.

A sum of linear kernels and of products of linear kernels is k(x, x′) = φ(x)ᵀφ(x′) exactly, with a few
features φ. The rest, whatever contains a stationary factor, is approximated with inducing points, through
the truncated square root R of the inverse of their covariance, R Rᵀ = K_zz⁺.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from forcegp.gp.draws import FunctionDraw
from forcegp.gp.kernels import Constant, Kernel, Linear, Parameters, Product, Sum, sub

EXACT: tuple[type[Kernel], ...] = (Linear, Constant)
"""Kernels without factors whose `draw` holds all their features, whatever number it is asked for."""


@dataclass(frozen=True)
class KernelPart:
    """A kernel made of factors of another one.

    Attributes:
        kernel: the sum of products of the factors.
        names: the prefix of each factor's hyperparameters here, and in the whole kernel.
    """

    kernel: Kernel
    names: Mapping[str, str]

    def parameters(self, whole: Parameters) -> dict[str, torch.Tensor]:
        """The part's hyperparameters among those of the whole kernel."""
        params = {}
        for here, there in self.names.items():
            factor = sub(whole, there) if there else whole
            params |= {f"{here}.{key}" if here else key: value for key, value in factor.items()}
        return params

    def features(self, whole: Parameters) -> FunctionDraw:
        """φ of a finite part: features whose products are the kernel exactly."""
        # Such a draw takes no random number, so any generator does.
        return self.kernel.draw(self.parameters(whole), 1, torch.Generator())


@dataclass(frozen=True)
class KernelSplit:
    """A kernel as the sum of a finite part and the rest.

    Attributes:
        finite: sums and products of linear kernels.
        rest: everything else.
    """

    finite: KernelPart | None
    rest: KernelPart | None


def split(kernel: Kernel) -> KernelSplit:
    """The finite part of a kernel and the rest; products of sums are multiplied out where needed."""
    finite, rest = _terms(kernel, "")
    return KernelSplit(_sum(finite), _sum(rest))


def _terms(kernel: Kernel, path: str) -> tuple[list[KernelPart], list[KernelPart]]:
    """Terms with and without a finite number of features."""
    if isinstance(kernel, EXACT):
        return [KernelPart(kernel, {"": path})], []
    if not isinstance(kernel, Sum):
        return [], [KernelPart(kernel, {"": path})]
    sides = [_terms(getattr(kernel, side), f"{path}.{side}".lstrip(".")) for side in ("left", "right")]
    (finite_left, rest_left), (finite_right, rest_right) = sides
    if not isinstance(kernel, Product):
        return finite_left + finite_right, rest_left + rest_right
    if not finite_left or not finite_right:
        return [], [KernelPart(kernel, {"": path})]
    finite = [_join(Product, a, b) for a in finite_left for b in finite_right]
    rest = [_join(Product, a, b) for a in finite_left for b in rest_right]
    rest += [_join(Product, a, b) for a in rest_left for b in finite_right + rest_right]
    return finite, rest


def _join(kind: type[Sum], left: KernelPart, right: KernelPart) -> KernelPart:
    names = {f"left.{key}".rstrip("."): path for key, path in left.names.items()}
    names |= {f"right.{key}".rstrip("."): path for key, path in right.names.items()}
    return KernelPart(kind(left.kernel, right.kernel), names)


def _sum(terms: list[KernelPart]) -> KernelPart | None:
    return reduce(lambda a, b: _join(Sum, a, b), terms) if terms else None


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
        # B = Uᵀ ∂F/∂R
        values, first = self.values, self.dropped
        kept = values[first:]
        B = self.vectors.mT @ dR[:, : len(kept)]
        # G_jk = −½ B_jk λ_j⁻¹ λ_k^{−½} among kept ones, G_dk = B_dk λ_k^{−½} / (λ_k − λ_d) for dropped d
        G = torch.zeros_like(self.vectors)
        G[first:, first:] = -0.5 * B[first:] * kept.rsqrt() / kept[:, None]
        G[:first, first:] = B[:first] * kept.rsqrt() / (kept - values[:first, None])
        # ∂F/∂K_zz = U G Uᵀ, made symmetric
        dK = self.vectors @ G @ self.vectors.mT
        return 0.5 * (dK + dK.mT)
