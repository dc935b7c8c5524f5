"""Figure 1: the structured covariance H k_Q Hᵀ of accelerations, block by block, at states of the log."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import torch
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from torch import Tensor

from forcegp import report
from forcegp.data import Dataset
from forcegp.files import Header
from forcegp.forces.priors.base import CONSTRAINT
from forcegp.forces.quantities import states
from forcegp.gp.features import Block as Rows
from forcegp.gp.likelihood import cross_gram
from forcegp.models.load import load_model
from forcegp.models.structured_fit import StructuredFit
from reproduction.fits import MODEL
from reproduction.stages import write_data
from reproduction.task import Task

STATES = 6
"""Number of states in the figure, the first training points."""
RANK_TOLERANCE = 1e-9
"""Eigenvalues below this share of the largest count as zero."""
WIDTH = 4.1
DECADES = 3.5
"""Number of powers of ten that the colour scale spans below the largest entry."""


class CovarianceData(Header):
    """Blocks of the structured covariance H k_Q Hᵀ at some states.

    Attributes:
        model: name of the model with the learned force prior.
        t: times of the states [s].
        nq: number of joints.
        operators: H of each state, `nq × nq` each.
        force: k_Q, `(n nq) × (n nq)`.
        acceleration: H k_Q Hᵀ, of the same size.
        rank: rank of the acceleration covariance.
    """

    FORMAT: ClassVar[str] = "forcegp-covariance"
    VERSION: ClassVar[int] = 1

    model: str
    t: report.Series
    nq: int
    operators: list[list[report.Series]]
    force: list[report.Series]
    acceleration: list[report.Series]
    rank: int


def make_covariance(folder: Path, run: Path, rows: Path, fit: Path, *, model: str) -> None:
    """Write the figure's data for a fitted model."""
    fitted = load_model(fit / MODEL)
    assert isinstance(fitted, StructuredFit)
    train = Task.read(run, rows).train("stretches", STATES)
    write_data(folder, covariance_blocks(fitted, train, model))


@torch.no_grad()
def covariance_blocks(model: StructuredFit, data: Dataset, name: str) -> CovarianceData:
    """Return H, k_Q and H k_Q Hᵀ (eq. 32) with the learned hyperparameters, at the states of a data set.

    Args:
        model: a fitted model with priors on joint forces.
        data: a few states.
        name: name of the model, for the plot.
    """
    system, fitted = model.system, model.posterior
    at = states(system, data.q, data.qd, data.tau, data.active(system.contact_names))
    # A force along the constraint, which no acceleration shows, is left out of the plot.
    pairs = [
        pair
        for pair in zip(fitted.priors, fitted.process.scales, strict=True)
        if pair[0].target != CONSTRAINT
    ]
    priors = [prior for prior, _ in pairs]
    features = tuple(scale.apply(prior.features(system, at)) for prior, scale in pairs)
    E = tuple(prior.operator(system, at) for prior in priors)
    force = Rows(features, E, torch.zeros_like(at.q))
    acceleration = Rows(features, tuple(at.eom.H @ operator for operator in E), torch.zeros_like(at.q))
    k_Q, k_qdd = (cross_gram(priors, model.hyperparameters, [rows], [rows]) for rows in (force, acceleration))
    eigenvalues = torch.linalg.eigvalsh(k_qdd)
    return CovarianceData(
        model=name,
        t=report.series(data.t),
        nq=system.robot.nq,
        operators=[_matrix(H) for H in at.eom.H],
        force=_matrix(k_Q),
        acceleration=_matrix(k_qdd),
        rank=int((eigenvalues > RANK_TOLERANCE * eigenvalues[-1]).sum()),
    )


def covariance_block(data: CovarianceData) -> report.PictureBlock:
    """Return figure 1 with its caption."""
    n, rows = len(data.t), len(data.acceleration)
    panels = (
        ("Operators H(xᵢ)", torch.block_diag(*map(report.as_tensor, data.operators)),
         f"Block-diagonal matrix of the operators H at {n} states, {data.nq} by {data.nq} each."),
        ("Force prior k_Q(xᵢ, xⱼ)", report.as_tensor(data.force),
         "Covariance of the forces: every block is diagonal, one process per joint."),
        ("Result H k_Q Hᵀ", report.as_tensor(data.acceleration),
         f"Covariance of the accelerations: every block is full; {rows} rows and columns, rank {data.rank}."),
    )  # fmt: skip
    return report.PictureBlock(
        "Figure 1: structured covariance",
        f"H k_Q Hᵀ block by block, for {n} training points, with the learned hyperparameters of the "
        "zero-mean S-GP. Left: the operators H(xᵢ), given by the known mechanics. Middle: the prior on the "
        "forces, one independent process per joint, so every block is diagonal. Right: the covariance of "
        "accelerations, full in every block and without the direction that the surface forbids: rank "
        f"{data.rank} of {rows}. Logarithmic colour scale.",
        tuple(_draw(values, data, title, alt) for title, values, alt in panels),
        "stages/figures/covariance/data.json",
    )


def _draw(values: Tensor, data: CovarianceData, title: str, alt: str) -> report.Picture:
    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        largest = float(values.abs().max())
        norm = SymLogNorm(linthresh=largest * 10**-DECADES, vmin=-largest, vmax=largest, base=10)
        image = axes.imshow(values, cmap="RdBu_r", norm=norm, interpolation="nearest")
        _grid(axes, len(data.t), data.nq)
        bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.85, pad=0.03)
        bar.set_ticks([-largest, 0.0, largest], labels=[f"{-largest:.2g}", "0", f"{largest:.2g}"])
        bar.minorticks_off()

    return report.draw(paint, (WIDTH, 4.5), alt, title)


def _grid(axes: Axes, states: int, nq: int) -> None:
    """Draw lines between the blocks, and the number of each state."""
    axes.grid(visible=False)
    for edge in range(1, states):
        axes.axhline(edge * nq - 0.5, color="#777777", linewidth=0.6)
        axes.axvline(edge * nq - 0.5, color="#777777", linewidth=0.6)
    centres, names = [(i + 0.5) * nq - 0.5 for i in range(states)], [f"x{i + 1}" for i in range(states)]
    axes.set_xticks(centres, labels=names)
    axes.set_yticks(centres, labels=names)
    axes.tick_params(length=0)
    axes.xaxis.tick_top()
    for spine in axes.spines.values():
        spine.set_visible(True)


def _matrix(values: Tensor) -> list[report.Series]:
    return [report.series(row) for row in values]
