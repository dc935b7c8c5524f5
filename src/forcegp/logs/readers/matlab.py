"""MATLAB files: versions 5 to 7, version 7.3 as the HDF5 file that it is, and version 4 by SciPy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.logs import bounds
from forcegp.logs.readers import hdf5
from forcegp.logs.readers.matlab5 import Variable, variables
from forcegp.logs.table import LogTable, Progress, Wanted, arrays_to_streams, foreign

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""Version 7.3 puts it after a header of 512 bytes."""


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the numeric arrays of a MATLAB file; fields of a struct are `struct.field`.

    Cells, objects, sparse matrices and function handles are left out with a remark.

    Raises:
        DataError: the file is damaged or too large.
        MissingDependencyError: a file of version 7.3, and `h5py` is not installed.
    """
    with path.open("rb") as file:
        head = file.read(520)
    if head.startswith(HDF5_MAGIC) or head[512:520] == HDF5_MAGIC:
        return hdf5.read_matlab(path)
    remarks: list[str] = []
    arrays: dict[str, NDArray[np.generic]] = {}
    with foreign(str(path), "a MATLAB file"):
        for variable in _version4(path) if 0 in head[:4] else variables(path.read_bytes(), str(path)):
            _collect(variable, arrays, remarks)
    bounds.check_count(str(path), "arrays", len(arrays), limits.COLUMNS)
    return LogTable(str(path), "matlab", arrays_to_streams(str(path), arrays, remarks), tuple(remarks))


def _version4(path: Path) -> Iterator[Variable]:
    """The variables of a file of version 4, which has no structs."""
    from scipy.io import loadmat, whosmat

    listing = whosmat(path)
    bounds.check_count(str(path), "arrays", len(listing), limits.COLUMNS)
    claimed = sum(math.prod(shape) for _, shape, _ in listing)
    bounds.check_count(str(path), "numbers", claimed, min(limits.LOG_VALUES, path.stat().st_size))
    for name, value in loadmat(path).items():
        if not name.startswith("__"):
            yield Variable(name, value if isinstance(value, np.ndarray) else "is sparse")


def _collect(variable: Variable, arrays: dict[str, NDArray[np.generic]], remarks: list[str]) -> None:
    """Numeric arrays of a variable, going into structs."""
    name, value = variable
    if isinstance(value, tuple):
        for field in value:
            _collect(Variable(f"{name}.{field.name}", field.value), arrays, remarks)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        arrays[name] = value
    else:
        reason = value if isinstance(value, str) else "holds no numbers"
        remarks.append(f"{name!r} {reason} and was left out")
