"""How a text table is written: encoding, separator, decimal mark, heading, first line of numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs import bounds

SAMPLE_BYTES = 1 << 18
"""How much of a file is looked at."""
SAMPLE_LINES = 200
"""How many lines of numbers must agree."""

SEPARATORS = (";", "\t", ",", "|", " ")
"""Candidates; a space stands for any run of blanks."""
MISSING = ("", "nan", "NaN", "NAN", "null", "NULL", "NA", "N/A", "None", "-nan", "#N/A")
"""Fields that say that there is no value."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?$|[+-]?(inf|infinity)$", re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?$")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:?\d\d)?$")
_UNIT = re.compile(r"^[\[(]?\s*([A-Za-zµ°%][\w°²^/*·. -]{0,15}|-|1)?\s*[\])]?$")


@dataclass(frozen=True)
class Dialect:
    """How a text table is written.

    Args:
        encoding: of the text.
        separator: one of `SEPARATORS`.
        decimal: decimal mark, a point or a comma.
        first_line: number of lines before the first line of numbers.
        names: name of each column.
        kinds: `number`, `bool`, `date` or `text`, one per column.
        units: name → unit, where a line below the heading declares units.
    """

    encoding: str
    separator: str
    decimal: str
    first_line: int
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    units: dict[str, str]


def sniff(path: Path) -> Dialect:
    """Find out how a text table is written, from its first lines.

    Raises:
        DataError: the file is empty, binary, or has no two lines with equally many numbers.
    """
    with path.open("rb") as file:
        head = file.read(SAMPLE_BYTES)
    text, encoding = _decode(path, head)
    lines = text.splitlines()
    if len(head) == SAMPLE_BYTES:
        lines = lines[:-1]
    if not any(line.strip() for line in lines):
        raise DataError(f"{path}: the file is empty" if not head else f"{path}: a line is too long")
    found = max((_try(lines, s, d) for s in SEPARATORS for d in ".," if s != d), key=lambda item: item[0])
    score, separator, decimal, first = found
    if score <= 0:
        raise DataError(
            f"{path}: no table of numbers was found",
            expected="lines of numbers with one separator, after an optional heading",
            got=repr(lines[0][:120]),
        )
    return _dialect(path, lines, encoding, separator, decimal, first)


def split(line: str, separator: str) -> list[str]:
    """Fields of a line, without blanks and quotation marks around them.

    >>> split("a;  b ;", ";")
    ['a', 'b', '']
    """
    parts = line.split() if separator == " " else line.split(separator)
    return [part.strip().strip('"').strip() for part in parts]


def is_number(field: str, decimal: str = ".") -> bool:
    """Whether a field is a number, or says that there is none."""
    if field in MISSING:
        return True
    return bool((_COMMA_NUMBER if decimal == "," else _NUMBER).match(field))


def _decode(path: Path, head: bytes) -> tuple[str, str]:
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if head.startswith(mark):
            return head.decode(encoding, errors="replace"), encoding
    if b"\x00" in head:
        raise DataError(f"{path}: a binary file, not text", got=repr(head[:16]))
    try:
        # A character may be cut at the end of the sample.
        return head[: len(head) - 4 if len(head) == SAMPLE_BYTES else None].decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return head.decode("cp1252", errors="replace"), "cp1252"


def _try(lines: list[str], separator: str, decimal: str) -> tuple[float, str, str, int]:
    """How well a separator and a decimal mark explain the lines: fields with a value, times their share."""
    kept = [(i, split(line, separator)) for i, line in enumerate(lines) if line.strip()]
    rows = [(i, fields) for i, fields in kept if _numeric(fields, decimal)]
    if not rows:
        return 0.0, separator, decimal, 0
    first = rows[0][0]
    after = [fields for i, fields in kept if i >= first][:SAMPLE_LINES]
    width = len(after[0])
    same = sum(len(fields) == width for fields in after) / len(after)
    values = sum(_is_value(f, decimal) for fields in after for f in fields) / len(after)
    # A comma inside numbers, taken for a separator, leaves fields such as "5;2" that are not values.
    preferred = 0.01 if decimal == "." else 0.0
    return (values**2 / width + preferred if same == 1.0 else 0.0), separator, decimal, first


def _is_value(field: str, decimal: str) -> bool:
    known = bool(_DATE.match(field)) or field.lower() in ("true", "false")
    return field != "" and (known or is_number(field, decimal))


def _numeric(fields: list[str], decimal: str) -> bool:
    """Whether a line is one of values: it has a number, and text at most in a minority of the fields."""
    if fields and fields[0].startswith(("#", "%", "//")):
        return False
    values = [f for f in fields if f not in MISSING]
    good = sum(is_number(f, decimal) or bool(_DATE.match(f)) for f in values)
    return good > 0 and 2 * good > len(values)


def _dialect(
    path: Path, lines: list[str], encoding: str, separator: str, decimal: str, first: int
) -> Dialect:
    rows = [split(line, separator) for line in lines[first : first + SAMPLE_LINES] if line.strip()]
    width = len(rows[0])
    bounds.check_count(str(path), "columns", width, limits.COLUMNS)
    above = [split(line.lstrip("#%/ \t"), separator) for line in lines[:first] if line.strip()]
    above = [
        fields for fields in above if len(fields) == width or (len(fields) == width - 1 and not rows[0][-1])
    ]
    units: dict[str, str] = {}
    names = [str(i) for i in range(width)]
    if above:
        heading, unit_line = above[-1], None
        if len(above) > 1 and all(_UNIT.match(f) for f in above[-1]) and any("[" in f for f in above[-1]):
            heading, unit_line = above[-2], above[-1]
        heading = [*heading, *[""] * (width - len(heading))]
        names = [name[: limits.LOG_NAME] or f"column {i}" for i, name in enumerate(heading)]
        pairs = zip(names, unit_line or [], strict=False)
        units = {name: unit.strip("[]() ") for name, unit in pairs if unit.strip("[]() ")}
    for name in names:
        if names.count(name) > 1:
            raise DataError(
                f"{path}: column {name!r} occurs more than once", hint="rename one of the columns"
            )
    kinds = tuple(_kind([row[i] for row in rows if i < len(row)], decimal) for i in range(width))
    return Dialect(encoding, separator, decimal, first, tuple(names), kinds, units)


def _kind(fields: list[str], decimal: str) -> str:
    values = [f for f in fields if f not in MISSING]
    if all(is_number(f, decimal) for f in values):
        return "number" if values else "empty"
    if all(f.lower() in ("true", "false") for f in values):
        return "bool"
    if all(_DATE.match(f) for f in values):
        return "date"
    return "text"
