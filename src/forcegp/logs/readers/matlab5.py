"""The elements of a MATLAB file of versions 5 to 7: numeric arrays, and structs of one element.

SciPy's reader crashes the process on some damaged files, so every tag is checked here before it is followed.
The layout is that of "MAT-File Format" (MathWorks), chapter 1.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forcegp import limits
from forcegp.errors import DataError
from forcegp.guards import allowed_bytes, check_count

HEADER_BYTES = 128
MATRIX, COMPRESSED, INT8, UTF8 = 14, 15, 1, 16
DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy types of the element types that hold numbers."""
STRUCT, NUMERIC = 2, range(6, 16)
OTHER_CLASSES = {1: "cell", 3: "object", 4: "char", 5: "sparse", 16: "function", 17: "opaque"}
COMPLEX = 0x08


class Variable(NamedTuple):
    """A named value: an array, the fields of a struct, or why there is neither."""

    name: str
    value: NDArray[np.generic] | tuple[Variable, ...] | str


class _Element(NamedTuple):
    kind: int
    body: memoryview


def variables(content: bytes, source: str) -> Iterator[Variable]:
    """The variables of a file with that content, in their order; `source` names it in messages."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise DataError(f"{source}: not a MATLAB file of versions 5 to 7", got=content[:20])
    return _Reader(source, order).variables(memoryview(content))


class _Reader:
    def __init__(self, source: str, order: str) -> None:
        self.source, self.order, self.count, self.left = source, order, 0, 0

    def variables(self, content: memoryview) -> Iterator[Variable]:
        self.left = min(allowed_bytes(len(content)), limits.TABLE_BYTES)
        for element in self.elements(content[HEADER_BYTES:]):
            if element.kind == COMPRESSED:
                element = self.next(self.elements(self.inflated(element.body)))
            if element.kind != MATRIX:
                raise self.damaged("a variable", f"an element of type {element.kind}")
            yield self.matrix(element.body, 0)

    def inflated(self, body: memoryview) -> memoryview:
        stream = zlib.decompressobj()
        try:
            content = stream.decompress(body, max(self.left, 1))
        except zlib.error as cause:
            raise self.damaged("compressed data", str(cause)) from cause
        if stream.unconsumed_tail:
            raise DataError(
                f"{self.source}: a variable inflates to more than the {self.left:,} bytes that are left"
            )
        self.left -= len(content)
        return memoryview(content)

    def elements(self, content: memoryview) -> Iterator[_Element]:
        """The elements that follow each other, aligned to eight bytes; short ones lie within their tag."""
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

    def matrix(self, body: memoryview, depth: int) -> Variable:
        """A variable, or a field of a struct."""
        if depth > limits.GROUP_DEPTH:
            raise DataError(f"{self.source}: structs are nested more than {limits.GROUP_DEPTH} levels deep")
        self.count += 1
        check_count(self.source, "variables and fields", self.count, limits.COLUMNS)
        if not len(body):
            return Variable("", "holds nothing")
        parts = self.elements(body)
        flags = self.numbers(self.next(parts))
        if not len(flags):
            raise self.damaged("the class of an array", "nothing")
        kind, flag = int(flags[0]) & 0xFF, int(flags[0]) >> 8 & 0xFF
        if kind in (16, 17):  # functions and classes have a layout of their own
            return Variable("", f"is of class {OTHER_CLASSES[kind]}")
        shape = tuple(int(x) for x in self.numbers(self.next(parts)))
        name = self.text(self.next(parts))
        if kind in NUMERIC and flag & COMPLEX:
            return Variable(name, "is complex")
        if kind in NUMERIC:
            return Variable(name, self.array(self.next(parts), shape))
        if kind == STRUCT and math.prod(shape) == 1:
            return Variable(name, self.fields(parts, depth))
        return Variable(name, f"is of class {OTHER_CLASSES.get(kind, 'struct')}")

    def fields(self, parts: Iterator[_Element], depth: int) -> tuple[Variable, ...]:
        lengths = self.numbers(self.next(parts))
        names = bytes(self.next(parts).body)
        length = int(lengths[0]) if len(lengths) else 0
        if length <= 0 or len(names) % length or len(names) // length > limits.COLUMNS:
            raise self.damaged("the names of a struct's fields", f"{len(names)} bytes in steps of {length}")
        variables = []
        for start in range(0, len(names), length):
            element = self.next(parts)
            if element.kind != MATRIX:
                raise self.damaged("a field of a struct", f"an element of type {element.kind}")
            field = names[start : start + length].split(b"\0")[0].decode("utf-8", "replace")
            variables.append(Variable(field, self.matrix(element.body, depth + 1).value))
        return tuple(variables)

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

    def text(self, element: _Element) -> str:
        if element.kind not in (INT8, UTF8):
            raise self.damaged("a name", f"an element of type {element.kind}")
        return bytes(element.body).decode("utf-8", "replace")

    def damaged(self, expected: str, got: str) -> DataError:
        return DataError(f"{self.source}: the MATLAB file is damaged", expected=expected, got=got)
