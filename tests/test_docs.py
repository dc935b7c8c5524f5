"""The pages of the documentation: what is shown as code is executed, and links lead somewhere."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md"))
EXECUTED = "{code-cell} python"
DIRECTIVES = ("{toctree}", "{include}", "{eval-rst}")
INSTALLED = ("pip install", "make ", "torchrun --nnodes", "python benchmarks/", "python -W")
"""Commands that cannot run while the site is built: they install, take hours, or need several machines."""


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and body of the fenced blocks of a page."""
    text = page.read_text(encoding="utf-8")
    return re.findall(r"^```+([^\n`]*)\n(.*?)^```+$", text, flags=re.S | re.M)


def name(page: Path) -> str:
    return str(page.relative_to(DOCS))


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_code_is_executed(page: Path) -> None:
    executed = [body for kind, body in blocks(page) if kind.startswith("{code-cell}")]
    if executed:
        assert page.read_text(encoding="utf-8").startswith("---\nfile_format: mystnb\n")
    for kind, body in blocks(page):
        if kind == "console":
            for line in body.splitlines():
                assert line.startswith(tuple(f"$ {command}" for command in INSTALLED)), line
        elif kind == "toml":
            assert tomllib.loads(body)
        else:
            assert kind in (EXECUTED, "text") or kind.startswith(DIRECTIVES), (
                f"this block is not executed: {kind!r}"
            )


def test_make_targets_exist() -> None:
    makefile = (DOCS.parent / "Makefile").read_text(encoding="utf-8")
    named = {
        target for page in PAGES for target in re.findall(r"^\$ make (\w+)", page.read_text(), flags=re.M)
    }
    assert named
    for target in named:
        assert re.search(rf"^{target}:", makefile, flags=re.M), target


def test_public_names_are_in_the_reference() -> None:
    import forcegp

    text = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    modules = {"compiled", "derivatives", "dynamics", "identification", "kinematics"}
    for public in forcegp.__all__:
        directive = "automodule" if public in modules else "auto(?:class|function)"
        assert re.search(rf"^\.\. {directive}:: forcegp\.{public}$", text, flags=re.M), public
