"""Files that are never half written, and JSON headers that say which format and version they are."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from forcegp.errors import ForceGPError

H = TypeVar("H", bound="Header")

MAX_HEADER_BYTES = 1 << 20
"""A header is a page of text; anything larger is not one of ours."""


def _sync(path: Path) -> None:
    """Force a file to disk, so that a rename never outruns the data it names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _beside(target: Path) -> Path:
    """A hidden, unused name beside `target` with the same ending, as some writers go by the ending."""
    target.parent.mkdir(parents=True, exist_ok=True)
    return target.with_name(f".{target.stem}.{secrets.token_hex(6)}{target.suffix}")


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends without an error.

    Args:
        path: the file to write; missing parent folders are made.

    Yields:
        Where to write. A reader of `path` sees the old file or the whole new one.

    Raises:
        OSError: the place cannot be written.
    """
    target = Path(path)
    temporary = _beside(target)
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_directory(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside `path` that takes its place when the block ends without an error.

    A folder cannot replace another in one step: a crash between the two renames leaves the old one
    under a hidden name beside `path`, never a mixture of both.

    Args:
        path: the folder to write; missing parents are made.

    Raises:
        OSError: the place cannot be written, or `path` is a file.
    """
    target = Path(path)
    if target.exists() and not target.is_dir():
        raise NotADirectoryError(f"{target} is a file, and a folder is to be written there")
    temporary = _beside(target)
    temporary.mkdir()
    old = temporary.with_name(temporary.name + ".old")
    try:
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                _sync(file)
        if target.exists():
            os.replace(target, old)
        os.replace(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if old.exists() and not target.exists():
            os.replace(old, target)
        shutil.rmtree(old, ignore_errors=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8), whole or not at all."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: object) -> None:
    """Write a value as indented JSON, whole or not at all; NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


class Header(BaseModel):
    """A frozen, versioned JSON header; a subclass names its `FORMAT` and `VERSION` and adds fields.

    Larger text than `MAX_BYTES` is not read; a subclass that holds series of numbers may raise it.

    A field that the class does not know is an error: a file that says more than we understand is
    not read as if it said less.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    MAX_BYTES: ClassVar[int] = MAX_HEADER_BYTES

    def to_json(self) -> str:
        """The header as JSON text, format and version first."""
        head = {"format": self.FORMAT, "version": self.VERSION}
        return json.dumps(head | self.model_dump(mode="json"), indent=2, allow_nan=False)

    @classmethod
    def from_json(cls: type[H], text: str | bytes, source: str, error: type[ForceGPError]) -> H:
        """Read a header, checking its format, version and fields.

        Args:
            text: the JSON text.
            source: name of the file, for the message.
            error: the class of error to raise.

        Raises:
            ForceGPError: of class `error`; the message names the file and the field.
        """
        fields = _json_object(text, source, error, cls.MAX_BYTES)
        name, version = fields.pop("format", None), fields.pop("version", None)
        if name != cls.FORMAT:
            raise error(f"{source} is of another format", expected=cls.FORMAT, got=repr(name))
        if version != cls.VERSION:
            raise error(
                f"{source} has a version of the {cls.FORMAT} format that this release cannot read",
                expected=f"version {cls.VERSION}",
                got=f"version {version!r}",
                hint="read it with the release of forcegp that wrote it, or update forcegp",
            )
        try:
            return cls.model_validate(fields)
        except ValidationError as cause:
            first = cause.errors()[0]
            place = ".".join(str(part) for part in first["loc"])
            raise error(
                f"{source}: header field {place!r} is not valid", expected=first["msg"], got=first["input"]
            ) from cause


def _json_object(text: str | bytes, source: str, error: type[ForceGPError], most: int) -> dict[str, Any]:
    if len(text) > most:
        raise error(f"{source}: the header is too large", expected=f"at most {most} bytes", got=len(text))
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as cause:
        raise error(f"{source}: the header is not JSON", got=str(cause)) from cause
    if not isinstance(value, dict):
        raise error(f"{source}: the header is not a JSON object", got=type(value).__name__)
    return value
