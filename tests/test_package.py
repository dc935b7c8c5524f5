"""The public names of the package."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import forcegp


def test_every_public_name_is_there_and_declared_for_type_checkers() -> None:
    assert set(forcegp.__all__) == set(dir(forcegp))
    for name in forcegp.__all__:
        assert inspect.getdoc(getattr(forcegp, name)), f"forcegp.{name} has no docstring"
    tree = ast.parse(Path(str(forcegp.__file__)).with_suffix(".pyi").read_text())
    declared = [alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    # Without `as`, a name in a stub is not exported.
    assert sorted(alias.asname or "" for alias in declared) == sorted(forcegp.__all__)


@pytest.mark.parametrize(("name", "home"), vars(forcegp)["_MOVED"].items())
def test_a_name_that_has_moved_still_works(name: str, home: str) -> None:
    new = getattr(importlib.import_module(f"forcegp.{home}"), name)
    with pytest.warns(DeprecationWarning, match=f"now forcegp.{home}.{name}; .* removed in 0.4"):
        assert getattr(forcegp, name) is new
    assert name not in forcegp.__all__


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="No forcegp attribute Datasett"):
        _ = forcegp.Datasett  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("module", ["forcegp", "forcegp.cli"])
def test_heavy_packages_are_not_imported_before_they_are_used(module: str) -> None:
    heavy = "{'torch', 'matplotlib', 'mujoco', 'pyarrow', 'scipy'}"
    code = f"import sys, {module}; print(*sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_help_needs_no_heavy_package() -> None:
    """Its time is measured in benchmarks/startup.py."""
    heavy = "{'torch', 'matplotlib', 'mujoco', 'pyarrow', 'scipy', 'numpy'}"
    code = (
        "import atexit, sys; sys.argv = ['forcegp', '--help']\n"
        f"atexit.register(lambda: print(*sorted({heavy} & set(sys.modules)), file=sys.stderr))\n"
        "from forcegp.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "simulate" in done.stdout and done.stderr.split() == []


def test_the_package_is_typed_and_its_versions_of_python_are_tested() -> None:
    assert (Path(str(forcegp.__file__)).parent / "py.typed").is_file()
    root = Path(__file__).parents[1]
    declared = re.findall(
        r'"Programming Language :: Python :: (3\.\d+)"', (root / "pyproject.toml").read_text()
    )
    workflow = (root / ".github" / "workflows" / "ci.yml").read_text()
    matrix = re.search(r"python: \[(.*)\]", workflow)
    assert matrix is not None and re.findall(r"3\.\d+", matrix[1]) == declared
    assert "make package" in workflow and "make package" in (root / ".ci" / "run").read_text()
