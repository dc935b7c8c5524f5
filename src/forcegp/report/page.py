"""Style of plots (colours, names and sizes), and rendering of HTML files with SVG plots and tables."""

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
from forcegp.scene.document import tomllib

TEMPLATES = Path(__file__).parent / "templates"
STYLE = TEMPLATES / "forcegp.mplstyle"
"""Style sheet for the fonts, sizes and lines of plots."""
NAMES = tomllib.loads((TEMPLATES / "names.toml").read_text(encoding="utf-8"))
COLOURS, DASHES, KINDS, LABELS = (NAMES[table] for table in ("colours", "dashes", "kinds", "labels"))
"""Line colours and dashes of models, labels for the kinds of saved models, and labels for models."""
OTHER = "#0072b2"
"""Colour of all other models. Black is reserved for measurements."""
INK = "#222222"
AXES = ("#0072b2", "#d55e00", "#007a5e")
"""Colours of the Cartesian axes x, y, z."""


@dataclass(frozen=True)
class Picture:
    """A plot as SVG text. `alt` is the text alternative."""

    svg: str
    alt: str
    title: str = ""

    @property
    def uri(self) -> str:
        """Data URI of the plot."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg.encode()).decode()


def label(model: str) -> str:
    """Return the display name of a model."""
    return LABELS.get(model) or KINDS.get(model, model)


def colour(model: str) -> str:
    """Return the colour of a model."""
    return COLOURS.get(model, COLOURS["nn"] if model.startswith("nn") else OTHER)


def line(model: str) -> str | tuple[float, tuple[float, ...]]:
    """Return the line style that distinguishes a model in a panel with several models."""
    return (0.0, DASHES[model]) if model in DASHES else "-"


def draw(paint: Callable[[Figure], None], size: tuple[float, float], alt: str, title: str = "") -> Picture:
    """Draw a plot of the given size [inch] as SVG in the project style, without changing global settings."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "forcegp"}, fname=STYLE):
        figure = Figure(figsize=size)
        paint(figure)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return Picture(buffer.getvalue(), alt, title)


Series = list[float]
DIGITS = 7
"""Number of significant digits kept in series that are only plotted."""


def series(values: Tensor) -> Series:
    """Convert a tensor `(n,)` to a list of numbers, rounded to `DIGITS` significant digits."""
    return [float(f"{value:.{DIGITS}g}") for value in values.detach().cpu().tolist()]


def columns(values: Tensor) -> list[Series]:
    """Convert a tensor `(n, d)` to d series of length n."""
    return [series(column) for column in values.unbind(-1)]


def as_tensor(values: Series | list[Series]) -> Tensor:
    """Convert one series to a tensor `(n,)`, or d series to a tensor `(d, n)`."""
    return torch.tensor(values, dtype=torch.float64)


NONE = "–"


@dataclass(frozen=True)
class Table:
    """A table of text. The first column names the rows, and `bad` lists the `(row, column)` of red cells."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    bad: frozenset[tuple[int, int]] = frozenset()


def cell(value: object, digits: int = 4) -> str:
    """Format a value as text, with floats to the given number of significant digits and `None` as a dash."""
    return NONE if value is None else text(value, digits)


@dataclass(frozen=True)
class PictureBlock:
    """Plots with a common heading and caption, in full width if `wide`. `source` is their data file."""

    heading: str
    caption: str
    pictures: tuple[Picture, ...]
    source: str
    wide: bool = False


def render(template: str, package: str = "forcegp.report", **values: object) -> str:
    """Render a template from `templates/` in the given or this package. Missing values are errors."""
    packages = dict.fromkeys((package, "forcegp.report"))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
