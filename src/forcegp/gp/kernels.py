"""Covariance functions of independent latent outputs, as frozen descriptions on a dictionary of parameters.

A kernel serves `k` independent outputs at once: its covariance is `(k, n, n')`. Inputs are named
features, `{"q": (n, w), "qd": (n, w), …}`, already standardized; a kernel reads those named in `inputs`,
or all. Hyperparameters are logarithms, in a flat dictionary, so that one optimiser serves every kernel.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.errors import ModelError, UnknownNameError
from forcegp.gp.draws import ConstantDraw, FunctionDraw, LinearDraw, OuterDraw, ProductDraw, SumDraw
from forcegp.gp.features import Features, stacked

Parameters = Mapping[str, Tensor]
Initial = dict[str, Tensor]

LINEAR_PAIRS = 8
"""How many times fewer random features a factor of a product has for each linear factor of the other one."""


def sub(params: Parameters, prefix: str) -> dict[str, Tensor]:
    """The entries `prefix.*`, without the prefix."""
    return {key[len(prefix) + 1 :]: value for key, value in params.items() if key.startswith(prefix + ".")}


class Kernel(ABC):
    """A covariance function of `k` independent outputs."""

    @abstractmethod
    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        """Initial log-hyperparameters.

        Args:
            outputs: number of outputs.
            widths: columns of each feature.
            log_std: logarithm of the standard deviation of the functions, one or one an output.
        """

    @abstractmethod
    def covariance(self, params: Parameters, x1: Features, x2: Features) -> Tensor:
        """k(x, x′) `(k, n, n')`."""

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        """x ↦ k(x, x′) `(k, n, n')` for fixed x′, with what depends on x′ alone computed once."""
        return lambda x1: self.covariance(params, x1, x2)

    @abstractmethod
    def diagonal(self, params: Parameters, x: Features) -> Tensor:
        """k(x, x) `(k, n)`."""

    @abstractmethod
    def draw(self, params: Parameters, features: int, generator: torch.Generator) -> FunctionDraw:
        """Random functions from the prior, as `features` random features an output."""

    def __add__(self, other: Kernel) -> Kernel:
        return Sum(self, other)

    def __mul__(self, other: Kernel) -> Kernel:
        return Product(self, other)


def _sides(left: Initial, right: Initial) -> Initial:
    """The hyperparameters of two kernels in one dictionary."""
    sides = {"left": left, "right": right}
    return {f"{side}.{key}": value for side, part in sides.items() for key, value in part.items()}


def width_of(inputs: tuple[str, ...] | None, widths: Mapping[str, int]) -> int:
    """Number of columns that a kernel reads.

    Raises:
        UnknownNameError: an input is not given.
        ModelError: there is no input.
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
    """k = s² Σ_d σ_d² x_d x′_d + σ_0²: functions that are linear in the inputs.

    Fewer hyperparameters to overfit: with `ard=False` all inputs have one σ, and there is no slope that
    learning takes for zero; with `shared=True` the σ_d are those of all outputs, each with its own s and σ_0.
    With an `offset` σ_0 is that fraction of the root mean square σ_d: a learned ratio, which starts there and
    is the same for all outputs. One output alone does not show which σ_0 its one constant was drawn from.
    """

    inputs: tuple[str, ...] | None = None
    ard: bool = True
    shared: bool = False
    offset: float | None = None

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        width = width_of(self.inputs, widths)
        # Standardized inputs have unit variance: every column and the bias get the same share.
        bias = 1.0 if self.offset is None else self.offset**2
        share = torch.zeros(outputs, dtype=torch.float64) + log_std - 0.5 * math.log(width + bias)
        columns = width if self.ard else 1
        if self.shared:
            slopes = {"log_slope_std": share.new_zeros(1, columns), "log_std": share}
        else:
            slopes = {"log_slope_std": share[:, None].repeat(1, columns)}
        if self.offset is None:
            return slopes | {"log_bias_std": share}
        return slopes | {"log_offset": share.new_tensor([math.log(self.offset)])}

    def _slope_std(self, params: Parameters) -> Tensor:
        """s σ_d `(k, w)`, or `(k, 1)` where all inputs have one."""
        log = params["log_slope_std"]
        return torch.exp(log + params["log_std"][:, None] if self.shared else log)

    def _bias_std(self, params: Parameters) -> Tensor:
        """σ_0 `(k,)`."""
        if self.offset is None:
            return torch.exp(params["log_bias_std"])
        return torch.exp(params["log_offset"]) * self._slope_std(params).square().mean(-1).sqrt()

    def covariance(self, params: Parameters, x1: Features, x2: Features) -> Tensor:
        slope = self._slope_std(params)[:, None, :]
        product = (stacked(x1, self.inputs) * slope) @ (stacked(x2, self.inputs) * slope).mT
        return product + self._bias_std(params).square()[:, None, None]

    def diagonal(self, params: Parameters, x: Features) -> Tensor:
        scaled = stacked(x, self.inputs) * self._slope_std(params)[:, None, :]
        return (scaled * scaled).sum(-1) + self._bias_std(params).square()[:, None]

    def draw(self, params: Parameters, features: int, generator: torch.Generator) -> FunctionDraw:
        return LinearDraw(self.inputs, self._slope_std(params), self._bias_std(params))


