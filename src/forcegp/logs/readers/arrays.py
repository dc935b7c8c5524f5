"""Readers of files with named arrays: NumPy archives without pickled objects, HDF5 and MATLAB.

MATLAB files of version 7.3 are read as HDF5 files, and those of version 4 with SciPy. In versions 5 to 7,
every tag is checked before it is followed, since SciPy's reader crashes on some damaged files. For the
layout, see "MAT-File Format" (MathWorks), chapter 1. Links from an HDF5 file to other files are not followed.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forcegp import guards, limits
from forcegp.errors import DataError, optional_module
from forcegp.logs import table
from forcegp.logs.table import LogTable

Arrays = dict[str, NDArray[np.generic]]


def read_numpy(path: Path, **_: object) -> LogTable:
    """Read the numeric arrays in an `.npz` archive, or the array in an `.npy` file."""
    arrays: Arrays = {}
    with guards.foreign(str(path), "a NumPy file"):
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                members = archive.infolist()
                guards.check_count(str(path), "arrays", len(members), limits.COLUMNS)
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
    """Return an array, or the fields of a structured array by name, after checking the declared size."""
    form = np.lib.format
    version = form.read_magic(file)  # pyright: ignore[reportArgumentType]
    read_header = {(1, 0): form.read_array_header_1_0, (2, 0): form.read_array_header_2_0}.get(version)
    if read_header is None:
        raise DataError(f"{source}: version {version} of the NumPy format is not read")
    shape, fortran, dtype = read_header(file)  # pyright: ignore[reportArgumentType]
    if dtype.hasobject:
        text = f"{source}: refused, because an array of Python objects is a pickle, which can run code"
        raise DataError(text, expected="an array of numbers", hint="save each quantity as a separate array")
    count = int(np.prod(shape, dtype=object)) if shape else 1
    guards.check_count(source, "numbers", count, limits.LOG_VALUES)
    if count * dtype.itemsize > size:
        text = f"{source}: the declared size of the array exceeds the file"
        raise DataError(text, got=f"{shape} of {dtype}")
    data = file.read(count * dtype.itemsize)
    array = np.frombuffer(data, dtype=dtype, count=count).reshape(shape, order="F" if fortran else "C")
    names = {field: f"{name}.{field}".lstrip(".") for field in dtype.names or ()}
    return {title: array[field] for field, title in names.items()} or {name: array}


def read_hdf5(path: Path, **_: object) -> LogTable:
    """Read the numeric data sets in an HDF5 file. Those in groups are named `group/name`."""
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
    """Collect the data sets in a group, omitting duplicates created by links."""
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
        if (mark := h5py.h5o.get_info(item.id).addr) in seen:
            continue
        seen.add(mark)
        guards.check_count(group.file.filename, "objects", len(seen), limits.COLUMNS)
        if isinstance(item, h5py.Group):
            _walk(h5py, item, f"{name}{separator}", separator, arrays, remarks, seen)
        elif isinstance(item, h5py.Dataset):
            _take(item, name, arrays, remarks)


def _take(item: Any, name: str, arrays: Arrays, remarks: list[str]) -> None:
    text = item.attrs.get("MATLAB_class", b"") in (b"char", b"cell", b"struct", b"function_handle")
    if item.dtype.kind not in "fiub" or not 1 <= sum(n > 1 for n in item.shape) <= 2 or text:
        remarks.append(f"{name!r} of shape {item.shape} and type {item.dtype} was left out")
    elif item.external or item.is_virtual:
        remarks.append(f"{name!r} lies outside the file and was left out")
    else:
        source, taken = item.file.filename, sum(array.size for array in arrays.values()) + item.size
        guards.check_count(source, "numbers", taken, limits.LOG_VALUES)
        guards.check_expansion(source, 8 * taken, size := Path(source).stat().st_size)
        guards.check_chunks(item, size)
        arrays[name] = item[()]


HEADER_BYTES = 128
MATRIX, COMPRESSED, INT8, UTF8 = 14, 15, 1, 16
DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy types that correspond to numeric element types."""
STRUCT, NUMERIC = 2, range(6, 16)
OTHER_CLASSES = {1: "cell", 3: "object", 4: "char", 5: "sparse", 16: "function", 17: "opaque"}
COMPLEX = 0x08


