"""Cells that begin with `%%bash` are shown as the shell commands that they run."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

MAGIC = "%%bash"


def _show(app: Sphinx, doctree: nodes.document) -> None:
    for node in doctree.findall(nodes.literal_block):
        first, _, rest = node.astext().partition("\n")
        if first.startswith(MAGIC):
            shown = nodes.literal_block(rest, rest, language="bash", classes=list(node["classes"]))
            node.replace_self(shown)


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect the transformation."""
    app.connect("doctree-read", _show)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
