"""The size of the library: Python files, their lines and lines of code in each folder of `src/forcegp`.

    python benchmarks/size.py                 # the folders, largest first
    python benchmarks/size.py --json size.json

A line of code is a line that holds part of a statement: no docstring, no comment, no blank line, no import.
Templates, robots and scenes are counted beside the Python files.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import tokenize
from collections import Counter
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "forcegp"
LAYOUT = {"COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER"}
"""Tokens that make no line a line of code."""


def no_code(tree: ast.Module) -> set[int]:
    """Lines of docstrings (of attributes too) and of imports."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom) or (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def code_lines(text: str) -> int:
    """Number of lines with code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if tokenize.tok_name[token.type] not in LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - no_code(ast.parse(text)))


def sizes(source: Path = SOURCE) -> dict[str, Counter[str]]:
    """Files, lines and lines of code for each folder; modules beside the folders are `.`."""
    result: dict[str, Counter[str]] = {}
    for path in sorted(source.rglob("*")):
        if not path.is_file() or "__pycache__" in path.parts:
            continue
        parts = path.relative_to(source).parts
        text = path.read_text(encoding="utf-8")
        row = result.setdefault(parts[0] if len(parts) > 1 else ".", Counter())
        if path.suffix == ".py":
            row.update(files=1, lines=len(text.splitlines()), code=code_lines(text))
        else:
            row.update(other=1, other_lines=len(text.splitlines()))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--source", type=Path, default=SOURCE, help="the package that is counted")
    options = parser.parse_args()
    rows = dict(sorted(sizes(options.source).items(), key=lambda item: -item[1]["lines"]))
    rows["total"] = sum(rows.values(), Counter())
    columns = ("files", "lines", "code", "other", "other_lines")
    print(f"{'':14}" + "".join(f"{name:>12}" for name in columns))
    for name, row in rows.items():
        print(f"{name:14}" + "".join(f"{row[column]:12}" for column in columns))
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
