"""Readers of CSV and text tables and of folders of such tables.

The separator, decimal mark and headings of a table are inferred from its first lines. In a folder, each file
contains one quantity (for example, `q.txt`).
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from forcegp import guards, limits
from forcegp.errors import DataError
from forcegp.logs import table
from forcegp.logs.table import Column, LogTable, Progress, Stream, Wanted

if TYPE_CHECKING:
    import pyarrow as pa


SAMPLE_BYTES, SAMPLE_LINES = 1 << 18, 200
"""Size of the part of a file that is inspected; number of data lines that must agree in format."""

SEPARATORS = (";", "\t", ",", "|", " ")
"""Candidate separators. A space stands for any run of blanks."""
MISSING = ("", "nan", "NaN", "NAN", "null", "NULL", "NA", "N/A", "None", "-nan", "#N/A")
"""Fields that represent a missing value."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?$|[+-]?(inf|infinity)$", re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?$")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:?\d\d)?$")
_UNIT = re.compile(r"^[\[(]?\s*([A-Za-zµ°%][\w°²^/*·. -]{0,15}|-|1)?\s*[\])]?$")


@dataclass(frozen=True)
class Dialect:
    """Format of a text table from `first_line` on. Columns are of type `number`, `bool`, `date`, `text` or
    `empty`."""

    encoding: str
    separator: str
    decimal: str
    first_line: int
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    units: dict[str, str]


def sniff(path: Path) -> Dialect:
    """Infer the format of a text table from its first lines."""
    with path.open("rb") as file:
        head = file.read(SAMPLE_BYTES)
    text, encoding = _decode(path, head)
    lines = text.splitlines()[: -1 if len(head) == SAMPLE_BYTES else None]
    if not any(line.strip() for line in lines):
        raise DataError(f"{path}: the file is empty" if not head else f"{path}: a line is too long")
    tried = (_try(lines, s, d) for s in SEPARATORS for d in ".," if s != d)
    score, separator, decimal, first = max(tried, key=lambda item: item[0])
    if score <= 0:
        expected = "lines of numbers with one separator, after an optional heading"
        text = f"{path}: no table of numbers was found"
        raise DataError(text, expected=expected, got=repr(lines[0][:120]))
    return _dialect(path, lines, encoding, separator, decimal, first)


def split(line: str, separator: str) -> list[str]:
    """Split a line into fields, removing surrounding blanks and quotation marks.

    >>> split("a;  b ;", ";")
    ['a', 'b', '']
    """
    parts = line.split() if separator == " " else line.split(separator)
    return [part.strip().strip('"').strip() for part in parts]


def kind_of(field: str, decimal: str = ".") -> str:
    """Return the type of a field as in `Dialect`. The type of a missing value is `empty`."""
    if field in MISSING:
        return "empty"
    if (_COMMA_NUMBER if decimal == "," else _NUMBER).match(field):
        return "number"
    if field.lower() in ("true", "false"):
        return "bool"
    return "date" if _DATE.match(field) else "text"


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
    """Return the score of a separator and a decimal mark: the number times the fraction of valid fields."""
    kept = [(i, split(line, separator)) for i, line in enumerate(lines) if line.strip()]
    first = next((i for i, fields in kept if _numeric(fields, decimal)), None)
    if first is None:
        return 0.0, separator, decimal, 0
    after = [fields for i, fields in kept if i >= first][:SAMPLE_LINES]
    width = len(after[0])
    values = sum(f != "" and kind_of(f, decimal) != "text" for fields in after for f in fields) / len(after)
    # A comma inside numbers, taken for a separator, leaves fields such as "5;2" that are not values.
    score = values**2 / width + (0.01 if decimal == "." else 0.0)
    return (score if all(len(fields) == width for fields in after) else 0.0), separator, decimal, first


