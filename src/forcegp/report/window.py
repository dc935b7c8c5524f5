"""Plots of predicted accelerations, their errors and contact forces over a few seconds."""

from __future__ import annotations

from typing import ClassVar

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from forcegp.data import Dataset
from forcegp.evaluation.predicted import logged_forces, predicted_forces
from forcegp.files import Header, Record
from forcegp.models.base import Predictor
from forcegp.models.structured_fit import StructuredFit
from forcegp.report.page import INK, Picture, Series, as_tensor, colour, columns, draw, label, series

WIDTH, WIDE, ROW, MARGIN = 4.1, 12.0, 0.92, 0.75
"""Widths of a normal and a full-width plot, height of a row, and total height of the margins [inch]."""
OUTSIDE, ROOM = 0.005, 0.25
"""Fraction of extreme values that axes may clip on either side; relative margin around the other values."""
GREY = "#9a9a9a"


class ForceWindow(Record):
    """Normal force at a contact over a time window [N]. `logged` and `std` are optional."""

    contact: str
    closed: list[bool]
    mean: Series
    std: Series | None
    logged: Series | None


class WindowData(Header):
    """Predictions of a model over a time window, by joint [rad/s²]. `clean` and `std` are optional.

    If the model predicts forces and a contact closes, `forces` contains all contacts. `noise_std` is the
    standard deviation of the acceleration noise [rad/s²], and `t` is the time since the first sample [s].
    """

    FORMAT: ClassVar[str] = "forcegp-window"
    VERSION: ClassVar[int] = 1

    model: str
    noise_std: float | None
    t: Series
    joint_names: list[str]
    measured: list[Series]
    clean: list[Series] | None
    mean: list[Series]
    std: list[Series] | None
    forces: tuple[ForceWindow, ...] = ()

    @property
    def error(self) -> Tensor:
        """Predicted minus noise-free (or measured) acceleration, `(nq, n)` [rad/s²]."""
        return as_tensor(self.mean) - as_tensor(self.clean or self.measured)

    @property
    def seconds(self) -> float:
        """Duration of the window [s]."""
        return self.t[-1] - self.t[0]


def opening(data: Dataset, seconds: float) -> Dataset:
    """Return the first `seconds` of the first trajectory in a data set, sorted by time."""
    rows = (data.segment == data.segment[0]).nonzero()[:, 0]
    rows = rows[data.t[rows].argsort()]
    return data[rows[data.t[rows] <= data.t[rows[0]] + seconds]]


@torch.no_grad()
def predicted_window(model: Predictor, data: Dataset, name: str) -> WindowData:
    """Return the predictions for a window of samples sorted by time. `name` identifies the model."""
    predicted = model.predict(data.q, data.qd, data.tau, active=data.active(model.system.contact_names))
    clean, variance = data.extras.get("qdd_clean"), predicted.variance
    if variance is not None and isinstance(model, StructuredFit) and model.torque_std is not None:
        # If the torque noise is known, measurements scatter around the prediction accordingly.
        active = data.active(model.system.contact_names)
        variance = variance + model.noise_variance(data.q, data.qd, data.tau, active=active)
    return WindowData(
        model=name,
        noise_std=data.header.noise_std,
        # Logs of real robots may count seconds since 1970, for which a series keeps too few digits.
        t=series(data.t - data.t[0]),
        joint_names=list(data.joint_names),
        measured=columns(data.qdd),
        clean=None if clean is None else columns(clean),
        mean=columns(predicted.mean),
        std=None if variance is None else columns(variance.sqrt()),
        forces=_forces(model, data),
    )


def _forces(model: Predictor, data: Dataset) -> tuple[ForceWindow, ...]:
    names = model.system.contact_names
    closed = data.active(names)
    if model.force_field() is None or not bool(closed.any()):
        return ()
    (mean, std), logged = predicted_forces(model, data), logged_forces(model, data)
    return tuple(
        ForceWindow(
            contact=name,
            closed=closed[:, i].tolist(),
            mean=series(mean[:, i]),
            std=None if std is None else series(std[:, i]),
            logged=series(logged[name]) if name in logged else None,
        )
        for i, name in enumerate(names)
    )


