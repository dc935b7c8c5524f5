"""The pages of the documentation: what is shown as code is executed, and links lead somewhere."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

import forcegp

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md"))
OTHERS = [DOCS.parent / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
EXECUTED = "{code-cell} python"
DIRECTIVES = ("{toctree}", "{include}", "{eval-rst}")
INSTALLED = ("pip install", "make ", "python benchmarks/", "python -W")
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


def links(text: str) -> list[str]:
    """Files that a page links to, without their anchors."""
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    return [target for target in targets if "://" not in target]


@pytest.mark.parametrize(
    "page",
    [*PAGES, *(DOCS.parent / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md"))],
    ids=str,
)
def test_links_lead_to_files(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    for target in links(text):
        assert (page.parent / target).exists(), target


PHRASES = """
ends with the place of the page
any of those that a log holds can be what is learned from
±2 std holds noisy ones
wrong input ends in one message that says what to change
limits the wrong way round
so many points cannot be selected
no such way to treat a divergence
the hyperparameters to begin with do not fit
whether accelerations show the force
takes its smoothness for knowledge of that part
the data tell their sum only
for no fewer samples than take longer than starting it
give back what the engine holds
too sure or too unsure of itself
one a joint
learning its figures
priors stand for the forces that the rigid-body model does not know
which noisy samples do not tell
for the posterior finds forces that read less of q̇
whether the payload is another one
leave a variance of at most M over all rows together
of which the truth is known and that play no part elsewhere
has the lightest of theirs
which those of a contact are not
has friction of each joint and of the contact
is hard to beat by much
fewer of joints that others tell of
and any other is read off
a new motion tells nothing of it
leaves every piece but the r-th of each k empty
remove what killed writers of a target left beside it
accelerations are those of no smooth motion
can be written, apart from the data and from each other
as JSON holds it
q and qd are not one batch
the batches do not fit each other
one passive joint is a design; an arm without any torque is a missing column
""".lower().split("\n")[1:-1]
"""Phrases that were found here and rewritten."""

SUBJECTS = "data|logs?|forces?|samples?|accelerations?|torques?|rows?|files?|models?|stretches|evidence"
SPEAKING = re.compile(rf"\b({SUBJECTS})( \w+)? (shows?|knows?|tells?|says?|asks?|sees?|wants?)\b", flags=re.I)
"""Data and forces that speak, know or see."""


def texts() -> list[Path]:
    """Pages, and sources with docstrings and messages."""
    root = DOCS.parent
    sources = [path for folder in ("src", "examples") for path in (root / folder).rglob("*.py")]
    return [*PAGES, *OTHERS, *sources]


def sentences(path: Path) -> str:
    """The text of a page, or the docstrings and messages of a source, in lower case on one line."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        nodes = ast.walk(ast.parse(text))
        values = [node.value for node in nodes if isinstance(node, ast.Constant)]
        text = " | ".join(value for value in values if isinstance(value, str))
    return " ".join(text.split()).lower()


@pytest.mark.parametrize("path", texts(), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_phrases_that_were_rewritten_do_not_come_back(path: Path) -> None:
    text = sentences(path)
    for phrase in PHRASES:
        pattern = rf"\b{re.escape(phrase)}\b" if phrase[0].isalpha() else re.escape(phrase)
        assert not re.search(pattern, text), phrase


@pytest.mark.parametrize("path", texts(), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_data_and_forces_do_not_speak(path: Path) -> None:
    found = SPEAKING.search(sentences(path))
    assert found is None, found.group()


DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@pytest.mark.parametrize("path", texts(), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_no_questions_in_place_of_names(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, DOCUMENTED)]
        docstrings = [ast.get_docstring(node) or "" for node in nodes]
        assert not [doc for doc in docstrings if re.match(r"(What|Where|How|Why|Which|Who)\b", doc)]
    elif path in PAGES:
        assert not re.search(r"\b(whose|of which)\b", " ".join(seen(path)))


WORDS = 20_000
"""Words that a reader of the site sees: prose, tables and code, without API reference and messages."""

UNSEEN = re.compile(r"remove-cell|remove-input|^```\{toctree\}")
"""Blocks that the built page does not show."""


def seen(page: Path) -> list[str]:
    """The words of a page and of the files that it includes, without markup and addresses."""
    text = page.read_text(encoding="utf-8")
    text = re.sub(r"\A---.*?^---$", "", text, flags=re.S | re.M)
    included = [
        word
        for name in re.findall(r"^```\{include\} (\S+)$", text, re.M)
        for word in seen(page.parent / name)
    ]
    text = re.sub(
        r"^```.*?^```$", lambda block: "" if UNSEEN.search(block[0]) else block[0], text, flags=re.S | re.M
    )
    text = re.sub(r"\]\([^)]*\)|^```\{.*$|^:(?:tags|mystnb):.*$", " ", text, flags=re.M)
    return included + [word for word in text.split() if re.search(r"\w", word)]


def test_the_site_and_the_readme_stay_short() -> None:
    pages = [page for page in PAGES if page.parent.name != "reference"]
    assert sum(len(seen(page)) for page in pages) <= WORDS
    assert len((DOCS.parent / "README.md").read_text(encoding="utf-8").split()) <= 700


def test_pages_do_not_edit_files_by_patterns() -> None:
    for page in PAGES:
        assert "sed -i" not in page.read_text(encoding="utf-8"), page


def test_the_version_is_the_same_everywhere() -> None:
    root = DOCS.parent
    version = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert forcegp.__version__ == version
    assert f"\n## [{version}] - " in (root / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text(encoding="utf-8")
    for page in (root / "README.md", DOCS / "index.md"):
        assert set(re.findall(r"forcegp-([\d.]+)-py3", page.read_text(encoding="utf-8"))) == {version}, page


def test_messages_of_troubleshooting_exist() -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in (DOCS.parent / "src").rglob("*.py"))
    sources = " ".join(re.sub(r'"\n\s+f?"', "", sources).split())
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| `([^`]*)` \|", page[: page.index("## Results that look wrong")], flags=re.M)
    assert len(named) == 19
    for message in named:
        for part in message.split("…"):
            assert part.strip(" '") in sources, message
