"""Files are whole or absent, and headers say what they are."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar

import pytest

from forcegp.errors import DataError, DestinationError
from forcegp.files import Header, atomic_file, write_json, write_text, written_folder
from forcegp.limits import HEADER_BYTES


class Card(Header):
    FORMAT: ClassVar[str] = "card"
    VERSION: ClassVar[int] = 3
    size: int = 0


class Crash(Exception):
    pass


def write_half_a_file(target: Path) -> None:
    with atomic_file(target) as temporary:
        temporary.write_text("half")
        raise Crash


def write_half_a_folder(target: Path) -> None:
    with written_folder(target) as temporary:
        (temporary / "half").write_text("half")
        raise Crash


def test_a_crash_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with pytest.raises(Crash):
        write_half_a_file(target)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_file_takes_its_place_and_missing_folders_are_made(tmp_path: Path) -> None:
    write_text(tmp_path / "new" / "a.txt", "text")
    assert (tmp_path / "new" / "a.txt").read_text() == "text"
    assert os.listdir(tmp_path / "new") == ["a.txt"]


def test_a_crash_leaves_the_old_folder_and_success_replaces_it_whole(tmp_path: Path) -> None:
    target = tmp_path / "model"
    with written_folder(target) as temporary:
        (temporary / "old").write_text("old")
    with pytest.raises(Crash):
        write_half_a_folder(target)
    assert os.listdir(target) == ["old"]
    with written_folder(target) as temporary:
        (temporary / "new").write_text("new")
    assert os.listdir(target) == ["new"]
    assert os.listdir(tmp_path) == ["model"]


def test_a_folder_does_not_replace_a_file(tmp_path: Path) -> None:
    (tmp_path / "model").write_text("precious")
    with pytest.raises(DestinationError, match="is a file"), written_folder(tmp_path / "model"):
        pass
    assert (tmp_path / "model").read_text() == "precious"


def test_json_without_numbers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not (tmp_path / "a.json").exists()


def test_header_round_trip() -> None:
    assert Card.from_json(Card(size=4).to_json(), "x", DataError) == Card(size=4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[1]", "not a JSON object"),
        ("[" * 100_000, "not JSON"),
        ('{"format": "dart", "version": 3}', r"x has a different format\n  expected: card\n  got: 'dart'"),
        (
            '{"format": "card", "version": 9}',
            r"(?s)expected: version 3\n  got: version 9.*hint: .*update forcegp",
        ),
        ('{"format": "card"}', "version None"),
        ('{"format": "card", "version": 3, "size": "big"}', "header field 'size'"),
        ('{"format": "card", "version": 3, "colour": 1}', "header field 'colour'"),
        ('{"format": "card", "version": 3, "size": ' + "[" * 80 + "]" * 80 + "}", "nested too deeply"),
        (" " * (HEADER_BYTES + 1), "too large"),
    ],
)
def test_bad_headers_say_what_is_wrong(text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Card.from_json(text, "x", DataError)
