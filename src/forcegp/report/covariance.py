"""Figure 1: the structured covariance H k_Q Hᵀ, block by block."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from torch import Tensor

from forcegp.report.data import CovarianceData
from forcegp.report.style import Picture, draw

WIDTH = 4.1
DECADES = 3.5
"""Shades span this many powers of ten below the largest entry."""


def draw_operators(data: CovarianceData) -> Picture:
    """H(x_i) of each state on the diagonal."""
    H = torch.block_diag(*torch.tensor(data.operators, dtype=torch.float64))
    alt = f"Block-diagonal matrix of the operators H at {len(data.t)} states, {data.nq} by {data.nq} each."
    return _picture(H, data, "Operators H(xᵢ)", alt)


def draw_force_prior(data: CovarianceData) -> Picture:
    """k_Q(x_i, x_j): a diagonal block for every pair of states."""
    alt = "Covariance of the forces: every block is diagonal, one process a joint."
    return _picture(torch.tensor(data.force, dtype=torch.float64), data, "Force prior k_Q(xᵢ, xⱼ)", alt)


def draw_structured(data: CovarianceData) -> Picture:
    """H(x_i) k_Q(x_i, x_j) H(x_j)ᵀ: full blocks, rank deficient."""
    K = torch.tensor(data.acceleration, dtype=torch.float64)
    alt = (
        f"Covariance of the accelerations: every block is full; {len(K)} rows and columns, rank {data.rank}."
    )
    return _picture(K, data, "Result H k_Q Hᵀ", alt)


def _picture(values: Tensor, data: CovarianceData, title: str, alt: str) -> Picture:
    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        largest = float(values.abs().max())
        norm = SymLogNorm(linthresh=largest * 10**-DECADES, vmin=-largest, vmax=largest, base=10)
        image = axes.imshow(values, cmap="RdBu_r", norm=norm, interpolation="nearest")
        _grid(axes, len(data.t), data.nq)
        bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.85, pad=0.03)
        bar.set_ticks([-largest, 0.0, largest], labels=[f"{-largest:.2g}", "0", f"{largest:.2g}"])
        bar.minorticks_off()

    return draw(paint, (WIDTH, 4.5), alt, title)


def _grid(axes: Axes, states: int, nq: int) -> None:
    """Lines between the blocks, and the number of each state."""
    axes.grid(visible=False)
    for edge in range(1, states):
        axes.axhline(edge * nq - 0.5, color="#777777", linewidth=0.6)
        axes.axvline(edge * nq - 0.5, color="#777777", linewidth=0.6)
    centres = [(i + 0.5) * nq - 0.5 for i in range(states)]
    axes.set_xticks(centres, labels=[f"x{i + 1}" for i in range(states)])
    axes.set_yticks(centres, labels=[f"x{i + 1}" for i in range(states)])
    axes.tick_params(length=0)
    axes.xaxis.tick_top()
    for spine in axes.spines.values():
        spine.set_visible(True)