def draw_forces(window: WindowData) -> Picture:
    """Plot the predicted normal force at each contact with its ±2σ band, and the logged force."""

    def paint(figure: Figure) -> None:
        panels = figure.subplots(len(window.forces), 1, sharex=True, squeeze=False)[:, 0]
        for axes, force in zip(panels, window.forces, strict=True):
            mean = as_tensor(force.mean).masked_fill(~torch.tensor(force.closed), torch.nan)
            if force.std is not None:
                spread, style = 2.0 * as_tensor(force.std), {"color": colour(window.model), "alpha": 0.3}
                axes.fill_between(window.t, mean - spread, mean + spread, linewidth=0, label="±2σ", **style)
            axes.plot(window.t, mean, color=colour(window.model), label="predicted")
            if force.logged is not None:
                logged = as_tensor(force.logged)
                axes.plot(window.t, logged, color=INK, linewidth=0.8, label="logged")
                _robust_limits(axes, torch.stack([mean, logged]))
            axes.set_ylabel(f"{force.contact} [N]")
            axes.margins(x=0.0)
        panels[-1].set_xlabel("time from the first sample [s]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)

    names = ", ".join(force.contact for force in window.forces)
    alt = f"Normal force at {names} over {window.seconds:.3g} s: predicted with ±2σ, and logged where known."
    return draw(paint, (WIDE, MARGIN + 1.6 * len(window.forces)), alt, "Contact force")


def _robust_limits(axes: Axes, values: Tensor) -> None:
    """Set axis limits that include a margin but exclude a fraction `OUTSIDE` of the values on either side."""
    values = values[values.isfinite()]
    if len(values):
        low, high = values.quantile(torch.tensor([OUTSIDE, 1.0 - OUTSIDE], dtype=values.dtype)).tolist()
        room = ROOM * (high - low) + 1e-9
        axes.set_ylim(low - room, high + room)


def draw_predictions(window: WindowData) -> Picture:
    """Plot measured accelerations, and predicted accelerations with ±2σ bands, in one row per joint."""
    band = ", with the ±2σ band," if window.std else ""
    alt = f"accelerations of {{}}; measured in black, predicted{band} in colour."
    return _draw(window, torch.zeros(len(window.t), dtype=torch.float64), alt)


def draw_errors(window: WindowData, limit: float | None = None) -> Picture:
    """Plot prediction errors by joint within ±`limit` [rad/s²]. By default, each row has its own scale."""
    error = window.error.abs()
    alt = (
        f"error of the predicted accelerations of {{}}, mean magnitude {error.mean():.2g}, "
        f"largest {error.max():.2g} rad/s²."
    )
    return _draw(window, as_tensor(window.mean), alt, limit)


def _draw(window: WindowData, centre: Tensor, alt: str, limit: float | None = None) -> Picture:
    name, joints = label(window.model), len(window.joint_names)
    alt = f"{name}: " + alt.format(f"{joints} joints over {window.seconds:.3g} s")
    size = (WIDTH, MARGIN + ROW * joints)
    return draw(lambda figure: _rows(figure, window, centre, limit), size, alt, name)


def _rows(figure: Figure, window: WindowData, centre: Tensor, limit: float | None = None) -> None:
    """Draw one row per joint relative to `centre`."""
    rows = figure.subplots(len(window.joint_names), 1, sharex=True, squeeze=False)[:, 0]
    measured, mean = as_tensor(window.measured) - centre, as_tensor(window.mean) - centre
    relative, model_colour = centre.dim() > 1, colour(window.model)
    for i, axes in enumerate(rows):
        axes.plot(window.t, measured[i], color=GREY if relative else INK, linewidth=0.7, label="measured")
        if window.std is not None:
            spread = 2.0 * as_tensor(window.std[i])
            band, style = (mean[i] - spread, mean[i] + spread), {"color": model_colour, "alpha": 0.3}
            axes.fill_between(window.t, *band, linewidth=0, label="±2σ", zorder=3, **style)
        axes.plot(window.t, mean[i], color=model_colour, linewidth=1.1, label="predicted", zorder=4)
        if relative and window.clean is not None:
            clean = as_tensor(window.clean[i]) - centre[i]
            axes.plot(window.t, clean, color=INK, linewidth=0.9, label="noise-free", zorder=5)
        axes.set_title(window.joint_names[i], loc="right", fontsize="small", pad=2.0)
        axes.margins(x=0.0)
        axes.locator_params(axis="y", nbins=4)
        if limit is not None:
            axes.set_ylim(-limit, limit)
        else:
            _robust_limits(axes, torch.stack([measured[i], mean[i]]))
    rows[0].set_title(f"acceleration{' minus prediction' if relative else ''} [rad/s²]", loc="left")
    rows[-1].set_xlabel("time from the first sample [s]")
    handles, names = rows[0].get_legend_handles_labels()
    legend = figure.legend(handles, names, loc="outside upper center", ncols=len(names))
    for shown_line in legend.get_lines():
        shown_line.set_linewidth(1.6)  # the thin line used in the plot would look grey