def _numeric(fields: list[str], decimal: str) -> bool:
    """Return whether more than half of the fields in a line are numbers or dates."""
    if fields and fields[0].startswith(("#", "%", "//")):
        return False
    kinds = [kind for kind in (kind_of(f, decimal) for f in fields) if kind != "empty"]
    return 2 * sum(kind in ("number", "date") for kind in kinds) > len(kinds)


def _dialect(
    path: Path, lines: list[str], encoding: str, separator: str, decimal: str, first: int
) -> Dialect:
    rows = [split(line, separator) for line in lines[first : first + SAMPLE_LINES] if line.strip()]
    width = len(rows[0])
    guards.check_count(str(path), "columns", width, limits.COLUMNS)
    above = [split(line.lstrip("#%/ \t"), separator) for line in lines[:first] if line.strip()]
    widths = (width, width if rows[0][-1] else width - 1)
    above = [fields for fields in above if len(fields) in widths]
    units: dict[str, str] = {}
    names = [str(i) for i in range(width)]
    if above:
        below = all(_UNIT.match(f) for f in above[-1]) and any("[" in f for f in above[-1])
        heading, unit_line = above[-2:] if below and len(above) > 1 else (above[-1], ())
        heading = [*heading, *[""] * (width - len(heading))]
        names = [name[: limits.LOG_NAME] or f"column {i}" for i, name in enumerate(heading)]
        pairs = zip(names, unit_line, strict=False)
        units = {name: unit.strip("[]() ") for name, unit in pairs if unit.strip("[]() ")}
    if twice := next((name for name in names if names.count(name) > 1), None):
        text = f"{path}: column {twice!r} occurs more than once"
        raise DataError(text, hint="rename one of the columns")
    columns = ({kind_of(row[i], decimal) for row in rows if i < len(row)} - {"empty"} for i in range(width))
    kinds = tuple("text" if len(kinds) > 1 else next(iter(kinds), "empty") for kinds in columns)
    return Dialect(encoding, separator, decimal, first, tuple(names), kinds, units)


BLOCK_BYTES = 4 << 20
"""Size of the blocks in which text is parsed."""

_BLANKS = re.compile(rb"[ \t]+")
_EDGES = re.compile(rb"(?m)^ | (?=\r?$)")


