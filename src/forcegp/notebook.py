"""What notebooks show of an object: a small HTML table, every text in it escaped."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

_TABLE = "border-collapse:collapse;font-variant-numeric:tabular-nums"
_CELL = "text-align:right;padding:.15em .7em"
_FIRST = "text-align:left;padding:.15em .7em"


def html_table(
    title: str, head: Sequence[str] = (), rows: Sequence[Sequence[object]] = (), notes: Sequence[str] = ()
) -> str:
    """A titled table as HTML; numbers are shown with four significant digits.

    Args:
        title: one line above.
        head: names of the columns; the first column names the rows.
        rows: cells.
        notes: lines below.

    Returns:
        HTML without scripts or references.

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


def text(value: object) -> str:
    """A value in a few characters."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _row(cells: Sequence[str], tag: str) -> str:
    styles = (_CELL if i else _FIRST for i in range(len(cells)))
    pairs = zip(styles, map(escape, cells), strict=True)
    parts = (f'<{tag} style="{style}">{cell}</{tag}>' for style, cell in pairs)
    return f"<tr>{''.join(parts)}</tr>"
