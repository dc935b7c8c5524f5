"""Cells that begin with `%%bash` or `%%writefile` are shown as commands, or as the file that they write.

Output with long lines, such as sentences, is wrapped; tables scroll.
"""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

LONGEST = 90
"""Length of a line up to which output is not wrapped."""
LANGUAGES = {".toml": "toml", ".py": "python"}


def _show(app: Sphinx, doctree: nodes.document) -> None:
    for node in list(doctree.findall(nodes.literal_block)):
        if "output" in node["classes"] and max(map(len, node.astext().splitlines()), default=0) > LONGEST:
            node["classes"].append("wrapped")
        first, _, rest = node.astext().partition("\n")
        if first.startswith("%%bash"):
            language = "bash"
        elif first.startswith("%%writefile"):
            language = LANGUAGES[PurePath(first.split()[-1]).suffix]
        else:
            continue
        node.replace_self(nodes.literal_block(rest, rest, language=language, classes=list(node["classes"])))


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect the transformation."""
    app.connect("doctree-read", _show)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
