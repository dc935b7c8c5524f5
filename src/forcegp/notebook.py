"""Notebook output: small HTML tables with escaped text, and progress bars for fits."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from html import escape
from typing import Any

_TABLE = "border-collapse:collapse;font-variant-numeric:tabular-nums"
_CELL = "text-align:right;padding:.15em .7em"
_FIRST = "text-align:left;padding:.15em .7em"


def html_table(
    title: str, head: Sequence[str] = (), rows: Sequence[Sequence[object]] = (), notes: Sequence[str] = ()
) -> str:
    """Return a titled table as HTML without scripts. Numbers have four significant digits.

    Args:
        title, notes: text above and below the table.
        head: column names; the first column contains the row names.
        rows: cells.

    Example:
        >>> html_table("a <b>")
        '<div><p><b>a &lt;b&gt;</b></p></div>'
    """
    parts = [f"<p><b>{escape(title)}</b></p>"]
    if head or rows:
        top = f"<thead>{_row(head, 'th')}</thead>" if head else ""
        body = "".join(_row([text(value) for value in row], "td") for row in rows)
        parts.append(f'<table style="{_TABLE}">{top}<tbody>{body}</tbody></table>')
    parts += [f"<p>{escape(note)}</p>" for note in notes]
    return f"<div>{''.join(parts)}</div>"


def text(value: object, digits: int = 4) -> str:
    """Format a value as text, with floats rounded to `digits` significant digits."""
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def _row(cells: Sequence[str], tag: str) -> str:
    styled = zip([_FIRST, *[_CELL] * len(cells)], cells, strict=False)
    parts = (f'<{tag} style="{style}">{escape(cell)}</{tag}>' for style, cell in styled)
    return f"<tr>{''.join(parts)}</tr>"


class FitBar:
    """A progress bar for `fit(…, progress=FitBar())` in a notebook cell; elsewhere, it displays nothing.

    Example:
        >>> bar = FitBar()
        >>> bar(3, 200, 12.5)
        >>> bar.html()
        '<progress value="3" max="200"></progress> 3 of at most 200 evaluations, objective 12.5'
    """

    def __init__(self) -> None:
        self.done, self.total, self.objective = 0, 0, float("nan")
        self._shown: Any = None

    def __call__(self, done: int, total: int, objective: float) -> None:
        """Show the number of evaluations, which is at most `total`, and the objective."""
        self.done, self.total, self.objective = done, total, objective
        interactive = sys.modules.get("IPython")
        if interactive is None or interactive.get_ipython() is None:
            return
        content = {"text/html": self.html(), "text/plain": self.html().split("> ")[-1]}
        if self._shown is None:
            self._shown = interactive.display.display(content, raw=True, display_id=True)
        else:
            self._shown.update(content, raw=True)

    def html(self) -> str:
        """Return the bar and its numbers as HTML."""
        bar = f'<progress value="{self.done}" max="{self.total}"></progress>'
        most = f" of at most {self.total}" if self.done < self.total else ""
        return f"{bar} {self.done}{most} evaluations, objective {text(self.objective)}"
