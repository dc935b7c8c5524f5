"""MATLAB files: version 5 by SciPy, version 7.3 as the HDF5 file that it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs import bounds
from forcegp.logs.readers import hdf5
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
    from scipy.io import loadmat, whosmat

    remarks: list[str] = []
    arrays: dict[str, NDArray[np.generic]] = {}
    with foreign(str(path), "a MATLAB file"):
        listing = whosmat(path)
        bounds.check_count(str(path), "arrays", len(listing), limits.COLUMNS)
        claimed = sum(int(np.prod(shape, dtype=object)) for _, shape, _ in listing)
        bounds.check_count(str(path), "numbers", claimed, limits.LOG_VALUES)
        plain = [
            name
            for name, _, kind in listing
            if kind not in ("function", "opaque", "object", "sparse", "cell")
        ]
        remarks += [f"{n!r} is of class {k} and was left out" for n, _, k in listing if n not in plain]
        for name, value in loadmat(path, variable_names=plain, struct_as_record=True).items():
            if not name.startswith("__"):
                _collect(name, value, arrays, remarks, 0)
    return LogTable(str(path), "matlab", arrays_to_streams(str(path), arrays, remarks), tuple(remarks))


def _collect(
    name: str, value: object, arrays: dict[str, NDArray[np.generic]], remarks: list[str], depth: int
) -> None:
    """Numeric arrays of a variable, going into structs of one element."""
    if depth > limits.GROUP_DEPTH:
        raise DataError(
            f"{name[:80]}: structs are nested too deeply", expected=f"at most {limits.GROUP_DEPTH}"
        )
    if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
        for field in value.dtype.names:
            _collect(f"{name}.{field}", value.reshape(-1)[0][field], arrays, remarks, depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        arrays[name] = value
    else:
        remarks.append(f"{name!r} holds no numbers and was left out")
