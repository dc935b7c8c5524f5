"""The public names of the package."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import forcegp


def test_every_public_name_is_there_and_declared_for_type_checkers() -> None:
    assert set(forcegp._HOME) == set(forcegp.__all__) == set(dir(forcegp))
    for name in forcegp.__all__:
        assert getattr(forcegp, name) is not None
    tree = ast.parse(Path(str(forcegp.__file__)).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    declared = {
        alias.asname or alias.name
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert declared == set(forcegp.__all__)


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Datasett'"):
        _ = forcegp.Datasett  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("module", ["forcegp", "forcegp.cli"])
def test_heavy_packages_are_not_imported_before_they_are_used(module: str) -> None:
    heavy = "{'torch', 'matplotlib', 'mujoco', 'pyarrow', 'scipy'}"
    code = f"import sys, {module}; print(*sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
