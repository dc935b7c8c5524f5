"""Draw contact frame, projection, the map from forces to quantities, and the layers of the library.

python docs/figures/drawings.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, FancyBboxPatch

HERE = Path(__file__).resolve().parent
BLUE, ORANGE, GREEN, GRAY = "#1f77b4", "#d95f02", "#2a8c4a", "#777777"


def canvas(width: float, height: float, *, xlim: tuple[float, float], ylim: tuple[float, float]) -> Axes:
    _, axis = plt.subplots(figsize=(width, height))
    axis.set(xlim=xlim, ylim=ylim, aspect="equal")
    axis.axis("off")
    return axis


def arrow(
    axis: Axes, start: tuple[float, float], end: tuple[float, float], color: str, lw: float = 1.8
) -> None:
    style = {"arrowstyle": "-|>", "color": color, "lw": lw, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", end, start, arrowprops=style)


def box(axis: Axes, x: float, y: float, w: float, h: float, text: str, color: str, size: float = 9) -> None:
    shape = FancyBboxPatch((x, y), w, h, "round,pad=0,rounding_size=0.08", fc=color + "22", ec=color, lw=1.2)
    axis.add_patch(shape)
    axis.text(x + w / 2, y + h / 2, text, ha="center", va="center", fontsize=size)


def saved(axis: Axes, name: str) -> None:
    axis.figure.savefig(HERE / f"{name}.svg", metadata={"Date": None}, bbox_inches="tight")
    plt.close("all")


def contact_frame() -> None:
    """A tip that slides on a surface: normal, tangent, velocity, normal force and friction."""
    axis = canvas(6.0, 3.6, xlim=(-3.2, 3.6), ylim=(-1.3, 2.9))
    x = np.linspace(-3.2, 3.4, 100)
    surface = -0.06 * x**2
    axis.plot(x, surface, color=GRAY, lw=2)
    axis.fill_between(x, surface, -1.3, color=GRAY, alpha=0.15, lw=0)
    axis.plot([-0.55, 0.0], [2.6, 0.55], color="black", lw=9, solid_capstyle="round", alpha=0.75)
    axis.plot([-0.55, -2.4], [2.6, 2.75], color="black", lw=9, solid_capstyle="round", alpha=0.75)
    axis.plot(-0.55, 2.6, "o", ms=9, mfc="white", mec="black")
    axis.add_patch(plt.Circle((0, 0.4), 0.4, fc="#bbbbbb", ec="black", zorder=3))
    axis.plot(0, 0, "o", ms=5, color="black", zorder=4)
    arrow(axis, (0, 0), (0, 1.75), BLUE)
    axis.text(0.12, 1.62, "normal force $F_I = \\nabla c\\,\\lambda$", color=BLUE, fontsize=10)
    arrow(axis, (0, 0), (1.7, 0), GREEN)
    axis.text(1.75, -0.03, "velocity $v$", color=GREEN, fontsize=10)
    arrow(axis, (0, 0), (-1.35, 0), ORANGE)
    axis.text(-1.3, 0.12, "friction $F_z$", color=ORANGE, fontsize=10, ha="center")
    arrow(axis, (-2.3, -0.32), (-2.42, 0.33), GRAY, 1.2)
    arrow(axis, (-2.3, -0.32), (-1.65, -0.2), GRAY, 1.2)
    axis.text(-2.6, 0.4, "$n$", color=GRAY, fontsize=10)
    axis.text(-1.9, -0.55, "$t_1, t_2$", color=GRAY, fontsize=10)
    axis.text(1.0, 0.75, "outside: $c > 0$", fontsize=10, color="black")
    axis.text(1.0, -0.75, "solid: $c < 0$", fontsize=10, color="black")
    saved(axis, "contact_frame")


def projection() -> None:
    """Gauss's principle: the constrained acceleration is the nearest one in the metric of M."""
    axis = canvas(6.0, 3.4, xlim=(-3.0, 4.4), ylim=(-1.4, 2.8))
    direction = np.array([1.0, 0.32])
    x = np.array([-3.0, 4.2])
    axis.plot(x, 0.32 * x, color=GRAY, lw=2)
    allowed = "motions that the\nconstraint allows:\n$A\\ddot q = b$"
    axis.text(4.15, 1.42, allowed, color=GRAY, fontsize=9, va="bottom", ha="right")
    free = np.array([0.2, 2.3])
    mass = np.array([[1.0, 0.5], [0.5, 1.3]])
    along = (direction @ mass @ free) / (direction @ mass @ direction)
    nearest = along * direction
    values, vectors = np.linalg.eigh(mass)
    radius = np.sqrt((free - nearest) @ mass @ (free - nearest))
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    width, height = 2 * radius / np.sqrt(values)
    axis.add_patch(Ellipse(tuple(free), width, height, angle=angle, fc="none", ec=BLUE, ls=":", lw=1.2))
    axis.plot(*free, "o", color=BLUE)
    axis.text(free[0] - 0.15, free[1] + 0.1, "free: $M^{-1}\\bar Q$", color=BLUE, fontsize=10, ha="right")
    arrow(axis, tuple(free), tuple(nearest), ORANGE)
    middle = 0.5 * (free + nearest)
    axis.text(middle[0] + 0.12, middle[1] + 0.1, "$M^{-1}A^T\\lambda$", color=ORANGE, fontsize=10)
    axis.plot(*nearest, "o", color="black")
    axis.text(nearest[0] + 0.05, nearest[1] - 0.38, "constrained: $\\ddot q = Lb + H\\bar Q$", fontsize=10)
    axis.text(-2.9, -1.25, "dotted: equal distance in the metric of $M$", color=BLUE, fontsize=8)
    saved(axis, "projection")


