"""Docstrings are plain text with code in single backticks; this makes them valid reStructuredText.

Default values that a dataclass makes anew, which Python shows as `<factory>`, are written out.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

CODE = re.compile(r"(`[^`]+`)")
SEVERAL = re.compile(r"^(\s+)(\w+(?:, \w+)+): ")
NO_SPACE = "\N{ZERO WIDTH SPACE}"
"""Stands for a space between the names of an entry until the page is read."""
MARKUP = re.compile(r"(?<!\\)([*|]|(?<=\w)_(?!\w))")


def escaped(line: str) -> str:
    """Absolute values, products and trailing underscores are mathematics, not markup."""
    if line.lstrip().startswith((">>>", "...")):
        return line
    # One entry may describe several attributes; Sphinx takes a name with a space for a type and a name.
    line = SEVERAL.sub(lambda found: f"{found[1]}{found[2].replace(', ', f',{NO_SPACE}')}: ", line)
    parts = CODE.split(line)
    return "".join(f"`{part}`" if CODE.fullmatch(part) else MARKUP.sub(r"\\\1", part) for part in parts)


def _process(_: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    lines[:] = [escaped(line) for line in lines]


def _spaced(_: Sphinx, doctree: nodes.document) -> None:
    for text in [text for text in doctree.findall(nodes.Text) if NO_SPACE in text]:
        text.parent.replace(text, nodes.Text(text.replace(NO_SPACE, " ")))


def made(value: object) -> str:
    """A default value in short: an empty container, or the name of its class."""
    return repr(value) if isinstance(value, dict | list | tuple) else f"{type(value).__name__}()"


def _defaults(
    _: Sphinx, what: str, name: str, obj: object, options: Any, signature: str | None, returned: str | None
) -> tuple[str, str | None] | None:
    if what != "class" or signature is None or not dataclasses.is_dataclass(obj):
        return None
    for field in dataclasses.fields(obj):
        if field.init and field.default_factory is not dataclasses.MISSING:
            signature = signature.replace("<factory>", made(field.default_factory()), 1)
    return signature, returned


def setup(app: Sphinx) -> dict[str, Any]:
    """Run before Napoleon."""
    app.connect("autodoc-process-docstring", _process, priority=100)
    app.connect("autodoc-process-signature", _defaults)
    app.connect("doctree-read", _spaced)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
