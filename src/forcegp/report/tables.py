"""Tables as rows of text, for pages and for Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    known = [float(v) for v in values if v is not None]
    if not known:
        return NONE
    mean = sum(known) / len(known)
    plain = 1e-3 <= abs(mean) < 1e4 or mean == 0.0
    text = f"{mean:.{digits}f}" if plain else f"{mean:.1e}"
    spread = (max(known) - min(known)) / 2.0
    return text if len(known) == 1 or not plain or mean == 0.0 else f"{text} ± {spread:.{digits}f}"


def cell(value: object, digits: int = 4) -> str:
    """One value as text: floats with significant digits, a dash for nothing."""
    return f"{value:.{digits}g}" if isinstance(value, float) else NONE if value is None else str(value)
