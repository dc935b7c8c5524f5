"""Sentences that are computed from results, and numbers over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from forcegp.report import NONE, Table


def number(values: Sequence[float | int | None], digits: int = 3) -> str:
    """Return the mean over seeds, with half the range if there are several."""
    present = [float(v) for v in values if v is not None]
    if not present:
        return NONE
    mean = sum(present) / len(present)
    plain = 1e-3 <= abs(mean) < 1e4 or mean == 0.0
    text = f"{mean:.{digits}f}" if plain else f"{mean:.1e}"
    spread = (max(present) - min(present)) / 2.0
    return text if len(present) == 1 or not plain or mean == 0.0 else f"{text} ± {spread:.{digits}f}"


@dataclass(frozen=True)
class Statement:
    """A sentence computed from results.

    Attributes:
        topic: a few words.
        agrees: whether the claim holds; `None` if no claim is made.
        text: the sentence, with its numbers.
        words: verdicts for a claim that holds and for one that does not.
    """

    topic: str
    agrees: bool | None
    text: str
    words: tuple[str, str] = ("confirmed", "differs")

    @property
    def verdict(self) -> str | None:
        """The verdict, or `None` if no claim is made."""
        return None if self.agrees is None else self.words[0 if self.agrees else 1]


def markdown(table: Table) -> str:
    """Return a table with its caption as Markdown."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    rule = "|" + "---|" * len(table.head)
    return "\n".join([f"{table.caption}:", "", line(table.head), rule, *map(line, table.rows)])
