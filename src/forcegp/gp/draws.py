"""Random functions from a kernel's prior, as sums of random features that are evaluated anywhere."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.gp.features import Features, stacked


class FunctionDraw(ABC):
    """Random functions drawn from a prior; evaluated anywhere."""

    @abstractmethod
    def basis(self, x: Features) -> Tensor:
        """φ(x) `(k, n, features)` with E[φ φ′ᵀ] = k(x, x′)."""


@dataclass(frozen=True)
class FourierDraw(FunctionDraw):
    """σ √(2/F) cos(ωᵀx + φ): random Fourier features of a stationary kernel."""

    inputs: tuple[str, ...] | None
    omega: Tensor
    phase: Tensor
    std: Tensor

    def basis(self, x: Features) -> Tensor:
        angle = stacked(x, self.inputs) @ self.omega.mT + self.phase[:, None, :]
        scale = self.std * math.sqrt(2.0 / self.phase.shape[-1])
        return scale[:, None, None] * torch.cos(angle)


@dataclass(frozen=True)
class LinearDraw(FunctionDraw):
    """Slopes and a bias: features of the linear kernel."""

    inputs: tuple[str, ...] | None
    slope: Tensor
    bias: Tensor

    def basis(self, x: Features) -> Tensor:
        scaled = stacked(x, self.inputs) * self.slope[:, None, :]
        return torch.cat([scaled, self.bias[:, None, None].expand(-1, scaled.shape[1], 1)], dim=-1)


@dataclass(frozen=True)
class ConstantDraw(FunctionDraw):
    """A constant per output."""

    std: Tensor

    def basis(self, x: Features) -> Tensor:
        n = stacked(x, None).shape[-2]
        return self.std[:, None, None].expand(-1, n, 1)


@dataclass(frozen=True)
class SumDraw(FunctionDraw):
    """Features of both terms."""

    left: FunctionDraw
    right: FunctionDraw

    def basis(self, x: Features) -> Tensor:
        return torch.cat([self.left.basis(x), self.right.basis(x)], dim=-1)


@dataclass(frozen=True)
class OuterDraw(FunctionDraw):
    """All pairs of the features of two factors."""

    left: FunctionDraw
    right: FunctionDraw

    def basis(self, x: Features) -> Tensor:
        return (self.left.basis(x)[..., :, None] * self.right.basis(x)[..., None, :]).flatten(-2)


@dataclass(frozen=True)
class ProductDraw(FunctionDraw):
    """Features of two factors, paired at random so that their number does not multiply."""

    left: FunctionDraw
    right: FunctionDraw
    features: int
    seed: int

    def basis(self, x: Features) -> Tensor:
        left, right = self.left.basis(x), self.right.basis(x)
        generator = torch.Generator().manual_seed(self.seed)
        n_left, n_right = left.shape[-1], right.shape[-1]
        i = torch.randint(n_left, (self.features,), generator=generator).to(left.device)
        j = torch.randint(n_right, (self.features,), generator=generator).to(left.device)
        scale = math.sqrt(n_left * n_right / self.features)
        return scale * left[..., i] * right[..., j]