def read_text(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read a text table, skipping text columns with a note."""
    dialect = sniff(path)
    kinds = {n: kind for n, kind in zip(dialect.names, dialect.kinds, strict=True) if wanted(n)}
    remarks = [f"column {n!r} contains text and was ignored" for n, kind in kinds.items() if kind == "text"]
    kinds = {name: kind for name, kind in kinds.items() if kind not in ("text", "empty")}
    chunks: dict[str, list[Column]] = {name: [] for name in kinds}
    done = 0
    with guards.foreign(str(path), "a table of text"), path.open("rb") as file:
        source = _Blocks(file, dialect, path.stat().st_size, progress)
        for batch in _batches(source, dialect, kinds) if kinds else ():
            done += len(batch)
            table.check_values(str(path), done, len(kinds))
            for name, kind in kinds.items():
                chunks[name].append(_numbers(batch.column(name), kind))
            if rows is not None and done >= rows:
                break
        values = table.joined(chunks, rows)
    if dialect.encoding == "cp1252":
        remarks.append("the file is not UTF-8 and was read as Windows-1252")
    units = {name: unit for name, unit in dialect.units.items() if name in values}
    return LogTable(str(path), "text", (Stream("", values, units),), tuple(remarks))


def _batches(source: _Blocks, dialect: Dialect, kinds: dict[str, str]) -> Iterator[pa.RecordBatch]:
    """Yield batches of rows with the selected columns."""
    import pyarrow as pa
    from pyarrow import csv

    types = {"number": pa.float64(), "bool": pa.bool_(), "date": pa.timestamp("ns")}
    yield from csv.open_csv(
        pa.PythonFile(source, mode="r"),
        read_options=csv.ReadOptions(
            use_threads=True,
            block_size=BLOCK_BYTES,
            skip_rows=dialect.first_line,
            column_names=list(dialect.names),
            encoding="utf-8" if dialect.encoding == "utf-8-sig" else dialect.encoding,
        ),
        parse_options=csv.ParseOptions(delimiter=dialect.separator, ignore_empty_lines=True),
        convert_options=csv.ConvertOptions(
            include_columns=list(kinds),
            column_types={n: types[kind] for n, kind in kinds.items()},
            decimal_point=dialect.decimal,
            null_values=list(MISSING),
        ),
    )


def _numbers(values: pa.Array, kind: str) -> Column:
    """Convert a column to float64. Dates become seconds since 2020, and flags become 1 and 0."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if kind == "date":
        # Seconds since 2020 keep the nanoseconds that seconds since 1970 lose in float64.
        whole = pc.cast(values, pa.int64()).to_numpy(zero_copy_only=False)
        return (whole - DATE_ORIGIN_NS).astype(np.float64) * 1e-9
    return pc.cast(values, pa.float64()).to_numpy(zero_copy_only=False)


DATE_ORIGIN_NS = 1_577_836_800_000_000_000
"""Origin of times given as dates: 2020-01-01 in nanoseconds since the epoch."""


class _Blocks(io.RawIOBase):
    """A binary file that counts the bytes read by the parser and collapses runs of blanks."""

    def __init__(self, file: IO[bytes], dialect: Dialect, size: int, progress: Progress | None) -> None:
        self._file, self._size, self._progress = file, size, progress
        self._collapse = dialect.separator == " "
        self._rest, self._done = b"", 0

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1, /) -> bytes:
        block = self._file.read(size if size > 0 else BLOCK_BYTES)
        self._done += len(block)
        if self._progress is not None:
            self._progress(self._done, self._size)
        if not self._collapse:
            return block
        text = self._rest + block
        # Blanks at the edges of a line are only known once the line is complete.
        end = text.rfind(b"\n") + 1 if block else len(text)
        self._rest, text = text[end:], text[:end]
        guards.check_count("the text", "bytes in a line", len(self._rest), limits.LINE_BYTES + BLOCK_BYTES)
        result = _EDGES.sub(b"", _BLANKS.sub(b" ", text))
        return result if result or not block else self.read(size)


ENDINGS = (".txt", ".csv", ".tsv", ".dat", ".asc")
"""Suffixes of the files to read. Other files in the folder are ignored."""


def read_folder(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the tables in a folder as `file[i]` or `file.heading`. Equally long tables form one stream."""

    def in_file(file: Path, column: str) -> str:
        return f"{file.stem}[{column}]" if column.isdigit() else f"{file.stem}.{column}"

    found = (p for p in path.iterdir() if p.suffix.lower() in ENDINGS and p.is_file())
    files = guards.within(path, sorted(found))
    guards.check_count(str(path), "files", len(files), limits.LOG_FILES)
    groups: dict[int, dict[str, Column]] = {}
    remarks: list[str] = []
    for number, file in enumerate(files):
        try:
            part = read_text(file, wanted=lambda n, f=file: wanted(in_file(f, n)), rows=rows, progress=None)
        except DataError as error:
            if "no table of numbers" not in error.message:
                raise
            remarks.append(f"{file.name} contains no table of numbers and was ignored")
            continue
        remarks += [f"{file.name}: {remark}" for remark in part.remarks]
        columns = {in_file(file, name): values for name, values in part.streams[0].columns.items()}
        if columns:
            groups.setdefault(len(next(iter(columns.values()))), {}).update(columns)
            table.check_values(str(path), 1, sum(map(len, groups.values())))
        if progress is not None:
            progress(number + 1, len(files))
    most = max(groups, key=lambda length: (len(groups[length]), length), default=0)
    return LogTable(str(path), "text folder", table.streams_by_length(groups, most), tuple(remarks))
