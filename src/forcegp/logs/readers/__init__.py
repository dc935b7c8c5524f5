"""Detection of log formats by first bytes, then by file name. Formats that can run code are rejected.

A reader is a function `(path, *, wanted, rows, progress)` that returns a `LogTable`:

- Columns are float64 `(n,)` with the names and units of the log. A value that is missing or not a number is
  NaN, an array `(n, d)` becomes `name[0]` to `name[d-1]`, and names are at most `limits.LOG_NAME` long.
- Columns with a common clock form a `Stream`; those of the main table come first. Time remains a column, as
  no quantity has a meaning before the mapping is applied.
- If the format permits, only columns that `wanted` accepts and the first `rows` rows are read, and `progress`
  is called with the completed and the total work.
- Sizes are checked with `guards` and `table.check_values` before memory is allocated. No code in a file runs.
- Whatever is left out or assumed is a sentence in `remarks`. A damaged file raises `DataError`, to which
  `guards.foreign` converts the exceptions of parsers.

A new format needs an entry in `_READERS`, its first bytes in `_MAGIC` or its file name in `format_of`, and a
writer in `WRITERS` of `tests/log_files.py`. The tests of imports, refusals and commands then cover it.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from forcegp.errors import DataError
from forcegp.guards import foreign
from forcegp.logs.table import LogTable, Progress, Wanted

_READERS = {
    "text": ("CSV or text columns", "text.read_text"),
    "text folder": ("a folder of text columns", "text.read_folder"),
    "parquet": ("Parquet", "parquet.read_parquet"),
    "numpy": ("NumPy .npz or .npy", "arrays.read_numpy"),
    "matlab": ("MATLAB .mat", "arrays.read_matlab"),
    "hdf5": ("HDF5", "arrays.read_hdf5"),
    "rosbag1": ("ROS 1 bag", "bags.read_bag"),
    "rosbag2": ("ROS 2 bag", "bags.read_bag"),
    "mcap": ("MCAP", "bags.read_bag"),
    "lerobot": ("LeRobot data set", "parquet.read_lerobot"),
}
FORMATS = {kind: name for kind, (name, _) in _READERS.items()}
"""Supported formats, and their names in messages."""

_MAGIC = (
    (b"PAR1", "parquet"),
    (b"\x89HDF\r\n\x1a\n", "hdf5"),
    (b"#ROSBAG V2.0", "rosbag1"),
    (b"SQLite format 3\x00", "rosbag2"),
    (b"\x89MCAP0\r\n", "mcap"),
    (b"MATLAB 5.0", "matlab"),
    (b"MATLAB 7.3", "matlab"),
    (b"\x93NUMPY", "numpy"),
)
_TEXT = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc", ".tab", ".prn")
_REFUSED = (".pkl", ".pickle", ".pt", ".pth", ".ckpt", ".joblib", ".dill", ".rdata", ".rds")


def read(
    path: str | Path,
    *,
    wanted: Wanted | None = None,
    rows: int | None = None,
    progress: Progress | None = None,
) -> LogTable:
    """Read a log file or folder of any supported format.

    Only columns for which `wanted` returns true are read, and at most `rows` rows if the format permits.
    `progress` is called with the completed and the total work.

    Raises:
        DataError: the file is missing, damaged or too large, or its format is unsupported or unsafe.
        MissingDependencyError: the reader for the format is not installed.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "run.csv"
    >>> _ = file.write_text("t;q\\n0,0;1,5\\n0,1;1,75\\n")
    >>> read(file).streams[0].columns["q"].tolist()
    [1.5, 1.75]
    """
    place = Path(path)
    with foreign(str(path), "a log"):
        module, _, name = _READERS[format_of(place)][1].partition(".")
    reader: Callable[..., LogTable] = getattr(import_module(f"forcegp.logs.readers.{module}"), name)
    return reader(place, wanted=wanted or (lambda name: True), rows=rows, progress=progress)


def format_of(path: Path) -> str:
    """Return the format of a log as a key of `FORMATS`."""
    if path.is_dir():
        return _format_of_folder(path)
    if not path.is_file():
        hint = None if path.parent.is_dir() else f"{path.parent} is not a folder"
        raise DataError(f"{path}: no such log", hint=hint)
    suffix = path.suffix.lower()
    with path.open("rb") as file:
        head = file.read(32)
    protocol = len(head) > 2 and head[0] == 0x80 and 2 <= head[1] <= 5
    if suffix in _REFUSED or (protocol and suffix not in _TEXT):
        raise _unsafe(path, f"a file ending in {suffix}" if suffix in _REFUSED else "a pickle")
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return "matlab" if kind == "hdf5" and suffix == ".mat" else kind
    if head.startswith(b"PK\x03\x04"):
        return _format_of_zip(path)
    if suffix in _TEXT:
        return "text"
    if suffix == ".mat":
        return "matlab"
    raise _unknown(path, f"{suffix or 'no ending'}, first bytes {head[:8]!r}")


def _format_of_folder(path: Path) -> str:
    if (path / "meta" / "info.json").is_file():
        return "lerobot"
    if (path / "metadata.yaml").is_file():
        return "rosbag2"
    endings = {child.suffix.lower() for child in path.iterdir() if child.is_file()}
    if endings & {".db3", ".mcap"}:
        text = f"{path}: a folder with bag files and no metadata.yaml"
        raise DataError(text, hint="pass the .db3 or .mcap file itself")
    if endings & set(_TEXT):
        return "text folder"
    raise _unknown(path, "a folder with files ending in " + (", ".join(sorted(endings)) or "nothing"))


def _format_of_zip(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as cause:
        raise DataError(f"{path}: the archive is damaged", got=str(cause)) from cause
    if any(name.endswith((".pkl", ".pickle")) for name in names):
        raise _unsafe(path, "an archive with a pickle, such as a PyTorch file")
    if names and all(name.endswith(".npy") for name in names):
        return "numpy"
    raise _unknown(path, "a zip archive")


def _unsafe(path: Path, what: str) -> DataError:
    text, formats = f"{path}: refused, because reading {what} can run code in it", ", ".join(FORMATS.values())
    return DataError(text, expected=formats, hint="save the arrays as Parquet, CSV or .npz")


def _unknown(path: Path, got: str) -> DataError:
    return DataError(f"{path}: unsupported log format", expected=", ".join(FORMATS.values()), got=got)
