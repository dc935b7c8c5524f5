"""Pages generated from the code: error messages with their remedies, and findings of `forcegp check`.

A line `<!-- generated: errors -->` or `<!-- generated: findings -->` of a page is replaced by a table.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

SOURCE = Path(__file__).resolve().parents[2] / "src" / "forcegp"
TYPED = set(re.findall(r"^class (\w+)\(", (SOURCE / "errors.py").read_text(encoding="utf-8"), flags=re.M))


def template(node: ast.expr | None) -> str:
    """The text of a message, with … for what is inserted; empty where it is not written out."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
    return ""


def assigned(function: ast.AST) -> dict[str, list[tuple[int, ast.expr]]]:
    """Lines and values of the assignments to each name in a function."""
    values: dict[str, list[tuple[int, ast.expr]]] = defaultdict(list)
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(target.elts, node.value.elts, strict=True))
                for name, value in pairs:
                    if isinstance(name, ast.Name):
                        values[name.id].append((node.lineno, value))
    return values


def raised(source: Path = SOURCE) -> Iterator[tuple[str, str, str]]:
    """Class, message and hint of each error whose text is written out, there or in a name just before."""
    for path in sorted(source.rglob("*.py")):
        functions = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        for function in (x for x in functions if isinstance(x, ast.FunctionDef)):
            values = assigned(function)
            for node in ast.walk(function):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in TYPED:
                    hints = [keyword.value for keyword in node.keywords if keyword.arg == "hint"]
                    message, hint = (
                        template(latest(x[0], values, node.lineno) if x else None) for x in (node.args, hints)
                    )
                    if message:
                        yield node.func.id, message, hint


def latest(node: ast.expr, values: dict[str, list[tuple[int, ast.expr]]], line: int) -> ast.expr:
    """An expression, or for a name, what was assigned to it last before a line."""
    known = values.get(node.id, []) if isinstance(node, ast.Name) else []
    return max(((at, x) for at, x in known if at <= line), key=lambda pair: pair[0], default=(line, node))[1]


def cell(text: str) -> str:
    """Text of a table: no markup but code between backticks."""
    parts = re.split(r"(`[^`|]+`)", " ".join(text.split()))
    plain = (re.sub(r"([|*_`<>\[\]$\\])", r"\\\1", part) for part in parts[::2])
    return "".join(piece for pair in zip(plain, [*parts[1::2], ""], strict=True) for piece in pair)


def explained() -> list[list[str]]:
    """The messages of the page on troubleshooting, split at what is inserted."""
    page = (SOURCE.parents[1] / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([^`]*)` \|", page[: page.index("## Results that look wrong")], flags=re.M)
    return [[part.strip() for part in row.split("…") if part.strip()] for row in rows]


def errors() -> str:
    """A section with a table for each class of errors; the commonest messages link to cause and cure."""
    common = explained()
    sections: dict[str, set[tuple[str, str]]] = defaultdict(set)
    for name, message, hint in raised():
        sections[name].add((message, hint))
    text = ""
    for name, rows in sorted(sections.items()):
        text += f"\n## {name}\n\n| message | hint |\n|---|---|\n"
        for message, hint in sorted(rows):
            cure = " ([cause and cure](../troubleshooting.md))"
            linked = any(all(part in message for part in parts) for parts in common)
            text += f"| {cell(message)} | {cell(hint) + (cure if linked else '') or '–'} |\n"
    return text


def findings() -> str:
    """All kinds of findings of `forcegp check`."""
    from forcegp.checks import KINDS

    head = "| kind | family | severity | meaning | remedy |\n|---|---|---|---|---|\n"
    return head + "".join(
        f"| `{name}` | {kind.family} | {kind.severity} | {kind.title} | {kind.remedy} |\n"
        for name, kind in KINDS.items()
    )


def _insert(app: Sphinx, docname: str, source: list[str]) -> None:
    for name, made in (("errors", errors), ("findings", findings)):
        mark = f"<!-- generated: {name} -->"
        if mark in source[0]:
            source[0] = source[0].replace(mark, made())


def setup(app: Sphinx) -> dict[str, Any]:
    """Replace the marks when a page is read."""
    app.connect("source-read", _insert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
