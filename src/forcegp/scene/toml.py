"""TOML with the line of every key, so that an error can say where to look."""

from __future__ import annotations

import re
import sys
from typing import Any

from forcegp.errors import SceneError
from forcegp.files import depth
from forcegp.limits import KEY_PARTS, SCENE_BYTES, SCENE_DEPTH, SCENE_KEYS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Key = tuple[str | int, ...]

_NAME = r"""(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')"""
_DOTTED = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_ARRAY = re.compile(rf"^\s*\[\[\s*({_DOTTED})\s*\]\]")
_TABLE = re.compile(rf"^\s*\[\s*({_DOTTED})\s*\]")
_KEY = re.compile(rf"^\s*({_DOTTED})\s*=")
_BRACKET = re.compile(r"^[ \t]*\[", re.MULTILINE)
_TOKEN = re.compile(rf"({_NAME})|(\.)|[^\S\n]+|(.|\n)")


class Document:
    """A parsed TOML file that knows the line of each key.

    Args:
        content: the bytes of the file.
        source: its name, for messages.

    Raises:
        SceneError: it is not TOML; the message names file and line.
    """

    def __init__(self, content: bytes, source: str) -> None:
        self.source = source
        if len(content) > SCENE_BYTES:
            raise SceneError(
                f"{source}: too large", expected=f"at most {SCENE_BYTES} bytes", got=len(content)
            )
        try:
            text = content.decode("utf-8")
        except UnicodeDecodeError as cause:
            line = content[: cause.start].count(b"\n") + 1
            raise SceneError(f"{source}:{line}: not UTF-8 text", got=str(cause)) from cause
        _check_keys(text, source)
        try:
            self.data: dict[str, Any] = tomllib.loads(text)
        except (ValueError, RecursionError) as cause:
            found = re.search(r"line (\d+)", str(cause))
            line = int(found[1]) if found else text.count("\n") + 1
            raise SceneError(
                f"{source}:{line}: not valid TOML", got=str(cause) or "brackets nested too deeply"
            ) from cause
        if depth(self.data) > SCENE_DEPTH:
            raise SceneError(f"{source}: nested too deeply", expected=f"at most {SCENE_DEPTH} levels")
        self._lines = _lines_of_keys(text)

    def place(self, key: Key) -> str:
        """`file:line: key` of a key, or of the nearest one around it that is in the file."""
        known: Key = ()
        value: Any = self.data
        for part in key:
            members: Any = dict(enumerate(value)) if isinstance(value, list) else value
            if isinstance(members, dict) and part in members:
                known, value = (*known, part), members[part]
        line = next(
            (self._lines[known[:n]] for n in range(len(known), 0, -1) if known[:n] in self._lines), None
        )
        where = self.source if line is None else f"{self.source}:{line}"
        return f"{where}: {dotted(known)}" if known else where


def dotted(key: Key) -> str:
    """A key as people write it: `contact[0].surface`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).lstrip(".")


def _check_keys(text: str, source: str) -> None:
    """Check the number of keys and of the parts of each: a parser takes quadratic time for either."""
    keys = text.count("=") + len(_BRACKET.findall(text))
    if keys > SCENE_KEYS:
        raise SceneError(f"{source}: too many keys and tables", expected=f"at most {SCENE_KEYS}", got=keys)
    parts, joined = 0, False
    for token in _TOKEN.finditer(text):
        name, dot, other = token.groups()
        if name:
            parts, joined = (parts + 1 if joined else 1), False
        elif dot:
            joined = True
        elif other:
            parts, joined = 0, False
        if parts > KEY_PARTS:
            line = text.count("\n", 0, token.start()) + 1
            raise SceneError(f"{source}:{line}: a key of too many parts", expected=f"at most {KEY_PARTS}")


def _split(name: str) -> Key:
    return tuple(part.strip("\"'") for part in re.findall(_NAME, name))


def _lines_of_keys(text: str) -> dict[Key, int]:
    """Line of each table and key; of keys in an inline table, only the line of the table."""
    lines: dict[Key, int] = {}
    counts: dict[Key, int] = {}
    table: Key = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if found := _ARRAY.match(line):
            name = _split(found[1])
            counts[name] = counts.get(name, -1) + 1
            table = (*name, counts[name])
            lines.setdefault(name, number)
        elif found := _TABLE.match(line):
            name = _split(found[1])
            # A table below an array of tables belongs to the latest of them.
            outer = next((name[:n] for n in range(len(name), 0, -1) if name[:n] in counts), None)
            table = (*outer, counts[outer], *name[len(outer) :]) if outer else name
        elif found := _KEY.match(line):
            lines.setdefault((*table, *_split(found[1])), number)
            continue
        else:
            continue
        lines.setdefault(table, number)
    return lines
