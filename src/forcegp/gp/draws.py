"""Random functions from a kernel's prior, as sums of random features that are evaluated anywhere."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeGuard

import torch
from torch import Tensor

from forcegp.gp.features import Features, stacked


class FunctionDraw(ABC):
    """Random functions drawn from a prior; evaluated anywhere."""

    @abstractmethod
    def basis(self, x: Features) -> Tensor:
        """φ(x) `(k, n, features)` with E[φ φ′ᵀ] = k(x, x′)."""

    def common(self) -> tuple[FunctionDraw, Tensor] | None:
        """One set of features for all components, `(1, n, features)`, and a factor for each component and
        feature `(k, features)`; `None` where components differ by more than factors."""
        return None

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of features of each component."""

    def terms(self, weights: Tensor) -> list[tuple[Callable[[Features], Tensor], Tensor]]:
        """φ(x)ᵀw as a sum that is cheaper to evaluate: features that components have in common only once.

        Args:
            weights: `(k, features, samples)`.

        Returns:
            Functions `(k or 1, n, terms)`, each with weights `(k, terms, samples)`.
        """
        common = self.common()
        if common is None:
            return [(self.basis, weights)]
        return [(common[0].basis, common[1][..., None] * weights)]


@dataclass(frozen=True)
class FourierDraw(FunctionDraw):
    """σ √(2/F) cos(ωᵀx + φ): random Fourier features of a stationary kernel."""

    inputs: tuple[str, ...] | None
    omega: Tensor
    phase: Tensor
    std: Tensor

    @property
    def size(self) -> int:
        return self.phase.shape[-1]

    def basis(self, x: Features) -> Tensor:
        angle = stacked(x, self.inputs) @ self.omega.mT + self.phase[:, None, :]
        scale = self.std * math.sqrt(2.0 / self.size)
        return scale[:, None, None] * torch.cos(angle)

    def common(self) -> tuple[FunctionDraw, Tensor] | None:
        if len(self.phase) > 1:
            return None
        unit = FourierDraw(self.inputs, self.omega, self.phase, torch.ones_like(self.std[:1]))
        return unit, self.std[:, None].expand(-1, self.phase.shape[-1])


@dataclass(frozen=True)
class LinearDraw(FunctionDraw):
    """Slopes and a bias: features of the linear kernel."""

    inputs: tuple[str, ...] | None
    slope: Tensor
    bias: Tensor

    @property
    def size(self) -> int:
        return self.slope.shape[-1] + 1

    def basis(self, x: Features) -> Tensor:
        scaled = stacked(x, self.inputs) * self.slope[:, None, :]
        bias = self.bias[:, None, None].expand(*scaled.shape[:2], 1)
        return torch.cat([scaled, bias], dim=-1)

    def common(self) -> tuple[FunctionDraw, Tensor]:
        unit = LinearDraw(self.inputs, torch.ones_like(self.slope[:1]), torch.ones_like(self.bias[:1]))
        return unit, torch.cat([self.slope, self.bias[:, None]], dim=-1)


@dataclass(frozen=True)
class ConstantDraw(FunctionDraw):
    """A constant per output."""

    std: Tensor

    @property
    def size(self) -> int:
        return 1

    def basis(self, x: Features) -> Tensor:
        n = stacked(x, None).shape[-2]
        return self.std[:, None, None].expand(-1, n, 1)

    def common(self) -> tuple[FunctionDraw, Tensor]:
        return ConstantDraw(torch.ones_like(self.std[:1])), self.std[:, None]


@dataclass(frozen=True)
class SumDraw(FunctionDraw):
    """Features of both terms."""

    left: FunctionDraw
    right: FunctionDraw

    @property
    def size(self) -> int:
        return self.left.size + self.right.size

    def terms(self, weights: Tensor) -> list[tuple[Callable[[Features], Tensor], Tensor]]:
        parts = weights.split([self.left.size, self.right.size], dim=1)
        return [*self.left.terms(parts[0]), *self.right.terms(parts[1])]

    def basis(self, x: Features) -> Tensor:
        return torch.cat([self.left.basis(x), self.right.basis(x)], dim=-1)

    def common(self) -> tuple[FunctionDraw, Tensor] | None:
        left, right = self.left.common(), self.right.common()
        if left is None or right is None:
            return None
        return SumDraw(left[0], right[0]), torch.cat([left[1], right[1]], dim=-1)


