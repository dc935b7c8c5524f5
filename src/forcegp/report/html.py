"""Pages as single HTML files: templates, style and plots in one file that fetches nothing.

Tables as rows of text, for pages and for Markdown.

Numbers in result files: rounded series, and parts of a file that reject unknown fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jinja2
import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor

from forcegp.report.style import Picture

Series = list[float]
DIGITS = 7
"""Significant digits kept in series that are only drawn."""


class Part(BaseModel):
    """A part of a result file: frozen, no unknown field, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def series(values: Tensor) -> Series:
    """A tensor `(n,)` as numbers for a file, rounded to what a plot can show."""
    return [float(f"{value:.{DIGITS}g}") for value in values.detach().cpu().tolist()]


def columns(values: Tensor) -> list[Series]:
    """A tensor `(n, d)` as d series."""
    return [series(column) for column in values.unbind(-1)]


def matrix(values: Tensor) -> list[Series]:
    """A tensor `(n, d)` as n rows."""
    return [series(row) for row in values.unbind(0)]


def as_tensor(values: Series | list[Series]) -> Tensor:
    """Series `(n,)` or `(d, n)` as a tensor."""
    return torch.tensor(values, dtype=torch.float64)


NONE = "–"


@dataclass(frozen=True)
class Table:
    """A table as text.

    Attributes:
        caption: what it contains, with units.
        head: names of the columns; the first column names the rows.
        rows: the cells of each row.
        bad: `(row, column)` of cells to print in red.
    """

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


def number(values: Sequence[float | int | None], digits: int = 3) -> str:
    """The mean of values over seeds, with half their range if there are several."""
    present = [float(v) for v in values if v is not None]
    if not present:
        return NONE
    mean = sum(present) / len(present)
    plain = 1e-3 <= abs(mean) < 1e4 or mean == 0.0
    text = f"{mean:.{digits}f}" if plain else f"{mean:.1e}"
    spread = (max(present) - min(present)) / 2.0
    return text if len(present) == 1 or not plain or mean == 0.0 else f"{text} ± {spread:.{digits}f}"


def cell(value: object, digits: int = 4) -> str:
    """One value as text: floats with significant digits, a dash for nothing."""
    return f"{value:.{digits}g}" if isinstance(value, float) else NONE if value is None else str(value)


@dataclass(frozen=True)
class PictureBlock:
    """Pictures under one heading and caption.

    Attributes:
        heading: the title, with the paper's figure number if it has one.
        caption: what the pictures show.
        pictures: the panels.
        source: file with the data.
    """

    heading: str
    caption: str
    pictures: tuple[Picture, ...]
    source: str


@dataclass(frozen=True)
class Statement:
    """A sentence computed from results.

    Attributes:
        topic: a few words.
        agrees: whether the claim holds; `None` if none is made.
        text: the sentence, with its numbers.
        words: verdict on a claim that holds, and on one that does not.
    """

    topic: str
    agrees: bool | None
    text: str
    words: tuple[str, str] = ("confirmed", "differs")

    @property
    def verdict(self) -> str | None:
        """The verdict, or `None` if no claim is made."""
        return None if self.agrees is None else self.words[0 if self.agrees else 1]


def render(template: str, package: str = "forcegp.report", **values: object) -> str:
    """Fill in a template; a missing value is an error.

    Args:
        template: file name under `templates/` of the package, or of this one.
        package: where to look first.
        values: what the template refers to.
    """
    packages = dict.fromkeys((package, "forcegp.report"))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
