"""Extensions of the documentation, and the page of messages that they generate."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

DOCS = Path(__file__).parents[1] / "docs"


def extension(name: str) -> ModuleType:
    """An extension of Sphinx that belongs to the site."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "_ext" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_names_that_share_an_entry_keep_their_space() -> None:
    from docutils.frontend import get_default_settings
    from docutils.nodes import paragraph
    from docutils.utils import new_document

    plain = extension("plain_docstrings")
    line = plain.escaped("    ModelError, UnknownNameError: the force is unknown")
    assert " " not in line.strip().partition(":")[0], "Sphinx would take the first name for a type"
    document = new_document("page", get_default_settings())
    document += paragraph("", line.strip())
    plain._spaced(None, document)
    assert document.astext() == "ModelError, UnknownNameError: the force is unknown"


def test_every_finding_and_every_error_is_on_the_page_of_messages() -> None:
    from forcegp.checks import KINDS

    page, messages = (DOCS / "reference" / "messages.md").read_text(encoding="utf-8"), extension("messages")
    assert "<!-- generated: findings -->" in page and "<!-- generated: errors -->" in page
    findings, errors = messages.findings(), messages.errors()
    for name, kind in KINDS.items():
        assert f"| `{name}` | {kind.family} | {kind.severity} | {kind.title} | {kind.remedy} |" in findings
    assert "## RobotFileError\n" in errors
    assert "| cannot select … of … points |" in errors
    assert errors.count("](../troubleshooting.md)") >= 10