def forces_to_quantities() -> None:
    """From priors on forces to every quantity, and back by conditioning."""
    axis = canvas(7.2, 3.2, xlim=(0, 10.4), ylim=(0, 4.6))
    names = ("joint friction\n$f_1(\\dot q)$", "contact friction\n$f_2(v)$", "other forces\n$f_3(q,\\dot q)$")
    for k, name in enumerate(names):
        box(axis, 0.1, 3.25 - 1.45 * k, 2.2, 1.1, name, BLUE)
        arrow(axis, (2.35, 3.8 - 1.45 * k), (3.75, 2.35 + 0.35 * (1 - k)), BLUE, 1.2)
    axis.text(2.75, 2.5, "$E_p(x)$", fontsize=9, color=BLUE)
    box(axis, 3.8, 1.5, 2.3, 1.7, "forces\n$\\bar Q = m + \\sum E_p f_p$\n$= Q + Q_z$", ORANGE, 10)
    box(axis, 3.5, 3.65, 2.9, 0.75, "robot file: mean $m(x)$", GRAY)
    arrow(axis, (4.95, 3.63), (4.95, 3.22), GRAY, 1.2)
    axis.text(7.18, 2.36, "$B_Q,\\ B_z,\\ o$", fontsize=8, color=GREEN, ha="center", va="center")
    quantities = ("acceleration $\\ddot q$", "multiplier $\\lambda$", "contact force", "joint force $Q$")
    for k, name in enumerate(quantities):
        box(axis, 7.8, 3.55 - 1.1 * k, 2.5, 0.85, name, GREEN)
        arrow(axis, (6.15, 2.35 + 0.2 * (1.5 - k)), (7.75, 3.97 - 1.1 * k), GREEN, 1.2)
    style = {
        "arrowstyle": "-|>",
        "color": "black",
        "lw": 1.2,
        "connectionstyle": "arc3,rad=-0.25",
        "ls": "--",
    }
    axis.annotate("", (5.0, 1.45), (7.7, 0.35), arrowprops=style)
    axis.text(2.5, 0.15, "measured values\ncondition the forces", fontsize=9)
    saved(axis, "forces_to_quantities")


LAYERS = (
    ("cli, view", "commands; the motion in three dimensions", GRAY),
    ("report, sweep", "pages and their plots; many fits on a cluster", GRAY),
    ("evaluation", "errors, calibration, verdict", GRAY),
    ("models", "specification in, fit out; files; code in C", ORANGE),
    ("rollout", "integrates forces forward in time", ORANGE),
    ("logs, checks", "logs of other programs; faults in a log", GREEN),
    ("scene, simulate, control", "scene files; physics engines; planned motion", GREEN),
    ("storage", "files of models", GREEN),
    ("priors, learning", "public names of priors; hyperparameters from logs", ORANGE),
    ("forces", "the paper: unknown forces as Gaussian processes", ORANGE),
    ("gp, options", "kernels and inference, without a robot", ORANGE),
    ("data", "Dataset: columns, splits, derivatives", GREEN),
    ("constraints", "surfaces, contacts: A, b, L, T, P, H, λ", BLUE),
    ("compiled, derivatives, identification", "mechanics again: fast, differentiated, as a regressor", BLUE),
    ("kinematics, dynamics", "poses, Jacobians, M, Q_C, Q_G", BLUE),
    ("robot", "URDF and MJCF to RobotModel", BLUE),
    ("plots; errors, files, types, …", "shared tools, no physics", GRAY),
)


def layers() -> None:
    """Layers of the library, the highest on top."""
    count = len(LAYERS)
    axis = canvas(7.4, 6.3, xlim=(-0.4, 12.2), ylim=(-0.1, 0.62 * count + 0.1))
    for k, (names, what, color) in enumerate(LAYERS):
        y = 0.62 * (count - 1 - k)
        box(axis, 0.3, y, 4.9, 0.5, names, color, 8)
        axis.text(5.4, y + 0.25, what, fontsize=8.5, va="center")
    arrow(axis, (0.0, 0.62 * count - 0.15), (0.0, 0.0), GRAY, 1.5)
    axis.text(-0.15, 0.31 * count, "imports", rotation=90, va="center", ha="right", color=GRAY, fontsize=9)
    saved(axis, "layers")


if __name__ == "__main__":
    plt.rcParams.update({"svg.hashsalt": "forcegp", "mathtext.fontset": "cm"})
    for draw in (contact_frame, projection, forces_to_quantities, layers):
        draw()
