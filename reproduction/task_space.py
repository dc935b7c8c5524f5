"""Figure 3: planned and executed position, velocity and acceleration of the tool."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from forcegp import report
from forcegp.files import Header
from reproduction.stages import write_data
from reproduction.task import Task, motion_of

STEP = 2
"""Stride of the plotted samples."""
WIDTH = 4.6
UNITS = {"position": "m", "velocity": "m/s", "acceleration": "m/s²"}
PLANNED: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (4, 1.5))}
EXECUTED: dict[str, Any] = {"linewidth": 2.0, "alpha": 0.5}


class TaskSpaceData(Header):
    """Planned and executed motion of the tool, each by axis: [m], [m/s], [m/s²]."""

    FORMAT: ClassVar[str] = "forcegp-task-space"
    VERSION: ClassVar[int] = 1

    t: report.Series
    planned_position: list[report.Series]
    planned_velocity: list[report.Series]
    planned_acceleration: list[report.Series]
    position: list[report.Series]
    velocity: list[report.Series]
    acceleration: list[report.Series]
    waypoints: list[report.Series]


def make_task_space(folder: Path, run: Path, rows: Path, *, seconds: float) -> None:
    """Write the figure's data: some seconds around the first held-out stretch."""
    task = Task.read(run, rows)
    write_data(folder, task_space_motion(task.data.t, motion_of(run), task.around(seconds, STEP)))


def task_space_motion(t: Tensor, motion: Mapping[str, Tensor], rows: Tensor) -> TaskSpaceData:
    """Return the motion of the tool at some samples, with the waypoints passed.

    Args:
        t: `(n,)` times of the log [s].
        motion: as saved by a simulation.
        rows: rows of the samples.
    """
    first, last = int(motion["segment"][rows].min()), int(motion["segment"][rows].max())
    vectors = [prefix + name for prefix in ("planned_", "") for name in UNITS]
    return TaskSpaceData(
        t=report.series(t[rows]),
        waypoints=[report.series(row) for row in motion["waypoints"][torch.arange(first + 1, last + 1)]],
        **{name: report.columns(motion[name][rows]) for name in vectors},
    )


def task_space_block(data: TaskSpaceData) -> report.PictureBlock:
    """Return figure 3 with its caption."""
    return report.PictureBlock(
        "Figure 3: task-space motion",
        "The tool moves along straight lines between random points on the surface, with a trapezoidal "
        "speed profile and a stop at every point; dashed: planned, wide: executed under torque control "
        "with contact and friction.",
        (draw_motion(data), draw_path(data)),
        "stages/figures/task-space/data.json",
    )


def draw_motion(data: TaskSpaceData) -> report.Picture:
    """Return the planned and executed position, velocity and acceleration of the tool by axis."""

    def paint(figure: Figure) -> None:
        for axes, (name, unit) in zip(figure.subplots(3, 1, sharex=True), UNITS.items(), strict=True):
            for axis, shown in enumerate(report.AXES):
                axes.plot(data.t, getattr(data, name)[axis], color=shown, **EXECUTED)
                axes.plot(data.t, getattr(data, "planned_" + name)[axis], color=shown, **PLANNED)
            axes.set_ylabel(f"{name} [{unit}]")
            axes.margins(x=0.0)
        figure.axes[-1].set_xlabel("time [s]")
        figure.align_ylabels()
        styles = [
            Line2D([], [], color=shown, label=name) for shown, name in zip(report.AXES, "xyz", strict=True)
        ]
        styles += [Line2D([], [], color=report.INK, label="planned", **PLANNED)]
        styles += [Line2D([], [], color=report.INK, label="executed", **EXECUTED)]
        figure.legend(handles=styles, loc="outside upper center", ncols=5)

    alt = (
        f"Position, velocity and acceleration of the tool over {data.t[-1] - data.t[0]:.3g} s by axis: "
        "straight lines with trapezoidal speed, planned and executed nearly identical."
    )
    return report.draw(paint, (WIDTH, 5.2), alt, "Over time")


def draw_path(data: TaskSpaceData) -> report.Picture:
    """Return the path of the tool over the surface, seen from above, with its waypoints."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(data.position[0], data.position[1], color=report.AXES[0], linewidth=0.8, label="executed")
        points = [[p[0] for p in data.waypoints], [p[1] for p in data.waypoints]]
        axes.plot(*points, linestyle="", marker="o", markersize=3.0, color=report.AXES[1], label="waypoints")
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        figure.legend(loc="outside upper center", ncols=2)

    alt = f"Path of the tool seen from above: straight lines between {len(data.waypoints)} random points."
    return report.draw(paint, (WIDTH, 5.2), alt, "From above")
