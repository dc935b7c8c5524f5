"""Figures 4 and 5: predicted accelerations of all joints over a window of time, and their errors."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from torch import Tensor

from forcegp.report.data import WindowData, as_tensor
from forcegp.report.style import INK, Picture, colour, draw, label

WIDTH, ROW, MARGIN = 4.1, 0.92, 0.55
"""Size of a figure with one row a joint [inch]."""


def draw_predictions(window: WindowData) -> Picture:
    """Measured and predicted accelerations, one row a joint, with a band of ±2 standard deviations."""
    name, joints = label(window.model), len(window.joint_names)
    band = ", with the band of two standard deviations," if window.std else ""
    alt = (
        f"{name}: accelerations of {joints} joints over {_duration(window):.3g} s; measured in black, "
        f"predicted{band} in colour."
    )

    def paint(figure: Figure) -> None:
        _rows(figure, window, centre=torch.zeros(len(window.t), dtype=torch.float64))

    return draw(paint, _size(joints), alt, name)


def draw_errors(window: WindowData, limit: float | None = None) -> Picture:
    """Errors of the prediction: predicted less noise-free acceleration, and the measurement noise around it.

    Args:
        window: the predictions.
        limit: half height of every row [rad/s²], to compare models at one scale; else each row its own.
    """
    name, joints = label(window.model), len(window.joint_names)
    error = _error(window)
    alt = (
        f"{name}: error of the predicted accelerations of {joints} joints over {_duration(window):.3g} s, "
        f"mean magnitude {error.abs().mean():.2g}, largest {error.abs().max():.2g} rad/s²."
    )

    def paint(figure: Figure) -> None:
        _rows(figure, window, centre=as_tensor(window.mean), limit=limit)

    return draw(paint, _size(joints), alt, name)


def common_limit(windows: list[WindowData]) -> float:
    """A half height [rad/s²] at which the noise and the errors of the better half of the models fit."""
    if not windows:
        return 0.5
    largest = sorted(float(_error(window).abs().quantile(0.995)) for window in windows)
    middle = largest[(len(largest) - 1) // 2]
    return max(4.0 * (windows[0].noise_std or 0.0), 1.3 * middle)


def _error(window: WindowData) -> Tensor:
    return as_tensor(window.mean) - as_tensor(window.clean or window.measured)


def _duration(window: WindowData) -> float:
    return window.t[-1] - window.t[0]


def _size(joints: int) -> tuple[float, float]:
    return WIDTH, MARGIN + ROW * joints


def _rows(figure: Figure, window: WindowData, centre: Tensor, limit: float | None = None) -> None:
    """One row a joint, everything drawn relative to `centre`."""
    rows = figure.subplots(len(window.joint_names), 1, sharex=True, squeeze=False)[:, 0]
    measured, mean = as_tensor(window.measured) - centre, as_tensor(window.mean) - centre
    clean = None if window.clean is None else as_tensor(window.clean) - centre
    relative = bool(centre.any())
    shown = colour(window.model)
    for i, axes in enumerate(rows):
        axes.plot(
            window.t, measured[i], color="#9a9a9a" if relative else INK, linewidth=0.6, label="measured"
        )
        if window.std is not None:
            spread = 2.0 * torch.tensor(window.std[i], dtype=torch.float64)
            axes.fill_between(
                window.t, mean[i] - spread, mean[i] + spread, color=shown, alpha=0.3, linewidth=0,
                label="±2 std", zorder=3,
            )  # fmt: skip
        axes.plot(window.t, mean[i], color=shown, linewidth=1.1, label="predicted", zorder=4)
        if relative and clean is not None:
            axes.plot(window.t, clean[i], color=INK, linewidth=0.9, label="noise-free", zorder=5)
        axes.set_ylabel(f"joint {i + 1}")
        axes.margins(x=0.0)
        axes.locator_params(axis="y", nbins=4)
        if limit is not None:
            axes.set_ylim(-limit, limit)
    rows[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    handles, names = rows[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names))
    unit = "[rad/s²]"
    figure.supylabel(
        f"acceleration less prediction {unit}" if relative else f"acceleration {unit}", fontsize=9
    )