@dataclass(frozen=True)
class Constant(Kernel):
    """k = s²: constants, with one standard deviation s for each `group` of outputs, 1 at the start."""

    group: int = 1

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        return {"log_scale": torch.zeros(outputs // self.group, dtype=torch.float64)}

    def _std(self, params: Parameters) -> Tensor:
        return params["log_scale"].exp().repeat_interleave(self.group)

    def covariance(self, params: Parameters, x1: Features, x2: Features) -> Tensor:
        n1, n2 = (stacked(x, None).shape[-2] for x in (x1, x2))
        return (self._std(params) ** 2)[:, None, None].expand(-1, n1, n2)

    def diagonal(self, params: Parameters, x: Features) -> Tensor:
        return (self._std(params) ** 2)[:, None].expand(-1, stacked(x, None).shape[-2])

    def draw(self, params: Parameters, features: int, generator: torch.Generator) -> FunctionDraw:
        return ConstantDraw(self._std(params))


@dataclass(frozen=True)
class Sum(Kernel):
    """k = k_1 + k_2 (remark 3.2)."""

    left: Kernel
    right: Kernel

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        half = log_std - 0.5 * math.log(2.0)
        return _sides(self.left.initial(outputs, widths, half), self.right.initial(outputs, widths, half))

    def covariance(self, params: Parameters, x1: Features, x2: Features) -> Tensor:
        left = self.left.covariance(sub(params, "left"), x1, x2)
        return left + self.right.covariance(sub(params, "right"), x1, x2)

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        left = self.left.towards(sub(params, "left"), x2)
        right = self.right.towards(sub(params, "right"), x2)
        return lambda x1: left(x1) + right(x1)

    def diagonal(self, params: Parameters, x: Features) -> Tensor:
        return self.left.diagonal(sub(params, "left"), x) + self.right.diagonal(sub(params, "right"), x)

    def draw(self, params: Parameters, features: int, generator: torch.Generator) -> FunctionDraw:
        return SumDraw(
            self.left.draw(sub(params, "left"), features, generator),
            self.right.draw(sub(params, "right"), features, generator),
        )


@dataclass(frozen=True)
class Product(Sum):
    """k = k_1 k_2; the second factor starts at unit size."""

    def initial(self, outputs: int, widths: Mapping[str, int], log_std: Tensor | float = 0.0) -> Initial:
        return _sides(self.left.initial(outputs, widths, log_std), self.right.initial(outputs, widths))

    def covariance(self, params: Parameters, x1: Features, x2: Features) -> Tensor:
        left = self.left.covariance(sub(params, "left"), x1, x2)
        return left * self.right.covariance(sub(params, "right"), x1, x2)

    def towards(self, params: Parameters, x2: Features) -> Callable[[Features], Tensor]:
        left = self.left.towards(sub(params, "left"), x2)
        right = self.right.towards(sub(params, "right"), x2)
        return lambda x1: left(x1) * right(x1)

    def diagonal(self, params: Parameters, x: Features) -> Tensor:
        return self.left.diagonal(sub(params, "left"), x) * self.right.diagonal(sub(params, "right"), x)

    def draw(self, params: Parameters, features: int, generator: torch.Generator) -> FunctionDraw:
        # A sum is multiplied out: its terms have features of unequal number and size, and those of a term
        # with few would seldom be drawn among those of the other.
        for side, other in (("left", "right"), ("right", "left")):
            inner = getattr(self, side)
            if isinstance(inner, Sum) and not isinstance(inner, Product):
                rest = {f"right.{key}": value for key, value in sub(params, other).items()}
                terms = []
                for part in ("left", "right"):
                    own = {f"left.{k}": v for k, v in sub(params, f"{side}.{part}").items()}
                    product = Product(getattr(inner, part), getattr(self, other))
                    terms.append(product.draw(own | rest, features, generator))
                return SumDraw(terms[0], terms[1])
        linear = max(_linear_factors(self.left), _linear_factors(self.right))
        if linear:
            # A linear factor has few features and all of them matter, so the other one is given fewer.
            few = max(1, features // (LINEAR_PAIRS * linear))
            return OuterDraw(
                self.left.draw(sub(params, "left"), few, generator),
                self.right.draw(sub(params, "right"), few, generator),
            )
        # Features of the two factors are paired at random, so that their number does not multiply.
        left = self.left.draw(sub(params, "left"), features, generator)
        right = self.right.draw(sub(params, "right"), features, generator)
        return ProductDraw(left, right, features, int(torch.randint(2**31, (1,), generator=generator)))


def _linear_factors(kernel: Kernel) -> int:
    """Number of factors of a kernel that is linear, or a product of linear ones; 0 for any other."""
    if isinstance(kernel, Product):
        left, right = _linear_factors(kernel.left), _linear_factors(kernel.right)
        return left + right if left and right else 0
    return int(isinstance(kernel, Linear))
