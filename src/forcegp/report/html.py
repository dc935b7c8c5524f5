"""Pages as single HTML files that fetch nothing: tables, blocks of plots, and series in result files."""

from __future__ import annotations

from dataclasses import dataclass

import jinja2
import torch
from torch import Tensor

from forcegp.notebook import text
from forcegp.report.style import Picture

Series = list[float]
DIGITS = 7
"""Significant digits kept in series that are only drawn."""


def series(values: Tensor) -> Series:
    """A tensor `(n,)` as numbers for a file, rounded to what a plot can show."""
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
    """A table as text; the first column names the rows, `bad` holds `(row, column)` of cells in red."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    bad: frozenset[tuple[int, int]] = frozenset()

    def markdown(self) -> str:
        """The table with its caption as Markdown."""

        def line(cells: tuple[str, ...]) -> str:
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

        rule = "|" + "---|" * len(self.head)
        return "\n".join([f"{self.caption}:", "", line(self.head), rule, *map(line, self.rows)])


def cell(value: object, digits: int = 4) -> str:
    """One value as text: floats with significant digits, a dash for nothing."""
    return NONE if value is None else text(value, digits)


@dataclass(frozen=True)
class PictureBlock:
    """Pictures under one heading and caption, as wide as the page if `wide`; `source` has their data."""

    heading: str
    caption: str
    pictures: tuple[Picture, ...]
    source: str
    wide: bool = False


def render(template: str, package: str = "forcegp.report", **values: object) -> str:
    """Fill in a template under `templates/` of the package, or of this one; a missing value is an error."""
    packages = dict.fromkeys((package, "forcegp.report"))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
