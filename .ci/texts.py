"""Check the texts of the project: pages, docstrings and messages.

    python .ci/texts.py

Each check yields what is wrong, as `file: what`; the command prints it and fails if there is any.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import forcegp

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
OTHERS = [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
SOURCES = sorted(path for folder in ("src", "examples") for path in (ROOT / folder).rglob("*.py"))

EXECUTED = "{code-cell} python"
DIRECTIVES = ("{toctree}", "{include}", "{eval-rst}")
INSTALLED = tuple(f"$ {command}" for command in ("pip install", "make ", "python benchmarks/", "python -W"))
"""Commands that cannot run while the site is built: they install, take hours, or need several machines."""
WORDS = {"the site": 16_000, "README.md": 700}
"""Words that a reader sees: prose, tables and code, without API reference and messages."""
UNSEEN = re.compile(r"remove-cell|remove-input|^```\{toctree\}")
"""Blocks that the built page does not show."""
SUBJECTS = "data|logs?|forces?|samples?|accelerations?|torques?|rows?|files?|models?|stretches|evidence"
SPEAKING = re.compile(rf"\b({SUBJECTS})( \w+)? (shows?|knows?|tells?|says?|asks?|sees?|wants?)\b", flags=re.I)
"""Data and forces that speak, know or see."""
QUESTION = re.compile(r"(What|Where|How|Why|Which|Who)\b")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@cache
def text(path: Path) -> str:
    """Return the content of a file."""
    return path.read_text(encoding="utf-8")


@cache
def tree(path: Path) -> ast.Module:
    """Return the syntax tree of a source."""
    return ast.parse(text(path))


def code_of_pages_is_executed() -> Iterator[str]:
    """Yield blocks of code that no build of the site runs."""
    for page in PAGES:
        blocks = re.findall(r"^```+([^\n`]*)\n(.*?)^```+$", text(page), flags=re.S | re.M)
        executed = any(kind.startswith("{code-cell}") for kind, _ in blocks)
        if executed and not text(page).startswith("---\nfile_format: mystnb\n"):
            yield f"{page}: code cells without `file_format: mystnb` at the top"
        for kind, body in blocks:
            if kind == "console":
                yield from (f"{page}: {x}" for x in body.splitlines() if not x.startswith(INSTALLED))
            elif kind == "toml":
                tomllib.loads(body)
            elif kind not in (EXECUTED, "text") and not kind.startswith(DIRECTIVES):
                yield f"{page}: a block of {kind!r} is not executed"


def make_targets_exist() -> Iterator[str]:
    """Yield targets of `make` that are named on a page and not defined."""
    defined = set(re.findall(r"^(\w[\w-]*):", text(ROOT / "Makefile"), flags=re.M))
    for page in PAGES:
        named = re.findall(r"^\$ make ([\w-]+)", text(page), flags=re.M)
        yield from (f"{page}: no target {target!r}" for target in named if target not in defined)


def links_lead_to_files() -> Iterator[str]:
    """Yield links to files that do not exist."""
    for page in [*PAGES, *OTHERS]:
        prose = re.sub(r"^```.*?^```", "", text(page), flags=re.S | re.M)
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", prose):
            if "://" not in target and not (page.parent / target).exists():
                yield f"{page}: no file {target}"


def public_names_are_in_the_reference() -> Iterator[str]:
    """Yield public names without an entry in the reference."""
    reference = "".join(text(page) for page in (DOCS / "reference").glob("*.md"))
    names = {name: getattr(forcegp, name) for name in forcegp.__all__}
    for name in [*names, *(f"priors.{name}" for name in forcegp.priors.__all__)]:
        module = isinstance(names.get(name), ModuleType)
        directive, end = (r"auto\w+", r"\b") if module else ("auto(?:class|function)", "$")
        if not re.search(rf"^\.\. {directive}:: forcegp\.{name}{end}", reference, flags=re.M):
            yield f"docs/reference: no entry for forcegp.{name}"


def data_and_forces_do_not_speak() -> Iterator[str]:
    """Yield sentences in which data or forces speak, know or see."""
    for path in [*PAGES, *OTHERS, *SOURCES]:
        words = text(path)
        if path.suffix == ".py":
            values = [node.value for node in ast.walk(tree(path)) if isinstance(node, ast.Constant)]
            words = " | ".join(value for value in values if isinstance(value, str))
        yield from (f"{path}: {found[0]}" for found in SPEAKING.finditer(" ".join(words.split())))


def names_are_no_questions() -> Iterator[str]:
    """Yield docstrings that are questions, and pages with relative clauses on `whose` or `of which`."""
    for path in SOURCES:
        docstrings = (ast.get_docstring(x) or "" for x in ast.walk(tree(path)) if isinstance(x, DOCUMENTED))
        yield from (f"{path}: {doc.splitlines()[0]}" for doc in docstrings if QUESTION.match(doc))
    for page in PAGES:
        found = re.findall(r"\b(?:whose|of which)\b", " ".join(seen(page)))
        yield from (f"{page}: {word!r}" for word in found)


def seen(page: Path) -> list[str]:
    """Return the words of a page and of the files that it includes, without markup and addresses."""
    shown = re.sub(r"\A---.*?^---$", "", text(page), flags=re.S | re.M)
    files = re.findall(r"^```\{include\} (\S+)$", shown, re.M)
    included = [word for name in files for word in seen((page.parent / name).resolve())]
    shown = re.sub(r"^```.*?^```$", lambda x: "" if UNSEEN.search(x[0]) else x[0], shown, flags=re.S | re.M)
    shown = re.sub(r"\]\([^)]*\)|^```\{.*$|^:(?:tags|mystnb):.*$", " ", shown, flags=re.M)
    return included + [word for word in shown.split() if re.search(r"\w", word)]


def texts_are_short() -> Iterator[str]:
    """Yield texts that have more words than a reader has patience for."""
    site = sum(len(seen(page)) for page in PAGES if page.parent.name != "reference")
    counts = {"the site": site, "README.md": len(text(ROOT / "README.md").split())}
    yield from (f"{name}: {n} words of {WORDS[name]}" for name, n in counts.items() if n > WORDS[name])


def the_version_is_the_same_everywhere() -> Iterator[str]:
    """Yield files with another version than `pyproject.toml`."""
    version = tomllib.loads(text(ROOT / "pyproject.toml"))["project"]["version"]
    if forcegp.__version__ != version:
        yield f"src/forcegp/__init__.py: {forcegp.__version__} for {version}"
    lines = {"CHANGELOG.md": f"\n## [{version}] - ", "CITATION.cff": f"\nversion: {version}\n"}
    yield from (f"{name}: not of {version}" for name, line in lines.items() if line not in text(ROOT / name))
    for name in ("README.md", "docs/index.md"):
        if set(re.findall(r"forcegp-([\d.]+)-py3", text(ROOT / name))) != {version}:
            yield f"{name}: a wheel of another version than {version}"


def messages_of_troubleshooting_exist() -> Iterator[str]:
    """Yield messages of the page on troubleshooting that no source contains."""
    sources = "".join(map(text, SOURCES))
    sources = " ".join(re.sub(r'"\n\s+f?"', "", sources).split())
    page = text(DOCS / "troubleshooting.md")
    for message in re.findall(r"^\| `([^`]*)` \|", page[: page.index("## Results that look wrong")], re.M):
        parts = (part.strip(" '") for part in message.split("…"))
        yield from (f"docs/troubleshooting.md: no message {x!r}" for x in parts if x not in sources)


CHECKS = (
    code_of_pages_is_executed,
    make_targets_exist,
    links_lead_to_files,
    public_names_are_in_the_reference,
    data_and_forces_do_not_speak,
    names_are_no_questions,
    texts_are_short,
    the_version_is_the_same_everywhere,
    messages_of_troubleshooting_exist,
)


def main() -> int:
    """Print what is wrong and return the exit status."""
    wrong = [finding for check in CHECKS for finding in check()]
    print("\n".join(wrong) or f"{len(PAGES)} pages and {len(SOURCES)} sources: texts are in order")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
