"""Our reader of MATLAB 5 files against SciPy's on valid files; damaged ones are refused."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from scipy import sparse

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs.readers.arrays import DTYPES, HEADER_BYTES, MATRIX, variables

CONTENT = {
    "eye": np.eye(3),
    "short": np.arange(5, dtype=np.int16),
    "empty": np.zeros((0, 3)),
    "flags": np.array([True, False]),
    "cube": np.random.default_rng(0).normal(size=(10, 3, 2)),
    "log": {"q": np.ones((4, 2)), "inner": {"y": np.float32(3.0)}, "cells": np.array([1, "a"], object)},
    "note": "text",
    "complex": np.array([1j]),
    "sparse": sparse.eye(4).tocsc(),
    "two": np.array([(1.0, 2.0), (3.0, 4.0)], dtype=[("u", "f8"), ("v", "f8")]),
}


def scipys(name: str, value: Any) -> dict[str, np.ndarray]:
    """The same from what SciPy reads."""
    if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
        fields = value.reshape(-1)[0]
        return {k: v for f in value.dtype.names for k, v in scipys(f"{name}.{f}", fields[f]).items()}
    numeric = isinstance(value, np.ndarray) and value.dtype.kind in "fiub"
    return {name: value} if numeric else {}


def written(folder: Path, compressed: bool = False) -> Path:
    scipy.io.savemat(folder / "run.mat", CONTENT, do_compression=compressed)
    return folder / "run.mat"


@pytest.mark.parametrize("compressed", [False, True])
def test_the_numbers_are_those_that_scipy_reads(compressed: bool, tmp_path: Path) -> None:
    path = written(tmp_path, compressed)
    every = dict(variables(path.read_bytes(), "f"))
    found = {name: value for name, value in every.items() if isinstance(value, np.ndarray)}
    assert every["log.cells"] == "is of class cell" and every["complex"] == "is complex"
    read = scipy.io.loadmat(path)
    expected = {k: v for n in read if n[0] != "_" for k, v in scipys(n, read[n]).items()}
    assert found.keys() == expected.keys() and len(found) == 7
    for name, value in expected.items():
        assert np.array_equal(found[name], value) and found[name].dtype == value.dtype, name


def test_big_endian_files_are_read(tmp_path: Path) -> None:
    def element(kind: int, body: bytes) -> bytes:
        return struct.pack(">II", kind, len(body)) + body.ljust(-(-len(body) // 8) * 8, b"\0")

    values = np.arange(6.0).reshape(3, 2)
    parts = element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">ii", 3, 2)) + element(1, b"x")
    matrix = element(MATRIX, parts + element(9, values.T.astype(">f8").tobytes()))
    path = tmp_path / "big.mat"
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\x01\x00MI" + matrix)
    assert np.array_equal(scipy.io.loadmat(path)["x"], values), "the file is what it should be"
    [found] = variables(path.read_bytes(), "f")
    assert found.name == "x" and np.array_equal(found.value, values)


def test_an_unknown_type_of_numbers_is_refused_at_every_tag(tmp_path: Path) -> None:
    """SciPy follows a pointer beyond its table of types there, which ends the process."""
    content, refused = written(tmp_path).read_bytes(), 0
    for at in range(HEADER_BYTES, len(content) - 8, 8):
        kind, size = struct.unpack_from("<II", content, at)
        if kind in DTYPES and 0 < size < len(content) - at:
            damaged = content[:at] + struct.pack("<I", 41) + content[at + 4 :]
            try:
                list(variables(damaged, "f"))
            except DataError:
                refused += 1
    assert refused > 20


def test_a_compressed_bomb_is_refused(tmp_path: Path) -> None:
    squeezer = zlib.compressobj(9)
    chunk = bytes(1 << 20)
    body = b"".join(squeezer.compress(chunk) for _ in range((limits.FREE_TABLE_BYTES >> 20) + 1))
    body += squeezer.flush()
    header = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM"
    with pytest.raises(DataError, match="inflates to more than"):
        list(variables(header + struct.pack("<II", 15, len(body)) + body, "f"))


def test_a_struct_of_very_many_fields_is_refused() -> None:
    def element(kind: int, body: bytes) -> bytes:
        return struct.pack("<II", kind, len(body)) + body.ljust(-(-len(body) // 8) * 8, b"\0")

    count = limits.COLUMNS + 1
    head = element(6, struct.pack("<II", 2, 0)) + element(5, struct.pack("<ii", 1, 1)) + element(1, b"s")
    fields = element(5, struct.pack("<i", 2)) + element(1, b"f\0" * count) + element(MATRIX, b"") * count
    with pytest.raises(DataError, match="struct's fields"):
        list(variables(b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + element(MATRIX, head + fields), "f"))


def test_a_file_of_another_kind_is_refused() -> None:
    with pytest.raises(DataError, match="not a MATLAB file"):
        variables(b"something else entirely", "f")