class Variable(NamedTuple):
    """A named array (`struct.field` for a field of a struct), or the reason why it cannot be read."""

    name: str
    value: NDArray[np.generic] | str


class _Element(NamedTuple):
    kind: int
    body: memoryview


def variables(content: bytes, source: str) -> Iterator[Variable]:
    """Yield the variables in the content of a file, in order. `source` is the file name for messages."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise DataError(f"{source}: not a MATLAB file of versions 5 to 7", got=content[:20])
    allowed = min(guards.allowed_bytes(len(content)), limits.TABLE_BYTES)
    return _Reader(source, order, allowed).variables(memoryview(content))


class _Reader:
    def __init__(self, source: str, order: str, remaining: int) -> None:
        self.source, self.order, self.count, self.remaining = source, order, 0, remaining

    def variables(self, content: memoryview) -> Iterator[Variable]:
        for element in self.elements(content[HEADER_BYTES:]):
            if element.kind == COMPRESSED:
                element = self.next(self.elements(self.inflated(element.body)))
            yield from self.matrix(element, "a variable")

    def inflated(self, body: memoryview) -> memoryview:
        stream = zlib.decompressobj()
        try:
            content = stream.decompress(body, max(self.remaining, 1))
        except zlib.error as cause:
            raise self.damaged("compressed data", str(cause)) from cause
        if stream.unconsumed_tail:
            text = f"a variable inflates to more than the {self.remaining:,} bytes that are left"
            raise DataError(f"{self.source}: {text}")
        self.remaining -= len(content)
        return memoryview(content)

    def elements(self, content: memoryview) -> Iterator[_Element]:
        """Yield consecutive elements. They are aligned to 8 bytes, and short ones are part of their tag."""
        at = 0
        while at < len(content):
            if len(content) - at < 8:
                raise self.damaged("a tag of 8 bytes", f"{len(content) - at} bytes")
            kind, size = (int(x) for x in np.frombuffer(content[at : at + 8], self.order + "u4"))
            if kind >> 16:
                kind, size, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
            else:
                start, end = at + 8, at + 8 + size
            if size > end - start or end > len(content):
                raise self.damaged(f"an element of {size} bytes", f"{len(content) - start} bytes")
            yield _Element(kind, content[start : start + size])
            # Only compressed elements are not padded.
            at = end if kind == COMPRESSED else end + -end % 8

    def next(self, elements: Iterator[_Element]) -> _Element:
        element = next(elements, None)
        if element is None:
            raise self.damaged("a further element", "the end of the variable")
        return element

    def matrix(self, element: _Element, what: str, field: str = "", depth: int = 0) -> Iterator[Variable]:
        """Yield a variable or a field of a struct. If the field is itself a struct, yield all its fields."""
        if element.kind != MATRIX:
            raise self.damaged(what, f"an element of type {element.kind}")
        if depth > limits.GROUP_DEPTH:
            raise DataError(f"{self.source}: structs are nested more than {limits.GROUP_DEPTH} levels deep")
        self.count += 1
        guards.check_count(self.source, "variables and fields", self.count, limits.COLUMNS)
        if not len(element.body):
            yield Variable(field, "holds nothing")
            return
        parts = self.elements(element.body)
        flags = self.numbers(self.next(parts))
        if not len(flags):
            raise self.damaged("the class of an array", "nothing")
        kind, flag = int(flags[0]) & 0xFF, int(flags[0]) >> 8 & 0xFF
        if kind in (16, 17):  # functions and classes have a layout of their own
            yield Variable(field, f"is of class {OTHER_CLASSES[kind]}")
            return
        shape = tuple(int(x) for x in self.numbers(self.next(parts)))
        title = self.next(parts)
        if title.kind not in (INT8, UTF8):
            raise self.damaged("a name", f"an element of type {title.kind}")
        name = field or bytes(title.body).decode("utf-8", "replace")
        if kind == STRUCT and math.prod(shape) == 1:
            yield from self.fields(parts, name, depth)
        elif kind in NUMERIC:
            yield Variable(name, "is complex" if flag & COMPLEX else self.array(self.next(parts), shape))
        else:
            yield Variable(name, f"is of class {OTHER_CLASSES.get(kind, 'struct')}")

    def fields(self, parts: Iterator[_Element], struct: str, depth: int) -> Iterator[Variable]:
        lengths = self.numbers(self.next(parts))
        names = bytes(self.next(parts).body)
        length = int(lengths[0]) if len(lengths) else 0
        if length <= 0 or len(names) % length or len(names) // length > limits.COLUMNS:
            raise self.damaged("the names of a struct's fields", f"{len(names)} bytes in steps of {length}")
        for start in range(0, len(names), length):
            field = names[start : start + length].split(b"\0")[0].decode("utf-8", "replace")
            yield from self.matrix(self.next(parts), "a field of a struct", f"{struct}.{field}", depth + 1)

    def array(self, element: _Element, shape: tuple[int, ...]) -> NDArray[np.generic]:
        values = self.numbers(element)
        if min(shape, default=-1) < 0 or math.prod(shape) != len(values):
            raise self.damaged(f"an array of shape {shape}", f"{len(values)} numbers")
        return values.reshape(shape, order="F")

    def numbers(self, element: _Element) -> NDArray[np.generic]:
        if element.kind not in DTYPES:
            raise self.damaged("numbers", f"an element of type {element.kind}")
        dtype = np.dtype(self.order + DTYPES[element.kind])
        if len(element.body) % dtype.itemsize:
            raise self.damaged(f"numbers of {dtype.itemsize} bytes", f"{len(element.body)} bytes")
        return np.frombuffer(element.body, dtype).astype(dtype.newbyteorder("="), copy=False)

    def damaged(self, expected: str, got: str) -> DataError:
        return DataError(f"{self.source}: the MATLAB file is damaged", expected=expected, got=got)


HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""HDF5 signature, which follows a header of 512 bytes in version 7.3."""


