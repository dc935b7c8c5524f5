"""Files of named arrays: NumPy archives without pickled objects, HDF5 and MATLAB.

MATLAB files of versions 5 to 7 are read by `matlab5`, version 7.3 as the HDF5 file that it is, and version 4
by SciPy. Links out of an HDF5 file are not followed.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forcegp import guards, limits
from forcegp.errors import DataError, optional_module
from forcegp.logs import table
from forcegp.logs.readers.matlab5 import Variable, variables
from forcegp.logs.table import LogTable

Arrays = dict[str, NDArray[np.generic]]
MAX_ARRAYS = 4096
"""Arrays of one archive."""


def read_numpy(path: Path, **_: object) -> LogTable:
    """Read the numeric arrays of an `.npz` archive, or the array of an `.npy` file."""
    arrays: Arrays = {}
    with guards.foreign(str(path), "a NumPy file"):
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                members = archive.infolist()
                guards.check_count(str(path), "arrays", len(members), MAX_ARRAYS)
                size = sum(member.file_size for member in members)
                guards.check_count(str(path), "bytes", size, 8 * limits.LOG_VALUES)
                guards.check_expansion(str(path), size, path.stat().st_size)
                for member in members:
                    with archive.open(member) as file:
                        name = member.filename.removesuffix(".npy")
                        arrays |= _array(f"{path}: {name}", name, file, member.file_size)
        else:
            with path.open("rb") as file:
                arrays = _array(str(path), "", file, path.stat().st_size)
    return table.table_of_arrays(path, "numpy", arrays)


def _array(source: str, name: str, file: Any, size: int) -> Arrays:
    """An array by name, the fields of a structured one each; what its header claims is checked first."""
    form = np.lib.format
    version = form.read_magic(file)  # pyright: ignore[reportArgumentType]
    read_header = {(1, 0): form.read_array_header_1_0, (2, 0): form.read_array_header_2_0}.get(version)
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
    guards.check_count(source, "numbers", count, limits.LOG_VALUES)
    if count * dtype.itemsize > size:
        raise DataError(f"{source}: the array claims to be larger than its file", got=f"{shape} of {dtype}")
    data = file.read(count * dtype.itemsize)
    array = np.frombuffer(data, dtype=dtype, count=count).reshape(shape, order="F" if fortran else "C")
    if dtype.names:
        return {f"{name}.{field}".lstrip("."): array[field] for field in dtype.names}
    return {name: array}


def read_hdf5(path: Path, **_: object) -> LogTable:
    """Read the numeric data sets of an HDF5 file; one in a group is `group/name`."""
    remarks: list[str] = []
    return table.table_of_arrays(path, "hdf5", _hdf5_arrays(path, "/", remarks), remarks)


def _hdf5_arrays(path: Path, separator: str, remarks: list[str]) -> Arrays:
    h5py = optional_module("h5py", "Reading HDF5 files", "import")
    arrays: Arrays = {}
    with guards.foreign(str(path), "HDF5"), h5py.File(path, "r") as file:
        _walk(h5py, file, "", separator, arrays, remarks, {h5py.h5o.get_info(file.id).addr})
    return arrays


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
        guards.check_count(group.file.filename, "objects", len(seen), limits.COLUMNS)
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
        guards.check_count(source, "numbers", taken, limits.LOG_VALUES)
        guards.check_expansion(source, 8 * taken, size := Path(source).stat().st_size)
        guards.check_chunks(item, size)
        arrays[name] = item[()]


HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""Version 7.3 puts it after a header of 512 bytes."""


def read_matlab(path: Path, **_: object) -> LogTable:
    """Read the numeric arrays of a MATLAB file; fields of a struct are `struct.field`.

    Cells, objects, sparse matrices and function handles are left out with a remark.
    """
    with path.open("rb") as file:
        head = file.read(520)
    remarks: list[str] = []
    arrays: Arrays = {}
    if HDF5_MAGIC in (head[:8], head[512:520]):  # version 7.3: names as in MATLAB, and axes in its order
        arrays = {name: array.T for name, array in _hdf5_arrays(path, ".", remarks).items()}
    else:
        with guards.foreign(str(path), "a MATLAB file"):
            for variable in _version4(path) if 0 in head[:4] else variables(path.read_bytes(), str(path)):
                _collect(variable, arrays, remarks)
    guards.check_count(str(path), "arrays", len(arrays), limits.COLUMNS)
    return table.table_of_arrays(path, "matlab", arrays, remarks)


def _version4(path: Path) -> Iterator[Variable]:
    """The variables of a file of version 4, which has no structs."""
    from scipy.io import loadmat, whosmat

    listing = whosmat(path)
    guards.check_count(str(path), "arrays", len(listing), limits.COLUMNS)
    claimed = sum(math.prod(shape) for _, shape, _ in listing)
    guards.check_count(str(path), "numbers", claimed, min(limits.LOG_VALUES, path.stat().st_size))
    for name, value in loadmat(path).items():
        if not name.startswith("__"):
            yield Variable(name, value if isinstance(value, np.ndarray) else "is sparse")


def _collect(variable: Variable, arrays: Arrays, remarks: list[str]) -> None:
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
