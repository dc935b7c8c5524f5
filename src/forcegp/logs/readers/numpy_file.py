"""NumPy archives and arrays, without pickled objects."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs import bounds
from forcegp.logs.table import LogTable, Progress, Wanted, arrays_to_streams, foreign

MAX_ARRAYS = 4096
"""Arrays of one archive."""


def read(path: Path, *, wanted: Wanted, rows: int | None, progress: Progress | None) -> LogTable:
    """Read the numeric arrays of an `.npz` archive, or the array of an `.npy` file.

    Raises:
        DataError: an array holds Python objects, the file is damaged, or it is too large.
    """
    del wanted, rows, progress
    arrays: dict[str, NDArray[np.generic]] = {}
    remarks: list[str] = []
    with foreign(str(path), "a NumPy file"):
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                members = archive.infolist()
                bounds.check_count(str(path), "arrays", len(members), MAX_ARRAYS)
                size = sum(member.file_size for member in members)
                bounds.check_count(str(path), "bytes", size, 8 * limits.LOG_VALUES)
                bounds.check_expansion(str(path), size, path.stat().st_size)
                for member in members:
                    with archive.open(member) as file:
                        name = member.filename.removesuffix(".npy")
                        arrays |= _array(f"{path}: {name}", name, file, member.file_size)
        else:
            with path.open("rb") as file:
                arrays = _array(str(path), "", file, path.stat().st_size)
    streams = arrays_to_streams(str(path), arrays, remarks)
    return LogTable(str(path), "numpy", streams, tuple(remarks))


def _array(source: str, name: str, file: Any, size: int) -> dict[str, NDArray[np.generic]]:
    """An array by name, the fields of a structured one each; what its header claims is checked first."""
    version = np.lib.format.read_magic(file)  # pyright: ignore[reportArgumentType]
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read_header is None:
        raise DataError(f"{source}: version {version} of the NumPy format is not read")
    shape, fortran, dtype = read_header(file)  # pyright: ignore[reportArgumentType]
    if dtype.hasobject:
        raise DataError(
            f"{source}: refused, because an array of Python objects is a pickle, which can run code",
            expected="an array of numbers",
            hint="save each quantity as an array of its own",
        )
    count = int(np.prod(shape, dtype=object)) if shape else 1
    bounds.check_count(source, "numbers", count, limits.LOG_VALUES)
    if count * dtype.itemsize > size:
        raise DataError(f"{source}: the array claims to be larger than its file", got=f"{shape} of {dtype}")
    data = file.read(count * dtype.itemsize)
    array = np.frombuffer(data, dtype=dtype, count=count).reshape(shape, order="F" if fortran else "C")
    if dtype.names:
        return {f"{name}.{field}".lstrip("."): array[field] for field in dtype.names}
    return {name: array}
