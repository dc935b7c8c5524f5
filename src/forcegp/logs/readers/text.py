"""Readers of CSV and text tables and of folders of such tables.

The separator, decimal mark and headings of a table are inferred from its first lines. In a folder, each file
contains one quantity (for example, `q.txt`).
"""

from __future__ import annotations

import csv
import importlib
import io
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

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
_DAY = (
    r"(?:(?P<year>\d{4})[-/.](?P<month>\d\d?)[-/.](?P<day>\d\d?)"
    r"|(?P<first>\d\d?)(?P<mark>[-/.])(?P<second>\d\d?)[-/.](?P<end>\d{4}|\d\d))"
)
_OF_DAY = (
    r"(?P<hours>\d\d?):(?P<minutes>\d\d)(?::(?P<seconds>\d\d)(?:[.,](?P<fraction>\d{1,9})\d*)?)?"
    r"(?: ?(?P<half>[AaPp])\.?[Mm]\.?)?(?:Z|(?P<sign>[+-])(?P<zone_hours>\d\d):?(?P<zone_minutes>\d\d))?"
)
DATE = re.compile(rf"^(?:{_DAY}(?:[T ,]+{_OF_DAY})?)$")
TIME_OF_DAY = re.compile(f"^(?:{_OF_DAY})$")
"""Dates in the order of ISO 8601 or of a country, with or without a time of day; and times without a date."""
_MONTHS = ("jan|ene|gen", "f[eé][bv]", "mar|m[äa]e?r|mrz", "apr|avr|abr", "ma[iy]|mag", "jun|juin|giu")
_MONTHS = (*_MONTHS, "jul|juil|lug", "aug|ao[uû]|ago", "se[pt]", "o[ckt]t", "nov", "d[eéi][czk]")
"""First letters of the months in English, German, French, Spanish and Italian."""
_NAMED_DAY = (
    r"^([0-9]{{1,2}})[-/. ]+(?:de )?(?i:{})[^0-9 ./,-]*[-/., ]+(?:de )?([0-9]{{4}}|[0-9]{{2}})\b",
    r"^(?i:{})[^0-9 ./,-]*[-/. ]+([0-9]{{1,2}})[-/., ]+([0-9]{{4}}|[0-9]{{2}})\b",
)
"""A day before or after the name of its month, then the year; of one month each, they become 28.11.2026."""
_NAMED_MONTHS = [(p.format(f"(?:{m})"), rf"\1.{k}.\2") for p in _NAMED_DAY for k, m in enumerate(_MONTHS, 1)]
_ANY_NAMED = re.compile("|".join(p.format(f"(?:{'|'.join(_MONTHS)})") for p in _NAMED_DAY))
SUPPORTED = (
    "2025-11-27 14:03:22.008, 27.11.2025 14:03:22,008, 11/27/2025 2:03:22 PM, 27-Nov-2025 14:03:22, "
    "or 14:03:22.008"
)
"""Examples of the supported dates."""
_UNIT = re.compile(r"^[\[(]?\s*([A-Za-zµ°%][\w°²^/*·. -]{0,15}|-|1)?\s*[\])]?$")


@dataclass(frozen=True)
class Dialect:
    """Format of a text table from `first_line` on. Columns are of type `number`, `bool`, `date`, `time of
    day`, `text` or `empty`. If `padded`, blanks surround quoted fields. `unread` holds the first field of
    columns of text that contain a time of day."""

    encoding: str
    quote: str
    padded: bool
    separator: str
    decimal: str
    first_line: int
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    units: dict[str, str]
    unread: dict[str, str]


def sniff(path: Path) -> Dialect:
    """Infer the format of a text table from its first lines."""
    with path.open("rb") as file:
        head = file.read(SAMPLE_BYTES)
    text, encoding = _decode(path, head)
    lines = text.splitlines()[: -1 if len(head) == SAMPLE_BYTES else None]
    if not any(line.strip() for line in lines):
        raise DataError(f"{path}: the file is empty" if not head else f"{path}: a line is too long")
    quote = "'" if '"' not in text and any(line.startswith("'") for line in lines) else '"'
    # Within quotation marks, a comma is a decimal mark even if it also separates the fields.
    marks = ((s, d) for s in SEPARATORS for d in ".," if s != d or quote in text)
    tried = (_try(lines, s, d, quote) for s, d in marks)
    score, separator, decimal, first = max(tried, key=lambda item: item[0])
    if score <= 0:
        expected = "lines of numbers with one separator, after an optional heading"
        text = f"{path}: no table of numbers was found"
        raise DataError(text, expected=expected, got=repr(lines[0][:120]))
    return _dialect(path, lines, encoding, quote, separator, decimal, first)


