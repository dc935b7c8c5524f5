"""How figures look: colours, names and sizes; and figures as text that a page can hold."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = {
    "analytical": "#9c2f1a",
    "nn": "#d08c00",
    "gp": "#0072b2",
    "sgp-zero": "#c4488c",
    "sgp-mean": "#6a3d9a",
    "sgp-contact": "#007a5e",
}
"""One colour a model, told apart by colour-blind readers and on paper."""
MARKERS = {"analytical": "x", "nn": "v", "gp": "s", "sgp-zero": "o", "sgp-mean": "D", "sgp-contact": "^"}
DASHES = {"nn-30-20": (1.0, 1.2), "nn-200x4": (5.0, 1.5, 1.0, 1.5)}
"""Lengths of dashes and gaps of the networks that share a colour with the first, in line widths."""
OTHER = "#555555"
INK = "#222222"
FAINT = "#b8b8b8"
AXES = ("#0072b2", "#d55e00", "#007a5e")
"""Colours of the Cartesian axes x, y, z."""
LABELS = {
    "analytical": "Analytical model",
    "nn": "Neural network, 80",
    "nn-80": "Neural network, 80",
    "nn-30-20": "Neural network, 30-20",
    "nn-200x4": "Neural network, 4×200",
    "gp": "GP",
    "sgp-zero": "S-GP, zero mean",
    "sgp-mean": "S-GP, analytical mean",
    "sgp-contact": "S-GP, mean and contact prior",
    "sgp-zero-se": "S-GP, zero mean, paper's kernel",
    "sgp-mean-se": "S-GP, analytical mean, paper's kernel",
    "sgp-contact-se": "S-GP, mean and contact prior, paper's kernel",
}
"""What a model is called in figures and tables."""

SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "lines.linewidth": 1.1,
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.h_pad": 0.02,
    "figure.constrained_layout.w_pad": 0.03,
    "path.simplify_threshold": 0.5,
    "svg.fonttype": "path",
    "svg.hashsalt": "forcegp",
}


@dataclass(frozen=True)
class Picture:
    """A drawn figure.

    Attributes:
        svg: the file's text.
        alt: what it shows, for those who do not see it.
        title: short heading, such as the model's name.
    """

    svg: str
    alt: str
    title: str = ""

    @property
    def uri(self) -> str:
        """The figure as an address that needs no file."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg.encode()).decode()


def label(model: str) -> str:
    """What a model is called."""
    return LABELS.get(model, model)


def colour(model: str) -> str:
    """The colour of a model."""
    return COLOURS.get(model, COLOURS["nn"] if model.startswith("nn") else OTHER)


def line(model: str) -> str | tuple[float, tuple[float, ...]]:
    """The line style of a model, for curves of several models in one panel."""
    return (0.0, DASHES[model]) if model in DASHES else "-"


def draw(paint: Callable[[Figure], None], size: tuple[float, float], alt: str, title: str = "") -> Picture:
    """A figure as SVG, drawn in the style of this project without touching the settings of others.

    Args:
        paint: fills the empty figure.
        size: width and height [inch]; a page column is 4.6 wide.
        alt: what the figure shows.
        title: short heading.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=size)
        paint(figure)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return Picture(buffer.getvalue(), alt, title)


def shade(axes: Axes, spans: list[tuple[float, float]]) -> None:
    """Mark spans of time behind the curves."""
    for first, last in spans:
        axes.axvspan(first, last, color="#f1ead2", zorder=0, linewidth=0)
