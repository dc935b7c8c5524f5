"""Covariance functions of independent latent outputs.

A kernel describes `k` independent outputs; its covariance has shape `(k, n, n')`. Inputs are standardized
named features, `{"q": (n, w), "qd": (n, w), …}`. A kernel uses those listed in `inputs`, or all of them. The
logarithms of the hyperparameters are passed in a flat dictionary, so one optimiser handles every kernel.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp.errors import ModelError, UnknownNameError
from forcegp.gp.features import (
    FeatureMap,
    Features,
    constant_features,
    fourier_features,
    linear_features,
    points,
    stacked,
)

Parameters = Mapping[str, Tensor]
Initial = dict[str, Tensor]

LARGEST_EXPONENT = 300.0
"""Bound on exponents; exp(−300) is far below rounding error but far above (slow) denormal numbers."""
LINEAR_PAIRS = 8
"""Divisor of the number of random features of a kernel, for each linear kernel that it is multiplied by."""


def sub(params: Parameters, prefix: str) -> dict[str, Tensor]:
    """Return the entries named `prefix.*`, with the prefix removed from their names."""
    return {key[len(prefix) + 1 :]: value for key, value in params.items() if key.startswith(prefix + ".")}


class Kernel(ABC):
    """A covariance function of `k` independent outputs."""

    is_finite: bool = False
    """Whether k(x, x′) = φ(x)ᵀφ(x′) with finitely many features φ."""

    @abstractmethod
    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        """Return the initial log-hyperparameters.

        Args:
            outputs: number of outputs.
            widths: number of columns of each feature.
            log_std: logarithm of the standard deviation of the functions, as one value or one per output.
        """

    @abstractmethod
    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        """Return the function x ↦ k(x, x′) `(k, n, n')` for fixed x′. Terms in x′ are precomputed."""

    def covariance(self, params: Parameters, x1: Features, x2: Features) -> Tensor:
        """Return k(x, x′) `(k, n, n')`."""
        return self.towards(params, x2)(x1)

    @abstractmethod
    def variance(self, params: Parameters) -> Callable[[Features], Tensor]:
        """Return the function x ↦ k(x, x) `(k, n)`. Terms in the hyperparameters are precomputed."""

    def diagonal(self, params: Parameters, x: Features) -> Tensor:
        """Return k(x, x) `(k, n)`."""
        return self.variance(params)(x)

    @abstractmethod
    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        """Draw `features` random features per output to represent functions from the prior.

        Linear and constant kernels have a fixed number of exact features instead.

        Args:
            params: log-hyperparameters.
            x: any inputs; only their widths are used.
            features: number of random features.
            generator: source of randomness, on the CPU.
        """

    def __add__(self, other: Kernel) -> Kernel:
        return Sum(self, other)

    def __mul__(self, other: Kernel) -> Kernel:
        return Product(self, other)


def sides(left: Parameters, right: Parameters) -> Initial:
    """Merge the hyperparameters of two kernels into one dictionary."""
    parts = (("left", left), ("right", right))
    return {f"{side}.{key}": value for side, part in parts for key, value in part.items()}


def width_of(inputs: tuple[str, ...] | None, widths: Mapping[str, int]) -> int:
    """Return the number of input columns that a kernel uses.

    Raises:
        UnknownNameError: an input is missing.
        ModelError: there are no inputs.
    """
    names = tuple(widths) if inputs is None else inputs
    for name in names:
        if name not in widths:
            raise UnknownNameError("kernel input", name, widths)
    if not names:
        raise ModelError("a kernel without inputs", expected=f"some of {', '.join(widths)}, or None for all")
    return sum(widths[name] for name in names)


@dataclass(frozen=True)
class Linear(Kernel):
    """Functions that are linear in the inputs: k = s² Σ_d σ_d² x_d x′_d + σ_0².

    Two options reduce the number of hyperparameters. With `ard=False`, all inputs have the same σ, so
    learning cannot set individual slopes to zero. With `shared=True`, all outputs share the σ_d but have
    separate s and σ_0. If `offset` is given, σ_0 is a learned fraction (initially `offset`) of the root mean
    square of the σ_d. All outputs share this fraction, since a single constant does not determine σ_0.
    Otherwise, `constant` is the ratio of the initial σ_0 and σ_d.
    """

    inputs: tuple[str, ...] | None = None
    ard: bool = True
    shared: bool = False
    offset: float | None = None
    constant: float = 1.0

    is_finite = True

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        width = width_of(self.inputs, widths)
        # Standardized inputs have unit variance, so all columns and the bias get the same share.
        bias = 1.0 if self.offset is None else self.offset**2
        share = torch.zeros(outputs, dtype=torch.float64) + log_std - 0.5 * math.log(width + bias)
        columns = width if self.ard else 1
        slopes = share.new_zeros(1, columns) if self.shared else share[:, None].repeat(1, columns)
        sizes = {"log_slope_std": slopes} | ({"log_std": share} if self.shared else {})
        if self.offset is None:
            return sizes | {"log_bias_std": share + math.log(self.constant)}
        return sizes | {"log_offset": share.new_tensor([math.log(self.offset)])}

    def slope_std(self, params: Parameters) -> Tensor:
        """Return s σ_d `(k, w)`, or `(k, 1)` if all inputs share one σ."""
        log = params["log_slope_std"]
        return torch.exp(log + params["log_std"][:, None] if self.shared else log)

    def bias_std(self, params: Parameters) -> Tensor:
        """Return σ_0 `(k,)`."""
        if self.offset is None:
            return torch.exp(params["log_bias_std"])
        return torch.exp(params["log_offset"]) * self.slope_std(params).square().mean(-1).sqrt()

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        # k = Σ_d (s σ_d x_d)(s σ_d x′_d) + σ_0²
        slope = self.slope_std(params)[:, None, :]
        b, bias = (stacked(x2, self.inputs) * slope).mT, self.bias_std(params).square()[:, None, None]
        return lambda x1: (stacked(x1, self.inputs) * slope) @ b + bias

    def variance(self, params: Parameters) -> Callable[[Features], Tensor]:
        slope, bias = self.slope_std(params)[:, None, :], self.bias_std(params).square()[:, None]
        return lambda x: (stacked(x, self.inputs) * slope).square().sum(-1) + bias

    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        return linear_features(x, self.inputs, self.slope_std(params), self.bias_std(params))


@dataclass(frozen=True)
class Columns(Linear):
    """Functions that are linear in the inputs, without a constant: k = Σ_d σ_d² x_d x′_d for each output."""

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        width = width_of(self.inputs, widths)
        share = torch.zeros(outputs, dtype=torch.float64) + log_std - 0.5 * math.log(width)
        return {"log_slope_std": share[:, None].repeat(1, width if self.ard else 1)}

    def bias_std(self, params: Parameters) -> Tensor:
        return torch.zeros_like(self.slope_std(params)[:, 0])

    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        return linear_features(x, self.inputs, self.slope_std(params))


@dataclass(frozen=True)
class Constant(Kernel):
    """Constants: k = s², with one standard deviation s (initially 1) per `group` of outputs."""

    group: int = 1

    is_finite = True

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        return {"log_scale": torch.zeros(outputs // self.group, dtype=torch.float64)}

    def std(self, params: Parameters) -> Tensor:
        """Return s `(k,)`."""
        return params["log_scale"].exp().repeat_interleave(self.group)

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        variance, n2 = (self.std(params) ** 2)[:, None, None], stacked(x2, None).shape[-2]
        return lambda x1: variance.expand(-1, stacked(x1, None).shape[-2], n2)

    def variance(self, params: Parameters) -> Callable[[Features], Tensor]:
        variance = (self.std(params) ** 2)[:, None]
        return lambda x: variance.expand(-1, stacked(x, None).shape[-2])

    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        return constant_features(self.std(params))


@dataclass(frozen=True)
class Stationary(Kernel):
    """k = σ² g(r) with the scaled distance r² = Σ_d (x_d − x′_d)² / ℓ_d² (automatic relevance determination).

    With `shared=True`, all outputs share the length-scales but have separate σ. This reduces the number of
    hyperparameters, and only one distance needs to be computed.
    """

    inputs: tuple[str, ...] | None = None
    shared: bool = False

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        width = width_of(self.inputs, widths)
        shape, scale = (1 if self.shared else outputs, width), math.log(math.sqrt(width))
        std = torch.zeros(outputs, dtype=torch.float64) + log_std
        return {"log_lengthscale": torch.full(shape, scale, dtype=torch.float64), "log_std": std}

    @abstractmethod
    def profile(self, r2: Tensor) -> Tensor:
        """Return g as a function of r²."""

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        inverse = torch.exp(-params["log_lengthscale"])[:, None, :]
        b = stacked(x2, self.inputs) * inverse
        squares = vecdot(b, b)[:, None, :]
        variance = torch.exp(2.0 * params["log_std"])[:, None, None]

        def covariance(x1: Features) -> Tensor:
            # r² = |a|² + |b|² − 2 aᵀb with a = x/ℓ and b = x′/ℓ; k = σ² g(r²)
            a = stacked(x1, self.inputs) * inverse
            r2 = torch.baddbmm(vecdot(a, a)[:, :, None] + squares, a, b.mT, alpha=-2.0)
            return variance * self.profile(r2)

        return covariance

    def variance(self, params: Parameters) -> Callable[[Features], Tensor]:
        variance = torch.exp(2.0 * params["log_std"])[:, None]
        return lambda x: variance.expand(-1, points(x))

    @abstractmethod
    def frequencies(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Sample from the spectral density of g for unit length-scales."""

    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        lengthscale = params["log_lengthscale"].exp()
        # ω ~ p(ω)/ℓ, φ ~ U(0, 2π); components that share length-scales share ω but not the weights.
        k, width = lengthscale.shape
        omega = self.frequencies((k, features, width), generator).to(lengthscale) / lengthscale[:, None, :]
        phase = 2.0 * math.pi * torch.rand(k, features, dtype=torch.float64, generator=generator)
        return fourier_features(self.inputs, omega, phase.to(lengthscale), params["log_std"].exp())


