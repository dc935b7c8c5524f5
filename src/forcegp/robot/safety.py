"""Safe parsing of XML from untrusted files. Entities are rejected, and size and depth are limited."""

from __future__ import annotations

import math
from io import BytesIO
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler
from xml.sax.xmlreader import AttributesImpl

from defusedxml import DefusedXmlException
from defusedxml.sax import make_parser

from forcegp.errors import RobotFileError

MAX_BYTES = 8 * 2**20
MAX_ELEMENTS = 20_000
MAX_DEPTH = 128
MAX_NUMBER = 1e12
"""Upper bound on lengths, masses and moments, which prevents overflow in their products."""


class _BoundedBuilder(ContentHandler):
    """A handler that builds a tree, and rejects files that are too large or too deeply nested.

    Tags and attributes keep their prefixes as text: robot files often lack the declaration of a prefix, and a
    default namespace has no meaning in them.
    """

    def __init__(self, label: str) -> None:
        super().__init__()
        self.tree, self._label, self._count, self._depth = TreeBuilder(), label, 0, 0

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        self._count += 1
        self._depth += 1
        if self._count > MAX_ELEMENTS:
            text, hint = f"{self._label}: too many elements", "keep only links, joints and bodies"
            raise RobotFileError(text, expected=f"at most {MAX_ELEMENTS} XML elements", got="more", hint=hint)
        if self._depth > MAX_DEPTH:
            text = f"{self._label}: elements are nested too deeply"
            raise RobotFileError(text, expected=f"at most {MAX_DEPTH} levels", got=f"more, at <{name[:60]}>")
        self.tree.start(name, dict(attrs))

    def endElement(self, name: str) -> None:
        self._depth -= 1
        self.tree.end(name)

    def characters(self, content: str) -> None:
        self.tree.data(content)


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file of at most `MAX_BYTES`; raise `RobotFileError` otherwise."""
    try:
        if not path.is_file():
            kind = "a folder" if path.is_dir() else "something else" if path.exists() else "no such file"
            raise RobotFileError(f"{path}: cannot be read", expected="a URDF or MJCF file", got=kind)
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, RobotFileError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise RobotFileError(f"{path}: cannot be read", expected="a readable file", got=reason) from error
    if len(data) > MAX_BYTES:
        text = f"{path}: the file is too large"
        raise RobotFileError(text, expected=f"at most {MAX_BYTES} bytes", got="more")
    return data


def parse_xml(data: bytes, label: str) -> Element:
    """Parse an XML document; raise `RobotFileError` if it is malformed, malicious, too large or too deep."""
    parser, builder = make_parser(), _BoundedBuilder(label)
    parser.forbid_dtd = True
    parser.setContentHandler(builder)
    try:
        parser.parse(BytesIO(data))
        return builder.tree.close()
    except DefusedXmlException as error:
        raise RobotFileError(
            f"{label}: document types and entities are not allowed",
            expected="plain XML without <!DOCTYPE> and <!ENTITY>",
            got=type(error).__name__,
            hint="replace entities by their text",
        ) from error
    except SAXParseException as error:
        got = f"{error.getMessage()}: line {error.getLineNumber()}, column {error.getColumnNumber()}"
        raise RobotFileError(
            f"{label}: not well-formed XML",
            expected="a complete URDF or MJCF document",
            got=got,
            hint="delete everything before <?xml"
            if "not at start" in got
            else "the file may be truncated, or may not be XML",
        ) from error
    except (LookupError, UnicodeError, ValueError, AssertionError) as error:
        if isinstance(error, RobotFileError):
            raise
        raise RobotFileError(f"{label}: not readable as XML", expected="UTF-8 text", got=error) from error


def xacro_error(label: str, got: str) -> RobotFileError:
    """Return the error for a file that contains unexpanded xacro macros."""
    text = f"{label}: the file has xacro macros that are not expanded"
    hint = "expand them first: xacro robot.urdf.xacro > robot.urdf"
    return RobotFileError(text, expected="plain URDF", got=got, hint=hint)


def parse_numbers(
    text: str, where: str, count: int, *, infinite: bool = False, error: type[RobotFileError] = RobotFileError
) -> list[float]:
    """Parse an attribute with `count` finite numbers (or ±∞ if `infinite`); raise `error` if invalid."""
    expected = f"{count} finite number{'s' if count > 1 else ''}"
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count:
        raise error(f"{where} is not valid", expected=expected, got=repr(text[:80]))
    for value in values:
        if math.isnan(value) or (not infinite and abs(value) > MAX_NUMBER):
            message = f"{where} is not valid"
            raise error(message, expected=f"{expected} below {MAX_NUMBER:g}", got=repr(text[:80]))
    return values