def split(line: str, separator: str, quote: str = '"') -> list[str]:
    """Split a line into fields, removing surrounding blanks and quotation marks.

    >>> split('a;  b ;"c;d";', ";")
    ['a', 'b', 'c;d', '']
    """
    parts = line.split() if separator == " " else line.split(separator)
    if quote in line:
        quoted = " ".join(line.split()) if separator == " " else line
        with suppress(csv.Error):  # a field may be too long
            parts = next(csv.reader([quoted], delimiter=separator, quotechar=quote, skipinitialspace=True))
    return [part.strip().strip(quote).strip() for part in parts]


def kind_of(field: str, decimal: str = ".") -> str:
    """Return the type of a field as in `Dialect`. The type of a missing value is `empty`."""
    if field in MISSING:
        return "empty"
    if (_COMMA_NUMBER if decimal == "," else _NUMBER).match(field):
        return "number"
    if field.lower() in ("true", "false"):
        return "bool"
    if _ANY_NAMED.match(field):
        field = _with_numbers(field)
    return "date" if DATE.match(field) else "time of day" if TIME_OF_DAY.match(field) else "text"


def _with_numbers(field: str) -> str:
    """Replace the name of a month by its number.

    >>> _with_numbers("28-Nov-2026 01:02:03"), _with_numbers("août 5, 2026")
    ('28.11.2026 01:02:03', '5.8.2026')
    """
    for form, numbered in _NAMED_MONTHS:
        field = re.sub(form, numbered, field)
    return field


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


def _try(lines: list[str], separator: str, decimal: str, quote: str) -> tuple[float, str, str, int]:
    """Return the score of a separator and a decimal mark: the number times the fraction of valid fields."""
    kept = [(i, split(line, separator, quote)) for i, line in enumerate(lines) if line.strip()]
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
    return 2 * sum(kind in ("number", "date", "time of day") for kind in kinds) > len(kinds)


def _dialect(
    path: Path, lines: list[str], encoding: str, quote: str, separator: str, decimal: str, first: int
) -> Dialect:
    rows = [split(line, separator, quote) for line in lines[first : first + SAMPLE_LINES] if line.strip()]
    width = len(rows[0])
    guards.check_count(str(path), "columns", width, limits.COLUMNS)
    above = [split(line.lstrip("#%/ \t"), separator, quote) for line in lines[:first] if line.strip()]
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
    first_text = ((n, f) for n, f, kind in zip(names, rows[0], kinds, strict=False) if kind == "text")
    unread = {name: field for name, field in first_text if re.search(r"\d:\d\d", field)}
    padded = any(f"{separator} {quote}" in line for line in lines[first : first + SAMPLE_LINES])
    return Dialect(encoding, quote, padded, separator, decimal, first, tuple(names), kinds, units, unread)


BLOCK_BYTES = 4 << 20
"""Size of the blocks in which text is parsed."""
DATE_ORIGIN = 1_577_836_800
"""Origin of times given as dates: 2020-01-01 in seconds since the epoch."""

_BLANKS = re.compile(rb"[ \t]+")
_EDGES = re.compile(rb"(?m)^ | (?=\r?$)")


