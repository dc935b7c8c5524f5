"""Stationary kernels: covariance by scaled distance, with a length-scale for each input and output."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.gp.draws import FourierDraw, FunctionDraw
from forcegp.gp.features import Features, stacked
from forcegp.gp.kernels import Initial, Kernel, Parameters, width_of

LARGEST_EXPONENT = 300.0
"""exp(−300) is far below rounding and far above the denormal numbers that slow processors down."""


@dataclass(frozen=True)
class Stationary(Kernel):
    """σ² g(r) of the scaled distance r² = Σ_d (x_d − x′_d)² / ℓ_d² (automatic relevance determination).

    With `shared=True` the length-scales are those of all outputs, each with its own σ: fewer hyperparameters
    to overfit, and one distance to compute.
    """

    inputs: tuple[str, ...] | None = None
    shared: bool = False

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        width = width_of(self.inputs, widths)
        scale = math.log(math.sqrt(width))
        return {
            "log_lengthscale": torch.full((1 if self.shared else outputs, width), scale, dtype=torch.float64),
            "log_std": torch.zeros(outputs, dtype=torch.float64) + log_std,
        }

    @abstractmethod
    def profile(self, r2: Tensor) -> Tensor:
        """g as a function of r²."""

    def covariance(self, params: Parameters, x1: Features, x2: Features) -> Tensor:
        return self.towards(params, x2)(x1)

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        inverse = torch.exp(-params["log_lengthscale"])[:, None, :]
        b = stacked(x2, self.inputs) * inverse
        squares = (b * b).sum(-1)[:, None, :]
        variance = torch.exp(2.0 * params["log_std"])[:, None, None]

        def covariance(x1: Features) -> Tensor:
            a = stacked(x1, self.inputs) * inverse
            r2 = torch.baddbmm((a * a).sum(-1)[:, :, None] + squares, a, b.mT, alpha=-2.0)
            return variance * self.profile(r2)

        return covariance

    def diagonal(self, params: Parameters, x: Features) -> Tensor:
        n = next(iter(x.values())).shape[0]
        return torch.exp(2.0 * params["log_std"])[:, None].expand(-1, n)

    @abstractmethod
    def frequencies(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Draws from the spectral density of g at unit length-scales."""

    def draw(self, params: Parameters, features: int, generator: torch.Generator) -> FunctionDraw:
        lengthscale = params["log_lengthscale"].exp()
        # Components that share length-scales share frequencies too; their weights are independent.
        k, width = lengthscale.shape
        omega = self.frequencies((k, features, width), generator).to(lengthscale) / lengthscale[:, None, :]
        phase = 2.0 * math.pi * torch.rand(k, features, dtype=torch.float64, generator=generator)
        return FourierDraw(self.inputs, omega, phase.to(lengthscale), params["log_std"].exp())


@dataclass(frozen=True)
class SquaredExponential(Stationary):
    """k = σ² exp(−r²/2), a length-scale for each input and, unless shared, output (eq. 31)."""

    def profile(self, r2: Tensor) -> Tensor:
        return torch.exp((-0.5 * r2).clamp(-LARGEST_EXPONENT, 0.0))

    def frequencies(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator)


class _Matern(Stationary):
    degrees: int

    @staticmethod
    def _radius(r2: Tensor, degrees: int) -> Tensor:
        # The floor keeps the derivative of the square root finite where two inputs coincide.
        return (degrees * r2.clamp(min=1e-30)).sqrt().clamp(max=LARGEST_EXPONENT)

    def frequencies(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        normal = torch.randn(shape, dtype=torch.float64, generator=generator)
        chi2 = torch.randn(*shape[:-1], self.degrees, dtype=torch.float64, generator=generator)
        return normal / ((chi2**2).sum(-1, keepdim=True) / self.degrees).sqrt()


@dataclass(frozen=True)
class Matern32(_Matern):
    """k = σ² (1 + √3 r) exp(−√3 r)."""

    degrees = 3

    def profile(self, r2: Tensor) -> Tensor:
        r = self._radius(r2, 3)
        return (1.0 + r) * torch.exp(-r)


@dataclass(frozen=True)
class Matern52(_Matern):
    """k = σ² (1 + √5 r + 5r²/3) exp(−√5 r)."""

    degrees = 5

    def profile(self, r2: Tensor) -> Tensor:
        r = self._radius(r2, 5)
        return (1.0 + r + r * r / 3.0) * torch.exp(-r)
