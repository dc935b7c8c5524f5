"""HDF5 files, and MATLAB files of version 7.3; links out of the file are not followed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs import bounds
from forcegp.logs.table import LogTable, Progress, Wanted, arrays_to_streams, foreign
from forcegp.optional import optional_module

Arrays = dict[str, NDArray[np.generic]]


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the numeric data sets of an HDF5 file; one in a group is `group/name`.

    Raises:
        DataError: the file is damaged or too large.
        MissingDependencyError: `h5py` is not installed.
    """
    del wanted, rows, progress
    return _read(path, "hdf5", "/")


def read_matlab(path: Path) -> LogTable:
    """Read a MATLAB file of version 7.3: names as in MATLAB, and axes in its order."""
    return _read(path, "matlab", ".")


def _read(path: Path, format_: str, separator: str) -> LogTable:
    h5py = optional_module("h5py", "Reading HDF5 files", "import")
    remarks: list[str] = []
    arrays: Arrays = {}
    with foreign(str(path), "HDF5"), h5py.File(path, "r") as file:
        seen: set[Any] = {h5py.h5o.get_info(file.id).addr}
        _walk(h5py, file, "", separator, arrays, remarks, seen)
    if format_ == "matlab":
        arrays = {name: array.T for name, array in arrays.items()}
    return LogTable(str(path), format_, arrays_to_streams(str(path), arrays, remarks), tuple(remarks))


def _walk(
    h5py: Any, group: Any, prefix: str, separator: str, arrays: Arrays, remarks: list[str], seen: set[Any]
) -> None:
    """Collect the data sets below a group, each once, though links may lead to it several times."""
    if prefix.count(separator) > limits.GROUP_DEPTH:
        raise DataError(f"{group.file.filename}: groups are nested too deeply", got=prefix[:200])
    for key in group:
        name = f"{prefix}{key}"
        if key.startswith("#"):  # MATLAB's own bookkeeping
            continue
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            remarks.append(f"{name!r} is a link and was not followed")
            continue
        item = group[key]
        mark = h5py.h5o.get_info(item.id).addr
        if mark in seen:
            continue
        seen.add(mark)
        bounds.check_count(group.file.filename, "objects", len(seen), limits.COLUMNS)
        if isinstance(item, h5py.Group):
            _walk(h5py, item, f"{name}{separator}", separator, arrays, remarks, seen)
        elif isinstance(item, h5py.Dataset):
            _take(item, name, arrays, remarks)


def _take(item: Any, name: str, arrays: Arrays, remarks: list[str]) -> None:
    text = item.attrs.get("MATLAB_class", b"") in (b"char", b"cell", b"struct", b"function_handle")
    if item.dtype.kind not in "fiub" or item.ndim not in (1, 2) or text:
        remarks.append(f"{name!r} of shape {item.shape} and type {item.dtype} was left out")
    elif item.external or item.is_virtual:
        remarks.append(f"{name!r} lies outside the file and was left out")
    else:
        source, taken = item.file.filename, sum(array.size for array in arrays.values()) + item.size
        bounds.check_count(source, "numbers", taken, limits.LOG_VALUES)
        bounds.check_expansion(source, 8 * taken, Path(source).stat().st_size)
        arrays[name] = item[()]
