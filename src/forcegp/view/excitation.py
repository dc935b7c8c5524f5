"""Page that shows an exciting motion in a 3D view, its use of the limits, and the expected information."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from forcegp.constraints import ConstrainedSystem
from forcegp.files import write_text
from forcegp.plots import as_array
from forcegp.report.animation import animation, animation_source
from forcegp.report.page import INK, Picture, PictureBlock, Table, draw, render
from forcegp.robot.shapes import Shape, box
from forcegp.simulate.excite import Excitation
from forcegp.types import Array
from forcegp.view.motion import MEAN, Motion, Path3D, pictures, tip_path
from forcegp.view.page import SURFACE, content_of, solid

MOST = 1500
"""Maximum number of points in a curve."""


def draw_limits(result: Excitation) -> Picture:
    """Plot the position, velocity, acceleration and torque of each joint as fractions of their limits."""
    motion = result.motion[:: -(-len(result.motion) // MOST)]
    curves = result.limits.shares(motion.q, motion.qd, motion.qdd, motion.tau)

    def paint(figure: Figure) -> None:
        for axes, (name, values) in zip(figure.subplots(4, 1, sharex=True), curves.items(), strict=True):
            for j, joint in enumerate(motion.joint_names):
                axes.plot(motion.t, values[:, j], linewidth=0.9, label=joint)
            for edge in (-1.0, 1.0):
                axes.axhline(edge, color=INK, linewidth=0.8, linestyle=(0, (4, 2)))
            axes.set(ylabel=name, ylim=(-1.15, 1.15))
            axes.margins(x=0.0)
        figure.axes[-1].set_xlabel("time [s]")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)

    alt = "Position, velocity, acceleration and torque of each joint over time, as fractions of their limits."
    return draw(paint, (12.0, 7.0), alt)


def expected_table(result: Excitation) -> Table:
    """Return a table of the expected torque standard deviation in the region, before and after the motion."""
    head = ["joint"]
    columns: list[list[float]] = []
    for part in ("all", "links", "friction"):
        for when, unknowns in (("before", result.before), ("after", result.after)):
            head.append(f"{'torque' if part == 'all' else part} {when}")
            columns.append(unknowns.torque_std()[part].tolist())
    pairs = zip(result.motion.joint_names, zip(*columns, strict=True), strict=True)
    rows = [(joint, *(f"{x:.3g}" for x in row)) for joint, row in pairs]
    return Table("Expected standard deviation of the torque in the region [N m, N]", tuple(head), tuple(rows))


def write_excitation(
    path: str | Path,
    result: Excitation,
    system: ConstrainedSystem,
    shapes: Sequence[Shape],
    boxes: Array = np.zeros((0, 6)),  # noqa: B008
    title: str = "forcegp",
) -> Path:
    """Write the page for an exciting motion as a single self-contained HTML file."""
    motion = result.motion
    rows = pictures(motion.t)
    paths = [Path3D(MEAN, tip_path(system, motion.q[rows]))]
    content = content_of(Motion(system, as_array(motion.t[rows]), motion.q[rows], paths=paths), shapes)
    content["solids"] += [solid(box(*each[3:]) + each[:3], SURFACE, None) for each in boxes]
    used = ", ".join(f"{name} {value:.0%}" for name, value in result.used.items() if name != "clearance_m")
    limits = PictureBlock(
        "Limits",
        f"Largest fractions of the limits at 1 kHz: {used}. "
        f"All parts stay at least {1e3 * result.used['clearance_m']:.3g} mm apart.",
        (draw_limits(result),),
        "the planned motion",
        wide=True,
    )
    text = render(
        "excitation.html.j2",
        title=title,
        animation=animation(content, "The robot in motion, with its surroundings and the path of the tip"),
        script=animation_source(),
        expected=expected_table(result),
        limits=limits,
    )
    write_text(path, text)
    return Path(path)
