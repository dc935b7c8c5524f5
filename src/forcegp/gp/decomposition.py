"""Which part of a kernel is a finite number of features, and which part needs inducing points.

A sum of linear kernels and of products of linear kernels is k(x, x′) = φ(x)ᵀφ(x′) exactly, with a few
features φ. The rest, whatever contains a stationary factor, is approximated with inducing points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce

import torch

from forcegp.gp.draws import FunctionDraw
from forcegp.gp.kernels import Constant, Kernel, Linear, Parameters, Product, Sum, sub

EXACT: tuple[type[Kernel], ...] = (Linear, Constant)
"""Kernels without factors whose `draw` holds all their features, whatever number it is asked for."""


@dataclass(frozen=True)
class Part:
    """A kernel made of factors of another one.

    Attributes:
        kernel: the sum of products of the factors.
        names: the prefix of each factor's hyperparameters here, and in the whole kernel.
    """

    kernel: Kernel
    names: Mapping[str, str]

    def parameters(self, whole: Parameters) -> dict[str, torch.Tensor]:
        """The part's hyperparameters among those of the whole kernel."""
        found = {}
        for here, there in self.names.items():
            factor = sub(whole, there) if there else whole
            found |= {f"{here}.{key}" if here else key: value for key, value in factor.items()}
        return found

    def features(self, whole: Parameters) -> FunctionDraw:
        """φ of a finite part: features whose products are the kernel exactly."""
        # Such a draw takes no random number, so any generator does.
        return self.kernel.draw(self.parameters(whole), 1, torch.Generator())


@dataclass(frozen=True)
class Split:
    """A kernel as the sum of a finite part and the rest.

    Attributes:
        finite: sums and products of linear kernels.
        rest: everything else.
    """

    finite: Part | None
    rest: Part | None


def split(kernel: Kernel) -> Split:
    """The finite part of a kernel and the rest; products of sums are multiplied out where needed."""
    finite, rest = _terms(kernel, "")
    return Split(_sum(finite), _sum(rest))


def _terms(kernel: Kernel, path: str) -> tuple[list[Part], list[Part]]:
    """Terms with and without a finite number of features."""
    if isinstance(kernel, EXACT):
        return [Part(kernel, {"": path})], []
    if not isinstance(kernel, Sum):
        return [], [Part(kernel, {"": path})]
    sides = [_terms(getattr(kernel, side), f"{path}.{side}".lstrip(".")) for side in ("left", "right")]
    (finite_left, rest_left), (finite_right, rest_right) = sides
    if not isinstance(kernel, Product):
        return finite_left + finite_right, rest_left + rest_right
    if not finite_left or not finite_right:
        return [], [Part(kernel, {"": path})]
    finite = [_join(Product, a, b) for a in finite_left for b in finite_right]
    rest = [_join(Product, a, b) for a in finite_left for b in rest_right]
    rest += [_join(Product, a, b) for a in rest_left for b in finite_right + rest_right]
    return finite, rest


def _join(kind: type[Sum], left: Part, right: Part) -> Part:
    names = {f"left.{key}".rstrip("."): path for key, path in left.names.items()}
    names |= {f"right.{key}".rstrip("."): path for key, path in right.names.items()}
    return Part(kind(left.kernel, right.kernel), names)


def _sum(terms: list[Part]) -> Part | None:
    return reduce(lambda a, b: _join(Sum, a, b), terms) if terms else None
