"""The public names of the package."""

from __future__ import annotations

import ast
import re
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


CPU_SECONDS = {"import forcegp": 0.3, "from forcegp.cli import main; main()": 0.5}
"""What a user waits for at most; processor time, as other programs may run."""


@pytest.mark.parametrize("code", CPU_SECONDS)
def test_import_and_help_are_fast(code: str) -> None:
    measured = (
        "import sys, time, atexit; sys.argv = ['forcegp', '--help']; "
        f"atexit.register(lambda: print(time.process_time(), file=sys.stderr)); {code}"
    )
    runs = [
        subprocess.run([sys.executable, "-c", measured], capture_output=True, text=True) for _ in range(3)
    ]
    assert min(float(run.stderr.split()[-1]) for run in runs) < CPU_SECONDS[code]


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
