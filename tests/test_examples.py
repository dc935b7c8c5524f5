"""The examples in docstrings run as they stand and print what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import forcegp

ROOT = Path(str(forcegp.__file__)).parent


def modules_with_examples() -> list[str]:
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        if ">>> " in path.read_text(encoding="utf-8"):
            parts = path.relative_to(ROOT.parent).with_suffix("").parts
            found.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return found


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_print_what_they_say(name: str) -> None:
    module = importlib.import_module(name)
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    examples = [test for test in finder.find(module, name) if test.examples]
    assert examples, "the text has an example, but no docstring holds it"
    output: list[str] = []
    for example in examples:
        runner.run(example, out=output.append)
    assert not runner.failures, "".join(output)