def read_matlab(path: Path, **_: object) -> LogTable:
    """Read the numeric arrays in a MATLAB file, naming fields `struct.field`, and note other variables."""
    with path.open("rb") as file:
        head = file.read(520)
    arrays, remarks = Arrays(), list[str]()
    if HDF5_MAGIC in (head[:8], head[512:520]):  # version 7.3: names as in MATLAB, and axes in its order
        arrays = {name: array.T for name, array in _hdf5_arrays(path, ".", remarks).items()}
    else:
        with guards.foreign(str(path), "a MATLAB file"):
            for name, value in _version4(path) if 0 in head[:4] else variables(path.read_bytes(), str(path)):
                if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
                    arrays[name] = value
                else:
                    reason = value if isinstance(value, str) else "holds no numbers"
                    remarks.append(f"{name!r} {reason} and was left out")
    guards.check_count(str(path), "arrays", len(arrays), limits.COLUMNS)
    return table.table_of_arrays(path, "matlab", arrays, remarks)


def _version4(path: Path) -> Iterator[Variable]:
    """Yield the variables in a version 4 file, which cannot contain structs."""
    from scipy.io import loadmat, whosmat

    listing = whosmat(path)
    guards.check_count(str(path), "arrays", len(listing), limits.COLUMNS)
    claimed = sum(math.prod(shape) for _, shape, _ in listing)
    guards.check_count(str(path), "numbers", claimed, min(limits.LOG_VALUES, path.stat().st_size))
    for name, value in loadmat(path).items():
        if not name.startswith("__"):
            yield Variable(name, value if isinstance(value, np.ndarray) else "is sparse")
