"""Numbers in result files: rounded series, and parts of a file that reject unknown fields."""

from __future__ import annotations

import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor

Series = list[float]
DIGITS = 7
"""Significant digits kept in series that are only drawn."""


class Part(BaseModel):
    """A part of a result file: frozen, no unknown field, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def series(values: Tensor) -> Series:
    """A tensor `(n,)` as numbers for a file, rounded to what a plot can show."""
    return [float(f"{value:.{DIGITS}g}") for value in values.detach().cpu().tolist()]


def columns(values: Tensor) -> list[Series]:
    """A tensor `(n, d)` as d series."""
    return [series(column) for column in values.unbind(-1)]


def matrix(values: Tensor) -> list[Series]:
    """A tensor `(n, d)` as n rows."""
    return [series(row) for row in values.unbind(0)]


def as_tensor(values: Series | list[Series]) -> Tensor:
    """Series `(n,)` or `(d, n)` as a tensor."""
    return torch.tensor(values, dtype=torch.float64)
