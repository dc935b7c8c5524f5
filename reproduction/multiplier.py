"""Figure 2: the constraint error in simulation, and the multiplier predicted from accelerations."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import torch
from matplotlib.figure import Figure
from torch import Tensor

from forcegp import report
from forcegp.files import Header, Record
from forcegp.models.load import load_model
from reproduction.fits import MODEL
from reproduction.stages import write_data
from reproduction.statements import Statement
from reproduction.task import Task, motion_of

STEP = 4
"""Stride of the predicted samples."""
BAND = 2.0
"""Standard deviations on either side."""
INSIDE = 0.90
"""Coverage above which the claim about the multiplier counts as confirmed."""
WIDTH = 4.6


class MultiplierBand(Record):
    """The multiplier predicted by one model.

    Attributes:
        model: registry name.
        mean, std: [N].
        inside: ±2σ coverage of the simulator's value.
        inside_held_out: the same over held-out samples only; `None` if there are none.
        mean_error: mean absolute error [N].
        smallest: the smallest predicted mean [N].
    """

    model: str
    mean: report.Series
    std: report.Series
    inside: float
    inside_held_out: float | None
    mean_error: float
    smallest: float

    @classmethod
    def of(
        cls, model: str, mean: Tensor, std: Tensor, simulated: Tensor, judged: Tensor, held_out: Tensor
    ) -> MultiplierBand:
        """Return the band of a prediction `(n,)`, scored against the simulator on the marked samples."""
        error = (mean - simulated).abs()
        inside = (error <= BAND * std).double()
        return cls(
            model=model,
            mean=report.series(mean),
            std=report.series(std),
            inside=float(inside[judged].mean()),
            inside_held_out=float(inside[held_out].mean()) if bool(held_out.any()) else None,
            mean_error=float(error[judged].mean()),
            smallest=float(mean[judged].min()),
        )


class MultiplierData(Header):
    """Constraint error in simulation and the predicted multiplier.

    Attributes:
        t: [s].
        c: constraint error [m].
        simulated: the simulator's multiplier [N].
        held_out: intervals of time without training points [s].
        bands: one band per model.
    """

    FORMAT: ClassVar[str] = "forcegp-multiplier"
    VERSION: ClassVar[int] = 2

    t: report.Series
    c: report.Series
    simulated: report.Series
    held_out: list[tuple[float, float]]
    bands: list[MultiplierBand]


@torch.no_grad()
def make_multiplier(
    folder: Path, run: Path, rows: Path, *fits: Path, models: list[str], seconds: float
) -> None:
    """Write the first contact's multiplier around the first held-out stretch, by several models.

    They are conditioned on accelerations (eq. 25).
    """
    task = Task.read(run, rows)
    shown, contact = task.around(seconds, STEP), task.system.contact_names[0]
    data, held = task.data[shown], torch.zeros(len(task.data), dtype=torch.bool)
    for first, last in task.stretches():
        held[first:last] = True
    held, simulated, bands = held[shown], data.contact_extras["multiplier"][contact], []
    active, everywhere = data.active(task.system.contact_names), torch.ones_like(held)
    for name, fit in zip(models, fits, strict=True):
        found = load_model(fit / MODEL).predict(data.q, data.qd, data.tau, "multiplier", active=active)
        assert found.std is not None
        mean, std = found.mean[:, 0], found.std[:, 0]
        bands.append(MultiplierBand.of(name, mean, std, simulated, everywhere, held))
    made = MultiplierData(
        t=report.series(data.t),
        c=report.series(motion_of(run)["c"][shown, 0]),
        simulated=report.series(simulated),
        held_out=spans(data.t, held),
        bands=bands,
    )
    write_data(folder, made)


def spans(t: Tensor, marked: Tensor) -> list[tuple[float, float]]:
    """Return the start and end times of runs of marked samples."""
    zero = marked.new_zeros(1).int()
    edges = torch.diff(marked.int(), prepend=zero, append=zero)
    begins, ends = (edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0] - 1
    return [(float(t[i]), float(t[j])) for i, j in zip(begins, ends, strict=True)]


def multiplier_block(data: MultiplierData) -> report.PictureBlock:
    """Return figure 2 with its caption."""
    return report.PictureBlock(
        "Figure 2: surface error and multiplier",
        "The error of the surface equation in simulation, and the Lagrange multiplier λ (the normal force) "
        "that the equations of motion give with the forces learned from accelerations, beside the "
        "simulator's own. The shaded time contains no training point. The lower "
        "panels show the same relative to the simulator's value. Bands are ±2σ.",
        (draw_constraint(data), *(draw_multiplier(data, band) for band in data.bands)),
        "stages/figures/multiplier/data.json",
    )


def draw_constraint(data: MultiplierData) -> report.Picture:
    """Return the constraint error in simulation (top)."""
    error = report.as_tensor(data.c)

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(data.t, 1e6 * error, color=report.INK)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("surface error c(q) [µm]")
        axes.margins(x=0.0)

    largest = 1e6 * float(error.abs().max())
    alt = f"Surface error over {data.t[-1] - data.t[0]:.3g} s, at most {largest:.2g} micrometres."
    return report.draw(paint, (WIDTH, 2.1), alt, "Surface error c(q) in simulation")


def draw_multiplier(data: MultiplierData, band: MultiplierBand) -> report.Picture:
    """Return the predicted multiplier and the simulator's (bottom)."""
    mean, simulated = report.as_tensor(band.mean), report.as_tensor(data.simulated)
    spread, shown = BAND * report.as_tensor(band.std), report.colour(band.model)

    def paint(figure: Figure) -> None:
        both, error = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        filled: dict[str, Any] = {"color": shown, "alpha": 0.3, "linewidth": 0, "label": "±2σ"}
        for axes, centre in ((both, torch.zeros_like(mean)), (error, simulated)):
            for first, last in data.held_out:
                axes.axvspan(first, last, color="#f1ead2", zorder=0, linewidth=0)
            axes.fill_between(data.t, mean - spread - centre, mean + spread - centre, **filled)
            axes.plot(data.t, simulated - centre, color=report.INK, linewidth=1.0, label="simulator")
            axes.plot(data.t, mean - centre, color=shown, linewidth=1.1, label="predicted")
            axes.margins(x=0.0)
        both.set_ylim(bottom=min(0.0, float((mean - spread).min())))
        both.set_ylabel("multiplier λ [N]")
        error.set_ylabel("error [N]")
        error.set_xlabel("time [s]")
        figure.align_ylabels()
        figure.legend(*both.get_legend_handles_labels(), loc="outside upper center", ncols=3)

    alt = (
        f"{report.label(band.model)}: multiplier over {data.t[-1] - data.t[0]:.3g} s, predicted with its "
        f"band beside the simulator's; mean error {band.mean_error:.2g} N, "
        f"coverage {100 * band.inside:.0f} %."
    )
    return report.draw(paint, (WIDTH, 4.2), alt, report.label(band.model))


def multiplier_finding(data: MultiplierData) -> Statement | None:
    """Return whether the multiplier is positive and within its band."""
    listed = "; ".join(
        f"{report.label(b.model)}: ±2σ coverage {100 * b.inside:.0f} %"
        + ("" if b.inside_held_out is None else f" ({100 * b.inside_held_out:.0f} % of held-out samples)")
        + f", mean error {b.mean_error:.2f} N, minimum {b.smallest:.1f} N"
        for b in data.bands
    )
    informed = [b for b in data.bands if b.model != "sgp-zero"]
    agrees = all(b.inside >= INSIDE and b.smallest > 0.0 for b in informed)
    text = (
        "λ by the equations of motion with the forces learned from accelerations, without a force sensor, "
        f"over {data.t[-1] - data.t[0]:.0f} s: {listed}."
    )
    if len(informed) < len(data.bands):
        text += (
            " Accelerations do not show the force along the surface normal, as H Aᵀ = 0; with a zero mean "
            "nothing else does, so only models with the analytical mean (eq. 25) can predict λ."
        )
    return Statement("Multiplier", agrees, text) if data.bands else None
