"""In-place editing of XML documents that changes only the edited attributes and elements.

XML writers lose comments, attribute order or indentation. This editor locates start tags and attribute values
in the text, and replaces only these spans.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from forcegp.errors import RobotFileError
from forcegp.robot.safety import parse_xml

_ATTRIBUTE = re.compile(rb"""\s+([^\s=/>"']+)\s*=\s*("[^"]*"|'[^']*')""")
_TAG_NAME = re.compile(rb"<[^\s/>]+")


@dataclass(eq=False)
class Span:
    """An element in the text of a document: the end of its name (`head`), the end of its start tag (`close`),
    whether it is written as `<tag/>`, the indentation of its line, the start of its end tag (`end`), and its
    attributes. For each attribute, it contains the start and end of the quoted value, and the start of the
    attribute including the preceding space.
    """

    tag: str
    attributes: dict[str, str]
    values: dict[str, tuple[int, int, int]]
    head: int
    close: int
    empty: bool
    indent: bytes
    end: int = 0
    children: list[Span] = field(default_factory=list)

    def find(self, tag: str) -> Span | None:
        """Return the first child with the given tag, or `None` if there is no such child."""
        return next((child for child in self.children if child.tag == tag), None)

    def iter(self) -> Iterator[Span]:
        """Yield the element and all its descendants in document order."""
        yield self
        for child in self.children:
            yield from child.iter()


class EditableXml:
    """An XML document whose attributes can be changed in place.

    Args:
        data: the document.
        label: name of the file, used in messages.

    Raises:
        RobotFileError: the document is not well-formed UTF-8, or `safety.parse_xml` rejects it.

    Example:
        >>> document = EditableXml(b"<robot> <!-- mine --> <mass value='1'/></robot>", "my.urdf")
        >>> document.set(document.root.children[0], "value", "2")
        >>> document.written()
        b'<robot> <!-- mine --> <mass value="2"/></robot>'
    """

    def __init__(self, data: bytes, label: str) -> None:
        parse_xml(data, label)
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            text = f"{label}: cannot be edited in place"
            raise RobotFileError(text, expected="UTF-8 text", got=str(error)) from error
        self._data, self._edits, open_ = data, list[tuple[int, int, bytes]](), list[Span]()
        roots: list[Span] = []
        parser = expat.ParserCreate("utf-8")

        def start(tag: str, attributes: dict[str, str]) -> None:
            element = self._span(tag, attributes, parser.CurrentByteIndex)
            (open_[-1].children if open_ else roots).append(element)
            open_.append(element)

        def end(_: str) -> None:
            open_.pop().end = parser.CurrentByteIndex

        parser.StartElementHandler = start
        parser.EndElementHandler = end
        parser.Parse(data, True)
        (self.root,) = roots

    def _span(self, tag: str, attributes: dict[str, str], at: int) -> Span:
        name = _TAG_NAME.match(self._data, at)
        assert name is not None
        values, end = {}, name.end()
        while (attribute := _ATTRIBUTE.match(self._data, end)) is not None:
            values[attribute[1].decode()] = (attribute.start(2), attribute.end(2), attribute.start())
            end = attribute.end()
        close = self._data.index(b">", end) + 1
        line = self._data[self._data.rfind(b"\n", 0, at) + 1 : at]
        indent = line if not line.strip() else b""
        empty = self._data[close - 2 : close] == b"/>"
        return Span(tag, attributes, values, name.end(), close, empty, indent)

    def set(self, element: Span, name: str, text: str) -> None:
        """Set an attribute. A new attribute is added after the existing attributes."""
        quoted = quoteattr(text).encode()
        if name in element.values:
            first, last, _ = element.values[name]
            self._edits.append((first, last, quoted))
        else:
            at = max((last for _, last, _ in element.values.values()), default=element.head)
            self._edits.append((at, at, b" " + name.encode() + b"=" + quoted))

    def drop(self, element: Span, name: str) -> None:
        """Remove an attribute."""
        if name in element.values:
            _, last, before = element.values[name]
            self._edits.append((before, last, b""))

    def add_child(self, element: Span, tag: str, attributes: dict[str, str], inside: str = "") -> None:
        """Insert an element as the first child. `inside` is its content, as empty tags."""
        text = "".join(f" {name}={quoteattr(value)}" for name, value in attributes.items())
        child = f"<{tag}{text}>{inside}</{tag}>" if inside else f"<{tag}{text}/>"
        step = element.children[0].indent if element.children else element.indent + b"  "
        newline = b"\r\n" if b"\r\n" in self._data else b"\n"
        added = newline + step + child.encode()
        if element.empty:
            closing = added + newline + element.indent + f"</{element.tag}>".encode()
            self._edits.append((element.close - 2, element.close, b">" + closing))
        else:
            self._edits.append((element.close, element.close, added))

    def append(self, element: Span, text: str) -> None:
        """Insert XML as the last child of an element that has children."""
        step, newline = element.children[0].indent, b"\r\n" if b"\r\n" in self._data else b"\n"
        self._edits.append((element.end, element.end, step + text.encode() + newline + element.indent))

    def written(self) -> bytes:
        """Return the document with all changes applied."""
        parts, at = [], 0
        for first, last, text in sorted(self._edits, key=lambda edit: edit[:2]):
            parts += [self._data[at:first], text]
            at = last
        return b"".join([*parts, self._data[at:]])
