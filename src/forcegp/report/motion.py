"""Figures 2 and 3: the motion that was planned and executed, the constraint error, and the multiplier."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure

from forcegp.report.data import MultiplierBand, MultiplierData, TaskSpaceData
from forcegp.report.style import AXES, INK, Picture, colour, draw, label, shade

WIDTH = 4.6


def draw_task_space(data: TaskSpaceData) -> Picture:
    """Planned and executed position, velocity and acceleration of the tool by axis (figure 3)."""
    rows = (
        ("position [m]", data.planned_position, data.position),
        ("velocity [m/s]", data.planned_velocity, data.velocity),
        ("acceleration [m/s²]", data.planned_acceleration, data.acceleration),
    )

    def paint(figure: Figure) -> None:
        for axes, (name, planned, executed) in zip(figure.subplots(3, 1, sharex=True), rows, strict=True):
            for axis in range(3):
                axes.plot(data.t, executed[axis], color=AXES[axis], alpha=0.5, linewidth=2.0)
                axes.plot(data.t, planned[axis], color=AXES[axis], linewidth=0.9, linestyle=(0, (4, 1.5)))
            axes.set_ylabel(name)
            axes.margins(x=0.0)
        figure.axes[-1].set_xlabel("time [s]")
        figure.align_ylabels()
        styles = [
            figure.axes[0].plot([], [], color=AXES[0], label="x")[0],
            figure.axes[0].plot([], [], color=AXES[1], label="y")[0],
            figure.axes[0].plot([], [], color=AXES[2], label="z")[0],
            figure.axes[0].plot([], [], color=INK, linewidth=0.9, linestyle=(0, (4, 1.5)), label="planned")[
                0
            ],
            figure.axes[0].plot([], [], color=INK, alpha=0.5, linewidth=2.0, label="executed")[0],
        ]
        figure.legend(handles=styles, loc="outside upper center", ncols=5)

    alt = (
        f"Position, velocity and acceleration of the tool over {data.t[-1] - data.t[0]:.3g} s by axis: "
        "straight lines with trapezoidal speed, planned and executed almost on one another."
    )
    return draw(paint, (WIDTH, 5.2), alt, "Over time")


def draw_path(data: TaskSpaceData) -> Picture:
    """The path of the tool over the surface, seen from above, with the points that it joins."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(data.position[0], data.position[1], color=AXES[0], linewidth=0.8, label="executed")
        points = [[p[0] for p in data.waypoints], [p[1] for p in data.waypoints]]
        axes.plot(*points, linestyle="", marker="o", markersize=3.0, color=AXES[1], label="points drawn")
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        figure.legend(loc="outside upper center", ncols=2)

    alt = f"Path of the tool seen from above: straight lines between {len(data.waypoints)} random points."
    return draw(paint, (WIDTH, 5.2), alt, "From above")


def draw_constraint(data: MultiplierData) -> Picture:
    """Constraint error in simulation (figure 2, top)."""
    error = torch.tensor(data.c, dtype=torch.float64)

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(data.t, 1e6 * error, color=INK)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("surface error c(q) [µm]")
        axes.margins(x=0.0)

    largest = 1e6 * float(error.abs().max())
    alt = f"Surface error over {data.t[-1] - data.t[0]:.3g} s, at most {largest:.2g} micrometres."
    return draw(paint, (WIDTH, 2.1), alt, "Surface error c(q) in simulation")


def draw_multiplier(data: MultiplierData, band: MultiplierBand) -> Picture:
    """The multiplier predicted from accelerations beside the simulator's (figure 2, bottom)."""
    mean = torch.tensor(band.mean, dtype=torch.float64)
    spread = 2.0 * torch.tensor(band.std, dtype=torch.float64)
    simulated = torch.tensor(data.simulated, dtype=torch.float64)
    shown = colour(band.model)

    def paint(figure: Figure) -> None:
        both, error = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for axes, centre in ((both, torch.zeros_like(mean)), (error, simulated)):
            shade(axes, data.held_out)
            axes.fill_between(
                data.t, mean - spread - centre, mean + spread - centre, color=shown, alpha=0.3, linewidth=0,
                label="±2 std",
            )  # fmt: skip
            axes.plot(data.t, simulated - centre, color=INK, linewidth=1.0, label="simulator")
            axes.plot(data.t, mean - centre, color=shown, linewidth=1.1, label="predicted")
            axes.margins(x=0.0)
        both.set_ylim(bottom=min(0.0, float((mean - spread).min())))
        both.set_ylabel("multiplier λ [N]")
        error.set_ylabel("less simulator [N]")
        error.set_xlabel("time [s]")
        figure.align_ylabels()
        figure.legend(*both.get_legend_handles_labels(), loc="outside upper center", ncols=3)

    alt = (
        f"{label(band.model)}: multiplier over {data.t[-1] - data.t[0]:.3g} s, predicted with its band "
        f"beside the simulator's; mean error {band.mean_error:.2g} N, inside the band for "
        f"{100 * band.inside:.0f} %."
    )
    return draw(paint, (WIDTH, 4.2), alt, label(band.model))
