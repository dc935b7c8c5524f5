"""Errors of a mapping file with the line and key of what is wrong."""

from __future__ import annotations

import json
from difflib import get_close_matches
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from forcegp.errors import MappingError
from forcegp.scene.toml import Document, Key

S = TypeVar("S", bound=BaseModel)


def validated(tables: type[S], document: Document) -> S:
    """Check a document against its tables.

    Args:
        tables: the model of all tables.
        document: the TOML file.

    Raises:
        MappingError: the first thing that is wrong, with its line and key.
    """
    # JSON is the form in which strict validation takes a list for a tuple and an integer for a number.
    text = json.dumps(document.data, default=str)
    try:
        return tables.model_validate_json(text)
    except ValidationError as error:
        errors = sorted(error.errors(), key=lambda found: found["type"] != "extra_forbidden")
        first = errors[0]
        key: Key = tuple(part for part in first["loc"] if part not in ("float", "dict[str,float]"))
        place = document.place(key)
        if first["type"] == "extra_forbidden":
            known = _known_keys(tables, key)
            near = get_close_matches(str(key[-1]), known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else None
            raise MappingError(
                f"{place}: unknown key", expected=f"one of {', '.join(known)}", hint=hint
            ) from error
        if first["type"] == "missing":
            raise MappingError(
                f"{place}: key {str(key[-1])!r} is missing", expected=f"{key[-1]} = …"
            ) from error
        message = f"{first['msg'][0].lower()}{first['msg'][1:]}"
        raise MappingError(f"{place}: {message}", got=repr(first["input"])[:200]) from error


def _known_keys(tables: type[BaseModel], key: Key) -> list[str]:
    """The keys of the table that a key stands in."""
    table = tables
    for part in key[:-1]:
        if part in table.model_fields:
            inner = _table_in(table.model_fields[str(part)].annotation)
            table = inner if inner is not None else table
    return list(table.model_fields)


def _table_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for part in get_args(annotation) if (found := _table_in(part)) is not None), None)
