"""Conversion of frozen descriptions, such as kernels and force priors, to JSON and back.

Only classes in a given table are written and read, field by field. A description that contains Python code
(an operator or a function) has no JSON form and is rejected. Reading checks names and types, and executes no
code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from forcegp.errors import ModelError, UnknownNameError, near_names

Classes = Mapping[str, type]
"""Classes that may be written and read, keyed by their names in the file."""

IMPORT = "import the module that defines it before loading"
"""What to do if a file contains a class that is not in the table, such as a law of the user."""
MAX_DEPTH = 40
"""Maximum nesting depth. A sum of kernels has one level per term."""
_CHECK = ConfigDict(arbitrary_types_allowed=True, strict=True, allow_inf_nan=False)


def encode(value: Any, classes: Classes) -> Any:
    """Return a description as JSON-compatible values; raise `ModelError` if a class has no JSON form."""
    # A notebook defines a class again when its cell runs again.
    names = {(kind.__module__, kind.__qualname__): name for name, kind in classes.items()}
    if name := names.get((type(value).__module__, type(value).__qualname__)):
        members = {field.name: encode(getattr(value, field.name), classes) for field in _written(value)}
        return {"type": name, **members}
    if isinstance(value, tuple | list):
        return [encode(part, classes) for part in value]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    text = f"a {type(value).__name__} contains Python code and cannot be saved"
    raise ModelError(text, expected=", ".join(sorted(classes)))


def decode(json: Any, classes: Classes, place: str, depth: int = 0, *, whole: bool = True) -> Any:
    """Restore a description from `encode`. Missing fields take their defaults unless `whole` is set.

    Raises:
        ForceGPError: a field is missing, unknown or of the wrong type, or a class is unknown. The message
            names the location.
    """
    if depth > MAX_DEPTH:
        raise ModelError(f"{place}: nested too deeply", expected=f"at most {MAX_DEPTH} levels")

    def within(key: object, part: Any) -> Any:
        return decode(part, classes, f"{place}.{key}", depth + 1, whole=whole)

    if isinstance(json, list):
        return tuple(within(i, part) for i, part in enumerate(json))
    if not isinstance(json, dict):
        return json
    name = str(json.get("type"))
    if name not in classes:
        raise UnknownNameError(f"type in {place}", name, classes, IMPORT)
    kind = classes[name]
    assert is_dataclass(kind)
    members = {key: value for key, value in json.items() if key != "type"}
    _check_fields(kind, name, members, place, whole)
    hints = get_type_hints(kind)
    values = {k: _checked(within(k, part), hints[k], f"{place}.{k}") for k, part in members.items()}
    with ModelError.within(place):
        return kind(**values)


def _written(kind: Any) -> list[Field[Any]]:
    """Return the fields that define a description, excluding those added by learning."""
    return [field for field in fields(kind) if field.init]


def _check_fields(kind: type, name: str, members: Mapping[str, Any], place: str, whole: bool) -> None:
    """Raise `ModelError` if a field is unknown or missing."""
    assert is_dataclass(kind)
    names = {field.name for field in _written(kind)}
    without = {f.name for f in _written(kind) if f.default is MISSING and f.default_factory is MISSING}
    needed = names if whole else without
    if needed <= set(members) <= names:
        return
    near = [other for key in members if key not in names for other in near_names(key, names)]
    text, hint = f"{place}: wrong fields of {name!r}", f"did you mean {near[0]!r}?" if near else None
    raise ModelError(text, expected=sorted(names), got=sorted(members), hint=hint)


def _checked(value: Any, hint: Any, place: str) -> Any:
    """Check a value against the declared type of its field, and convert it."""
    if isinstance(hint, type) and is_dataclass(hint):
        if not isinstance(value, hint):
            raise ModelError(f"{place} is not valid", expected=hint.__name__, got=type(value).__name__)
        return value
    try:
        return TypeAdapter(hint, config=_CHECK).validate_python(value, strict=True)
    except ValidationError as cause:
        first = cause.errors()[0]
        raise ModelError(f"{place} is not valid", expected=first["msg"], got=first["input"]) from cause
