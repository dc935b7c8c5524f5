"""Random changes of bytes, with tokens of the formats that the readers know."""

from __future__ import annotations

import random
import re
import struct

TOKENS = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"1e400", b"99999999999999999999", b"true", b"null",
    b"\x00", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"[", b"]", b"{", b"}", b'"', b"'", b".", b",", b"\n",
    b"=", b"<!--", b'<!DOCTYPE r [<!ENTITY a "aaaa">]>', b"&a;", b"[[contact]]", b"a.b.c.d.e.f.g",
    b"\xef\xbb\xbf", b"\xe9",
)  # fmt: skip
NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")
EDGES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, 2**64 - 1)


def mutated(rng: random.Random, corpus: list[bytes]) -> bytes:
    """One of the inputs, changed in a few places."""
    data = rng.choice(corpus)
    for _ in range(rng.choice((1, 1, 2, 3, 5, 10))):
        data = rng.choice(_CHANGES)(rng, data, corpus)
    return data[: 4 << 20]


def _flip(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    if not data:
        return data
    i = rng.randrange(len(data))
    return data[:i] + bytes([data[i] ^ (1 << rng.randrange(8))]) + data[i + 1 :]


def _byte(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    i = rng.randrange(len(data) + 1)
    return data[:i] + bytes([rng.randrange(256)]) + data[i + 1 :]


def _cut(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    i, j = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:i] + data[j:] if rng.random() < 0.7 else data[:j]


def _repeat(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    i = rng.randrange(len(data) + 1)
    j = min(len(data), i + rng.randrange(1, 200))
    return data[:j] + data[i:j] * rng.choice((1, 2, 10, 300)) + data[j:]


def _token(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    i = rng.randrange(len(data) + 1)
    return data[:i] + rng.choice(TOKENS) * rng.choice((1, 1, 1, 50)) + data[i + rng.choice((0, 1, 4)) :]


def _number(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    found = [match.span() for match in NUMBER.finditer(data[: 1 << 16])]
    if not found:
        return _flip(rng, data, corpus)
    i, j = rng.choice(found)
    return data[:i] + rng.choice(TOKENS[:8]) + data[j:]


def _integer(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    """An edge value in the place of a little-endian integer: a length, a count, an offset."""
    form = rng.choice("BHIQ")
    size = struct.calcsize(form)
    i = rng.randrange(len(data) + 1)
    value = rng.choice(EDGES) & ((1 << 8 * size) - 1)
    return data[:i] + struct.pack("<" + form, value) + data[i + size :]


def _splice(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    other = rng.choice(corpus)
    i, j = rng.randrange(len(data) + 1), rng.randrange(len(other) + 1)
    return data[:i] + other[j : j + rng.randrange(1, 2000)] + data[i:]


_CHANGES = (_flip, _byte, _cut, _repeat, _token, _number, _integer, _splice)