def read_text(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read a text table, skipping text columns with a note."""
    dialect = sniff(path)
    kinds = {n: kind for n, kind in zip(dialect.names, dialect.kinds, strict=True) if wanted(n)}
    text = {name: dialect.unread.get(name) for name, kind in kinds.items() if kind == "text"}
    known = f"is not one of the supported dates ({SUPPORTED})"
    remarks = [
        f"column {name!r} contains text and was ignored"
        if date is None
        else f"column {name!r} was ignored: {date[:40]!r} {known}"
        for name, date in text.items()
    ]
    kinds = {name: kind for name, kind in kinds.items() if kind != "text"}
    chunks: dict[str, list[pa.Array]] = {name: [] for name in kinds}
    done = 0
    with guards.foreign(str(path), "a table of text"), path.open("rb") as file:
        source = _Blocks(file, dialect, path.stat().st_size, progress)
        for batch in _batches(source, dialect, kinds) if kinds else ():
            done += len(batch)
            table.check_values(str(path), done, len(kinds))
            for name in kinds:
                chunks[name].append(batch.column(name))
            if rows is not None and done >= rows:
                break
        values = {name: _numbers(chunks.pop(name), kind, dialect)[:rows] for name, kind in kinds.items()}
    if dialect.encoding == "cp1252":
        remarks.append("the file is not UTF-8 and was read as Windows-1252")
    empty = [name for name, kind in kinds.items() if kind == "empty" and np.isnan(values[name]).all()]
    for name in empty:
        del values[name]
        remarks.append(f"column {name!r} contains no numbers and was ignored")
    units = {name: unit for name, unit in dialect.units.items() if name in values}
    return LogTable(str(path), "text", (Stream("", values, units),), tuple(remarks))


def _batches(source: _Blocks, dialect: Dialect, kinds: dict[str, str]) -> Iterator[pa.RecordBatch]:
    """Yield batches of rows with the selected columns."""
    import pyarrow as pa
    from pyarrow import csv

    types = {"number": pa.float64(), "bool": pa.bool_()}
    yield from csv.open_csv(
        pa.PythonFile(source, mode="r"),
        read_options=csv.ReadOptions(
            use_threads=True,
            block_size=BLOCK_BYTES,
            skip_rows=dialect.first_line,
            column_names=list(dialect.names),
            encoding="utf-8" if dialect.encoding == "utf-8-sig" else dialect.encoding,
        ),
        parse_options=csv.ParseOptions(
            delimiter=dialect.separator, quote_char=dialect.quote, ignore_empty_lines=True
        ),
        convert_options=csv.ConvertOptions(
            include_columns=list(kinds),
            column_types={n: types.get(kind, pa.string()) for n, kind in kinds.items()},
            decimal_point=dialect.decimal,
            null_values=list(MISSING),
            strings_can_be_null=True,
        ),
    )


def _numbers(chunks: list[pa.Array], kind: str, dialect: Dialect) -> Column:
    """Convert a column to float64. Dates become seconds since 2020, and flags become 1 and 0.

    A column that is empty at the start of the file has numbers, or NaN where it has text.
    """
    import pyarrow as pa

    pc: Any = importlib.import_module("pyarrow.compute")

    values = pa.chunked_array(chunks, None if chunks else pa.float64())
    if kind in ("date", "time of day"):
        return _seconds(values, DATE if kind == "date" else TIME_OF_DAY, "date" not in dialect.kinds)
    if kind == "empty":
        decimal = dialect.decimal if dialect.separator == "," else ","
        text = pc.replace_substring(pc.utf8_trim_whitespace(values), decimal, ".")
        usable = pc.match_substring_regex(text, f"^(?i:{_NUMBER.pattern})")
        values = pc.if_else(usable, text, None)
    # A copy, since the array of a chunk cannot be written to.
    return np.array(pc.cast(values, pa.float64()).to_numpy(), dtype=np.float64)


def _seconds(values: pa.ChunkedArray, form: re.Pattern[str], alone: bool) -> Column:
    """Convert dates to seconds since 2020, or times of day to seconds since the first midnight.

    `alone` states that no column has the date of a time of day, so that it increases past midnight.
    """
    import pyarrow as pa

    pc: Any = importlib.import_module("pyarrow.compute")

    values = pc.utf8_trim_whitespace(values)
    if form is DATE and pc.any(pc.match_substring_regex(values, _ANY_NAMED.pattern)).as_py():
        for named, numbered in _NAMED_MONTHS:
            values = pc.replace_substring_regex(values, named, numbered)
    parts = pc.extract_regex(values, form.pattern).combine_chunks()
    missing = pc.is_null(parts).to_numpy(zero_copy_only=False)
    if (~missing).sum() < len(values) - values.null_count:
        row = int(np.flatnonzero(missing & values.is_valid().to_numpy())[0])
        raise DataError(f"invalid date or time in row {row}", expected=SUPPORTED, got=values[row].as_py())

    def text(name: str) -> pa.Array:
        return pc.fill_null(pc.struct_field(parts, name), "")

    def number(name: str) -> NDArray[np.int64]:
        digits = text(name)
        if name == "fraction":
            digits = pc.utf8_rpad(digits, 9, "0")
        return pc.cast(pc.if_else(pc.equal(digits, ""), "0", digits), pa.int64()).to_numpy()

    def is_(name: str, *marks: str) -> NDArray[np.bool_]:
        return pc.is_in(text(name), pa.array(marks)).to_numpy(zero_copy_only=False)

    hours = number("hours")
    hours = np.where(is_("half", "a", "A", "p", "P"), hours % 12 + 12 * is_("half", "p", "P"), hours)
    zone = np.where(is_("sign", "-"), -1, 1) * (60 * number("zone_hours") + number("zone_minutes"))
    whole = 3600 * hours + 60 * (number("minutes") - zone) + number("seconds")
    if form is DATE:
        whole += 86_400 * _days(number, is_("mark", "."), is_("year", "")) - DATE_ORIGIN
    elif alone:
        whole[1:] += 86_400 * np.cumsum(np.diff(whole) < -43_200)
    # Seconds since 2020 keep the nanoseconds that seconds since 1970 lose in float64.
    return np.where(missing, np.nan, whole + 1e-9 * number("fraction"))


def _days(
    number: Callable[[str], NDArray[np.int64]], dotted: NDArray[np.bool_], country: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return days since 1970. Without a point between them, the order of day and month is that of the shorter
    log, since one log does not last for months."""

    def since_1970(year: NDArray[np.int64], month: NDArray[np.int64], day: NDArray[np.int64]) -> Any:
        months = (np.maximum(year, 1) - 1970) * 12 + np.clip(month, 1, 12) - 1
        return months.astype("M8[M]").astype("M8[D]").astype(np.int64) + day - 1

    iso = since_1970(number("year"), number("month"), number("day"))
    end, first, second = number("end"), number("first"), number("second")
    end = np.where(end < 100, end + 2000, end)
    by_day, by_month = since_1970(end, second, first), since_1970(end, first, second)
    rows = country & (first > 0)
    if not rows.any():
        return iso
    american = not dotted.any() and (
        second[rows].max() > 12 or (first[rows].max() <= 12 and np.ptp(by_month[rows]) < np.ptp(by_day[rows]))
    )
    return np.where(country, by_month if american else by_day, iso)


class _Blocks(io.RawIOBase):
    """A binary file that counts the bytes read by the parser, and removes blanks that it does not accept:
    repeated ones as separators, and those between a separator and a quotation mark.
    """

    def __init__(self, file: IO[bytes], dialect: Dialect, size: int, progress: Progress | None) -> None:
        self._file, self._size, self._progress = file, size, progress
        separator, quote = (re.escape(mark.encode()) for mark in (dialect.separator, dialect.quote))
        beside = rb"(?m)(?:(?<=%b)|^) +(?=%b)|(?<=%b) +(?=%b)" % (separator, quote, quote, separator)
        self._removed: list[tuple[re.Pattern[bytes], bytes]] = [(re.compile(beside), b"")] * dialect.padded
        if dialect.separator == " ":
            self._removed = [(_BLANKS, b" "), (_EDGES, b"")]
        self._rest, self._done = b"", 0

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1, /) -> bytes:
        block = self._file.read(size if size > 0 else BLOCK_BYTES)
        self._done += len(block)
        if self._progress is not None:
            self._progress(self._done, self._size)
        if not self._removed:
            return block
        text = self._rest + block
        # Blanks beside a mark or the edge of a line are only known once the line is complete.
        end = text.rfind(b"\n") + 1 if block else len(text)
        self._rest, text = text[end:], text[:end]
        guards.check_count("the text", "bytes in a line", len(self._rest), limits.LINE_BYTES + BLOCK_BYTES)
        for pattern, replacement in self._removed:
            text = pattern.sub(replacement, text)
        return text if text or not block else self.read(size)


ENDINGS = (".txt", ".csv", ".tsv", ".dat", ".asc")
"""Suffixes of the files to read. Other files in the folder are ignored."""


def read_folder(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the tables in a folder as `file[i]` or `file.heading`. Equally long tables form one stream."""

    def in_file(file: Path, column: str) -> str:
        return f"{file.stem}[{column}]" if column.isdigit() else f"{file.stem}.{column}"

    tables = (p for p in path.iterdir() if p.suffix.lower() in ENDINGS and p.is_file())
    files = guards.within(path, sorted(tables))
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
