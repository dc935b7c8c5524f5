"""Kernel inputs with zero mean and unit variance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Standardization:
    """Shift and scale of each named input, x ↦ (x − mean)/std, from training data.

    Inputs that are constant to rounding keep the scale 1, and are listed in `constant`.
    """

    mean: Mapping[str, Tensor]
    std: Mapping[str, Tensor]
    constant: tuple[str, ...] = ()

    @classmethod
    def of(cls, features: Mapping[str, Tensor]) -> Standardization:
        """Mean and standard deviation of each column."""
        mean = {name: x.mean(0) for name, x in features.items()}
        std, constant = {}, []
        for name, x in features.items():
            spread = x.std(0, correction=0)
            fixed = spread <= 1e-12 * (1.0 + mean[name].abs())
            constant += [f"{name}[{i}]" for i in fixed.nonzero()[:, 0].tolist()]
            std[name] = torch.where(fixed, 1.0, spread)
        return cls(mean, std, tuple(constant))

    def apply(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The standardized features."""
        return {name: (x - self.mean[name]) / self.std[name] for name, x in features.items()}