@dataclass(frozen=True)
class OuterDraw(FunctionDraw):
    """All pairs of the features of two factors."""

    left: FunctionDraw
    right: FunctionDraw

    @property
    def size(self) -> int:
        return self.left.size * self.right.size

    def terms(self, weights: Tensor) -> list[tuple[Callable[[Features], Tensor], Tensor]]:
        common = self.common()
        if common is None or not isinstance(common[0], OuterDraw) or not _is_square(common[0].left):
            return super().terms(weights)
        # The products ab and ba are the same function, so their weights add.
        pairs, rest = common[0].left, common[0].right
        count = pairs.left.size
        i, j = torch.triu_indices(count, count, device=weights.device)
        w = (common[1][..., None] * weights).unflatten(1, (count, count, rest.size))
        folded = (w + w.transpose(1, 2))[:, i, j] * torch.where(i == j, 0.5, 1.0)[:, None, None].to(w)
        return [(OuterDraw(SquareDraw(pairs.left), rest).basis, folded.flatten(1, 2))]

    def basis(self, x: Features) -> Tensor:
        return (self.left.basis(x)[..., :, None] * self.right.basis(x)[..., None, :]).flatten(-2)

    def common(self) -> tuple[FunctionDraw, Tensor] | None:
        left, right = self.left.common(), self.right.common()
        if left is None or right is None:
            return None
        return OuterDraw(left[0], right[0]), (left[1][:, :, None] * right[1][:, None, :]).flatten(-2)


@dataclass(frozen=True)
class ProductDraw(FunctionDraw):
    """Features of two factors, paired at random so that their number does not multiply."""

    left: FunctionDraw
    right: FunctionDraw
    features: int
    seed: int

    @property
    def size(self) -> int:
        return self.features

    def basis(self, x: Features) -> Tensor:
        return self._paired(self.left.basis(x), self.right.basis(x))

    def common(self) -> tuple[FunctionDraw, Tensor] | None:
        left, right = self.left.common(), self.right.common()
        if left is None or right is None:
            return None
        i, j = self._pairs(left[1].shape[-1], right[1].shape[-1])
        factors = left[1][:, i.to(left[1].device)] * right[1][:, j.to(right[1].device)]
        return ProductDraw(left[0], right[0], self.features, self.seed), factors

    def _paired(self, left: Tensor, right: Tensor) -> Tensor:
        n_left, n_right = left.shape[-1], right.shape[-1]
        i, j = (pair.to(left.device) for pair in self._pairs(n_left, n_right))
        return math.sqrt(n_left * n_right / self.features) * left[..., i] * right[..., j]

    def _pairs(self, n_left: int, n_right: int) -> tuple[Tensor, Tensor]:
        """Which features are multiplied."""
        return _random_pairs(n_left, n_right, self.features, self.seed)


@dataclass(frozen=True)
class SquareDraw(FunctionDraw):
    """All different products of two features of one factor."""

    factor: FunctionDraw

    @property
    def size(self) -> int:
        return self.factor.size * (self.factor.size + 1) // 2

    def basis(self, x: Features) -> Tensor:
        phi = self.factor.basis(x)
        i, j = torch.triu_indices(self.factor.size, self.factor.size, device=phi.device)
        return phi[..., i] * phi[..., j]


def _is_square(draw: FunctionDraw) -> TypeGuard[OuterDraw]:
    """Whether a draw has all products of the features of a linear kernel with themselves."""
    if not isinstance(draw, OuterDraw):
        return False
    left, right = draw.left, draw.right
    return (
        isinstance(left, LinearDraw)
        and isinstance(right, LinearDraw)
        and left.inputs == right.inputs
        and torch.equal(left.slope, right.slope)
        and torch.equal(left.bias, right.bias)
    )


@lru_cache(maxsize=64)
def _random_pairs(n_left: int, n_right: int, count: int, seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    i = torch.randint(n_left, (count,), generator=generator)
    return i, torch.randint(n_right, (count,), generator=generator)
