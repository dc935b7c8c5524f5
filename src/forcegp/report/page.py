"""Style of plots: colours, names and sizes; pages as single HTML files, with plots as SVG text and tables."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jinja2
import matplotlib
import torch
from matplotlib.figure import Figure
from torch import Tensor

from forcegp.notebook import text

COLOURS = {
    "analytical": "#9c2f1a",
    "nn": "#d08c00",
    "gp": "#0072b2",
    "sgp-zero": "#c4488c",
    "sgp-mean": "#6a3d9a",
    "sgp-contact": "#007a5e",
}
"""One colour per model, distinguishable by colour-blind readers and in print."""
DASHES = {"nn-30-20": (1.0, 1.2), "nn-200x4": (5.0, 1.5, 1.0, 1.5)}
"""Dashes and gaps, in line widths, of the networks that share the first one's colour."""
KINDS = {
    "analytical": "Analytical model",
    "neural_network": "Neural network",
    "independent_gp": "GP",
    "structured_gp": "Structured GP",
}
"""What the kinds of saved models are called."""
OTHER = "#0072b2"
"""Colour of a model without one of its own; not black, as measurements are."""
INK = "#222222"
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
"""What a model is called in plots and tables."""

STYLE = Path(__file__).parent / "templates" / "forcegp.mplstyle"
"""Fonts, sizes and lines of plots."""


@dataclass(frozen=True)
class Picture:
    """A drawn plot as the text of an SVG file; `alt` is its text alternative."""

    svg: str
    alt: str
    title: str = ""

    @property
    def uri(self) -> str:
        """The plot as a data URI."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg.encode()).decode()


def label(model: str) -> str:
    """The display name of a model."""
    return LABELS.get(model) or KINDS.get(model, model)


def colour(model: str) -> str:
    """The colour of a model."""
    return COLOURS.get(model, COLOURS["nn"] if model.startswith("nn") else OTHER)


def line(model: str) -> str | tuple[float, tuple[float, ...]]:
    """The line style of a model, for curves of several models in one panel."""
    return (0.0, DASHES[model]) if model in DASHES else "-"


def draw(paint: Callable[[Figure], None], size: tuple[float, float], alt: str, title: str = "") -> Picture:
    """Draw a plot of a size [inch] as SVG in the style of this project, without changing global settings."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "forcegp"}, fname=STYLE):
        figure = Figure(figsize=size)
        paint(figure)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return Picture(buffer.getvalue(), alt, title)


Series = list[float]
DIGITS = 7
"""Significant digits kept in series that are only drawn."""


def series(values: Tensor) -> Series:
    """A tensor `(n,)` as numbers for a file, rounded to the resolution of a plot."""
    return [float(f"{value:.{DIGITS}g}") for value in values.detach().cpu().tolist()]


def columns(values: Tensor) -> list[Series]:
    """A tensor `(n, d)` as d series."""
    return [series(column) for column in values.unbind(-1)]


def as_tensor(values: Series | list[Series]) -> Tensor:
    """Series `(n,)` or `(d, n)` as a tensor."""
    return torch.tensor(values, dtype=torch.float64)


NONE = "–"


@dataclass(frozen=True)
class Table:
    """A table as text; the first column names the rows, `bad` contains `(row, column)` of red cells."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    bad: frozenset[tuple[int, int]] = frozenset()


def cell(value: object, digits: int = 4) -> str:
    """One value as text: floats with significant digits, a dash for a missing value."""
    return NONE if value is None else text(value, digits)


@dataclass(frozen=True)
class PictureBlock:
    """Pictures under one heading and caption, with the width of the page if `wide`; `source` is the file with
    their data.
    """

    heading: str
    caption: str
    pictures: tuple[Picture, ...]
    source: str
    wide: bool = False


def render(template: str, package: str = "forcegp.report", **values: object) -> str:
    """Render a template under `templates/` of the package, or of this one; a missing value is an error."""
    packages = dict.fromkeys((package, "forcegp.report"))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