@dataclass(frozen=True)
class SquaredExponential(Stationary):
    """k = σ² exp(−r²/2) with one length-scale per input and, unless shared, per output (eq. 31)."""

    def profile(self, r2: Tensor) -> Tensor:
        return torch.exp((-0.5 * r2).clamp(-LARGEST_EXPONENT, 0.0))

    def frequencies(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator)


class _Matern(Stationary):
    degrees: int

    def _radius(self, r2: Tensor) -> Tensor:
        # The lower bound keeps the derivative of the square root finite if two inputs coincide.
        return (self.degrees * r2.clamp(min=1e-30)).sqrt().clamp(max=LARGEST_EXPONENT)

    def frequencies(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        # ω = z/√(χ²_ν/ν): a Student t distribution with ν = 2 s degrees of freedom at smoothness s
        normal = torch.randn(shape, dtype=torch.float64, generator=generator)
        chi2 = torch.randn(*shape[:-1], self.degrees, dtype=torch.float64, generator=generator)
        return normal / ((chi2**2).sum(-1, keepdim=True) / self.degrees).sqrt()


@dataclass(frozen=True)
class Matern32(_Matern):
    """k = σ² (1 + √3 r) exp(−√3 r)."""

    degrees = 3

    def profile(self, r2: Tensor) -> Tensor:
        r = self._radius(r2)
        return (1.0 + r) * torch.exp(-r)


@dataclass(frozen=True)
class Matern52(_Matern):
    """k = σ² (1 + √5 r + 5r²/3) exp(−√5 r)."""

    degrees = 5

    def profile(self, r2: Tensor) -> Tensor:
        r = self._radius(r2)
        return (1.0 + r + r * r / 3.0) * torch.exp(-r)


@dataclass(frozen=True)
class Sum(Kernel):
    """k = k_1 + k_2 (remark 3.2)."""

    left: Kernel
    right: Kernel

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        half = log_std - 0.5 * math.log(2.0)
        return sides(self.left.initial(outputs, widths, half), self.right.initial(outputs, widths, half))

    @staticmethod
    def combined(left: Tensor, right: Tensor) -> Tensor:
        """Combine the covariances of the two kernels."""
        return left + right

    @property
    def is_finite(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.left.is_finite and self.right.is_finite

    def parts(self, params: Parameters) -> tuple[tuple[Kernel, Initial], tuple[Kernel, Initial]]:
        """Return each of the two kernels with its hyperparameters."""
        return (self.left, sub(params, "left")), (self.right, sub(params, "right"))

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        left, right = (kernel.towards(theta, x2) for kernel, theta in self.parts(params))
        return lambda x1: self.combined(left(x1), right(x1))

    def variance(self, params: Parameters) -> Callable[[Features], Tensor]:
        left, right = (kernel.variance(theta) for kernel, theta in self.parts(params))
        return lambda x: self.combined(left(x), right(x))

    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        left, right = (kernel.draw(theta, x, features, generator) for kernel, theta in self.parts(params))
        return left + right


@dataclass(frozen=True)
class Product(Sum):
    """k = k_1 k_2, where the second factor initially has unit standard deviation."""

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        return sides(self.left.initial(outputs, widths, log_std), self.right.initial(outputs, widths))

    @staticmethod
    def combined(left: Tensor, right: Tensor) -> Tensor:
        return left * right

    def draw(self, params: Parameters, x: Features, features: int, generator: torch.Generator) -> FeatureMap:
        # Sums are expanded: their terms have features of unequal number and size, and those of a term with
        # few features would seldom be selected among those of the other terms.
        for side, other in (("left", "right"), ("right", "left")):
            inner = getattr(self, side)
            if isinstance(inner, Sum) and not isinstance(inner, Product):
                terms = (
                    Product(getattr(inner, part), getattr(self, other)).draw(
                        sides(sub(params, f"{side}.{part}"), sub(params, other)), x, features, generator
                    )
                    for part in ("left", "right")
                )
                return next(terms) + next(terms)
        linear = max(_linear_factors(self.left), _linear_factors(self.right))
        # A linear factor has few features, all of which matter, so the other factor is given fewer.
        few = max(1, features // (LINEAR_PAIRS * linear)) if linear else features
        left, right = (kernel.draw(theta, x, few, generator) for kernel, theta in self.parts(params))
        return left * right if linear else left.paired(right, features, generator)


def _linear_factors(kernel: Kernel) -> int:
    """Return the number of factors in a product of linear kernels; 0 if there is any other factor."""
    if isinstance(kernel, Product):
        left, right = _linear_factors(kernel.left), _linear_factors(kernel.right)
        return left + right if left and right else 0
    return int(isinstance(kernel, Linear))


@runtime_checkable
class Process(Protocol):
    """A Gaussian process defined by its kernel and the prefix of its hyperparameters."""

    @property
    def kernel(self) -> Kernel:
        """Covariance of each component."""
        ...

    @property
    def prefix(self) -> str:
        """Prefix of the hyperparameters. Processes with the same prefix share their hyperparameters."""
        ...
