"""Kernel inputs: named features, side by side and standardized."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.errors import UnknownNameError

FLOOR = 0.01
"""Smallest scale of a column, in units of the typical one of its input. It is below what a motion through the
workspace gives (0.034 for the torque of an arm's joint 5), and above what drift gives."""

Features = Mapping[str, Tensor]
"""Named kernel inputs: `(n, w)`, shared by all components, or `(n, k, w)`, one row for each component."""


def stacked(x: Features, inputs: tuple[str, ...] | None) -> Tensor:
    """The named features side by side, `(n, w)`, or `(k, n, w)` where components have inputs of their own.

    Raises:
        UnknownNameError: a feature is not given.
    """
    names = tuple(x) if inputs is None else inputs
    for name in names:
        if name not in x:
            raise UnknownNameError("kernel input", name, x)
    parts = [x[name] for name in names]
    if all(part.ndim == 2 for part in parts):
        return torch.cat(parts, dim=-1)
    k = next(part.shape[1] for part in parts if part.ndim == 3)
    wide = [part if part.ndim == 3 else part[:, None].expand(-1, k, -1) for part in parts]
    return torch.cat(wide, dim=-1).transpose(0, 1)


@dataclass(frozen=True)
class Standardization:
    """Shift and scale of each named input, x ↦ (x − mean)/std, from training data.

    A column that hardly varies says nothing of the scale on which a function varies along it. So no scale is
    below `FLOOR` times the root mean square of the standard deviations of all columns of its input, and the
    columns of a vector share that mean: neither turning its axes nor a step off a plane changes much.
    Features whose zero means something, such as a joint at rest, are scaled but not shifted.

    Columns that are constant to rounding keep the scale 1, or that of their vector, and are listed in
    `constant`.
    """

    mean: Mapping[str, Tensor]
    std: Mapping[str, Tensor]
    constant: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, features: Mapping[str, Tensor], vectors: Collection[str] = (), centred: bool = True
    ) -> Standardization:
        """Mean and standard deviation of each column, or zero and its root mean square.

        Args:
            features: named inputs `(n, w)`.
            vectors: inputs whose columns are components of one vector.
            centred: whether the mean is subtracted.
        """
        mean = {name: x.mean(0) if centred else torch.zeros_like(x[0]) for name, x in features.items()}
        std, constant = {}, []
        for name, x in features.items():
            spread = (x - mean[name]).square().mean(0).sqrt()
            fixed = spread <= 1e-12 * (1.0 + mean[name].abs())
            constant += [f"{name}[{i}]" for i in fixed.nonzero()[:, 0].tolist()]
            whole = spread.square().mean().sqrt()
            if name in vectors and not bool(fixed.all()):
                std[name] = whole.expand_as(spread).clone()
            else:
                std[name] = torch.where(fixed, 1.0, spread.clamp(min=FLOOR * whole))
        return cls(mean, std, tuple(constant))

    @classmethod
    def none(cls, features: Mapping[str, Tensor]) -> Standardization:
        """Inputs as they are, in their units."""
        zero = {name: torch.zeros_like(x[0]) for name, x in features.items()}
        return cls(zero, {name: torch.ones_like(x) for name, x in zero.items()})

    def apply(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The standardized features."""
        return {name: (x - self.mean[name]) / self.std[name] for name, x in features.items()}
