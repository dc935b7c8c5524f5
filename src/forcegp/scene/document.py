"""Validation of TOML files against a schema. Errors name the file, the line and the key."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from forcegp.errors import ForceGPError, SceneError, did_you_mean
from forcegp.limits import KEY_PARTS, SCENE_BYTES, SCENE_KEYS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Key = tuple[str | int, ...]
Schema = TypeVar("Schema", bound=BaseModel)
T = TypeVar("T")

_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
_NAME = r"""(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')"""
_DOTTED = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_ARRAY = re.compile(rf"^\s*\[\[\s*({_DOTTED})\s*\]\]")
_TABLE = re.compile(rf"^\s*\[\s*({_DOTTED})\s*\]")
_KEY = re.compile(rf"^\s*({_DOTTED})\s*=")
_BRACKET = re.compile(r"^[ \t]*\[", re.MULTILINE)
_TOKEN = re.compile(rf"({_NAME})|(\.)|[^\S\n]+|(.|\n)")


class Document:
    """A parsed TOML file that records the line of each key. Errors are of class `error` and name `source`."""

    def __init__(self, content: bytes, source: str, error: type[ForceGPError] = SceneError) -> None:
        self.source, self.error = source, error
        if len(content) > SCENE_BYTES:
            raise error(f"{source}: too large", expected=f"at most {SCENE_BYTES} bytes", got=len(content))
        try:
            text = content.decode("utf-8")
        except UnicodeDecodeError as cause:
            line = content[: cause.start].count(b"\n") + 1
            raise error(f"{source}:{line}: not UTF-8 text", got=str(cause)) from cause
        _check_keys(text, source, error)
        try:
            self.data: dict[str, Any] = tomllib.loads(text)
        except (ValueError, RecursionError) as cause:
            match = re.search(r"line (\d+)", str(cause))
            line = int(match[1]) if match else text.count("\n") + 1
            text = f"{source}:{line}: not valid TOML"
            raise error(text, got=str(cause) or "brackets nested too deeply") from cause
        self._lines = _lines_of_keys(text)

    def validated(self, schema: type[Schema]) -> Schema:
        """Convert the content to a pydantic model; raise the first error with its line and key."""
        # In JSON mode, strict validation accepts a list for a tuple and an integer for a float.
        try:
            return schema.model_validate_json(json.dumps(self.data, default=str))
        except RecursionError as error:
            raise self.error(f"{self.source}: nested too deeply") from error
        except ValidationError as error:
            # A misspelt key also counts as missing, and it is the spelling that has to be corrected.
            errors = sorted(error.errors(), key=lambda item: item["type"] not in _UNKNOWN_KEY)
            raise self._error(schema, errors[0]) from error

    def at(self, key: Key, make: Callable[..., T], *args: object, **options: object) -> T:
        """Return `make(*args, **options)`. Errors are reported with the location of a key in this file."""
        with self.error.within(self.place(key)):
            return make(*args, **options)

    def place(self, key: Key) -> str:
        """Return `file:line: key` for a key, or for the nearest enclosing key in the file."""
        prefix: Key = ()
        value: Any = self.data
        for part in key:
            members: Any = dict(enumerate(value)) if isinstance(value, list) else value
            if isinstance(members, dict) and part in members:
                prefix, value = (*prefix, part), members[part]
        known = (prefix[:n] for n in range(len(prefix), 0, -1) if prefix[:n] in self._lines)
        line = self._lines.get(next(known, ()))
        where = self.source if line is None else f"{self.source}:{line}"
        return f"{where}: {dotted(prefix)}" if prefix else where

    def _error(self, schema: type[BaseModel], error: ErrorDetails) -> ForceGPError:
        """Return the error to raise for a validation error of pydantic."""
        key, kind, context = error["loc"], error["type"], error.get("ctx", {})
        place, last = self.place(key), str(key[-1]) if key else ""
        if isinstance(cause := context.get("error"), ForceGPError):
            return self.error.at(self.place(self._named(key, cause.message)), cause)
        if kind == "json_invalid":  # well-formed JSON, but nested too deeply for the validator
            return self.error(f"{self.source}: nested too deeply", got=context.get("error"))
        if kind in _UNKNOWN_KEY:
            allowed = list(dict.fromkeys(name for t in _tables_at(schema, key[:-1]) for name in _hints(t)))
            hint = did_you_mean(last, allowed)
            return self.error(f"{place}: unknown key", expected=_one_of(allowed), hint=hint)
        if kind == "missing" and isinstance(key[-1], int):
            return self.error(f"{place}: too few numbers", expected=f"more than {last}")
        if kind == "missing":
            return self.error(f"{place}: key {last!r} is missing", expected=f"{last} = …")
        if kind in ("union_tag_invalid", "union_tag_not_found"):
            tags = re.findall(r"'(\w+)'", context.get("expected_tags", ""))
            tables = () if tags else _tables_at(schema, key)
            tags += [tag for table in tables for tag in get_args(_hints(table).get("type"))]
            if kind == "union_tag_not_found":
                return self.error(f"{place}: key 'type' is missing", expected=_one_of(tags))
            tag = str(context["tag"])
            message = f"{self.place((*key, 'type'))}: unknown type {tag!r}"
            return self.error(message, expected=_one_of(tags), hint=did_you_mean(tag, tags))
        return self.error(f"{place}: {error['msg'][0].lower()}{error['msg'][1:]}", got=repr(error["input"]))

    def _named(self, key: Key, message: str) -> Key:
        """Return the key of the table entry that a message names, or else the key of the table."""
        table: Any = self.data
        for part in key:
            members: Any = dict(enumerate(table)) if isinstance(table, list) else table
            table = members.get(part, table)
        name = next((name for name in table if re.search(rf"\b{re.escape(name)}\b", message)), None)
        return key if name is None else (*key, name)


def _check_keys(text: str, source: str, error: type[ForceGPError]) -> None:
    """Check the number of keys and the number of parts of each key. Parsing time is quadratic in both."""
    keys = text.count("=") + len(_BRACKET.findall(text))
    if keys > SCENE_KEYS:
        raise error(f"{source}: too many keys and tables", expected=f"at most {SCENE_KEYS}", got=keys)
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
            raise error(f"{source}:{line}: a key of too many parts", expected=f"at most {KEY_PARTS}")


def _one_of(names: list[str]) -> str:
    return f"one of {', '.join(names)}"


def _tables_at(schema: type, key: Key) -> list[type]:
    """Return the classes that may describe the table at a key."""
    tables = [schema]
    for part in key:
        members = [_hints(table)[str(part)] for table in tables if str(part) in _hints(table)]
        if members:
            tables = [table for annotation in members for table in _tables_in(annotation)]
        elif isinstance(part, str):  # the tag of a union, such as the type of a surface
            tables = [table for table in tables if part in get_args(_hints(table).get("type"))]
    return tables


def _hints(table: type) -> dict[str, Any]:
    """Return the annotation of each key of a table."""
    if issubclass(table, BaseModel):
        return {name: field.annotation for name, field in table.model_fields.items()}
    hints = get_type_hints(table)
    return {field.name: hints[field.name] for field in fields(table)}


def _tables_in(annotation: Any) -> list[type]:
    if isinstance(annotation, type) and (is_dataclass(annotation) or issubclass(annotation, BaseModel)):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables_in(part)]


def dotted(key: Key) -> str:
    """Return a key in dotted notation, such as `contact[0].surface`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).lstrip(".")


def _split(name: str) -> Key:
    return tuple(part.strip("\"'") for part in re.findall(_NAME, name))


def _lines_of_keys(text: str) -> dict[Key, int]:
    """Return the line of each table and key. Keys of an inline table have the line of that table."""
    lines: dict[Key, int] = {}
    counts: dict[Key, int] = {}
    table: Key = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if match := _ARRAY.match(line):
            name = _split(match[1])
            counts[name] = counts.get(name, -1) + 1
            table = (*name, counts[name])
            lines.setdefault(name, number)
        elif match := _TABLE.match(line):
            name = _split(match[1])
            # A table nested in an array of tables belongs to the last element of the array.
            outer = next((name[:n] for n in range(len(name), 0, -1) if name[:n] in counts), None)
            table = (*outer, counts[outer], *name[len(outer) :]) if outer else name
        elif match := _KEY.match(line):
            lines.setdefault((*table, *_split(match[1])), number)
            continue
        else:
            continue
        lines.setdefault(table, number)
    return lines
