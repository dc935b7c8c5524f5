"""Imports run one way, without cycles; what is public is documented and typed."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import forcegp

ROOT = Path(forcegp.__file__).parent

LAYERS = (
    (
        "limits",
        "errors",
        "types",
        "guards",
        "files",
        "destination",
        "resources",
        "robust",
        "rows",
        "batchlast",
        "native",
        "notebook",
        "interrupt",
        "cluster",
    ),
    ("plots",),
    ("robot",),
    ("kinematics", "dynamics"),
    ("compiled", "derivatives", "identification"),
    ("constraints",),
    ("data",),
    ("gp", "options"),
    ("forces",),
    ("learning",),
    ("storage",),
    ("control",),
    ("simulate",),
    ("scene",),
    ("logs", "checks"),
    ("rollout",),
    ("models",),
    ("evaluation",),
    ("report", "sweep"),
    ("view",),
    ("cli",),
    ("__main__",),
)
"""From the lowest to the highest: a part imports parts of its own row and of rows above it in this list."""

RANK = {name: rank for rank, row in enumerate(LAYERS) for name in row}


@cache
def modules() -> dict[str, Path]:
    """Every module but the package itself, whose names are loaded when they are first used."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name:
            found[name] = path
    return found


def imports(path: Path) -> set[str]:
    """Modules of the library that a module imports, by their name in the library.

    Imports within functions and under `TYPE_CHECKING` count too: a circle that is hidden is still a circle.
    """
    known, found = modules(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            package, _, base = (node.module or "").partition(".")
            if package == "forcegp":
                full = [f"{base}.{alias.name}".strip(".") for alias in node.names]
                found.update(name if name in known else base for name in full)
        elif isinstance(node, ast.Import):
            own = [alias.name for alias in node.names if alias.name.startswith("forcegp.")]
            found.update(name.partition(".")[2] for name in own)
    return found - {""}


@pytest.mark.parametrize("name", modules())
def test_a_module_imports_only_lower_layers(name: str) -> None:
    part = name.split(".")[0]
    assert part in RANK, f"{part!r} has no place in the order of layers"
    for other in imports(modules()[name]):
        assert RANK[other.split(".")[0]] <= RANK[part], f"{name} imports {other}, which is a higher layer"


def test_no_cycles() -> None:
    graph = {name: imports(path) - {name} for name, path in modules().items()}
    assert sum(map(len, graph.values())) > 200, "the imports were found"
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail("circle of imports: " + " → ".join(error.args[1][::-1]))


def test_hidden_imports_are_found(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from forcegp.data import Dataset\n"
        "def late():\n    import forcegp.robot.tree\n    from forcegp.robot import model\n"
    )
    assert imports(path) == {"data", "robot.tree", "robot.model"}


def test_the_study_is_not_part_of_the_library_and_uses_the_exports_of_the_report() -> None:
    study = Path(__file__).parents[1] / "reproduction"
    used: set[str] = set()
    for path in study.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("forcegp.report"):
                assert node.module == "forcegp.report", f"{path.name} imports {node.module}"
                used.update(alias.name for alias in node.names)
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "report":
                used.add(node.attr)
    assert used == set(importlib.import_module("forcegp.report").__all__)
    for name, path in modules().items():
        assert "reproduction" not in re.findall(r"(?:from|import) (\w+)", path.read_text("utf-8")), name


def public_definitions(path: Path) -> list[ast.ClassDef | ast.FunctionDef]:
    """Public classes and functions of a module, with the public methods that classes define."""
    found: list[ast.ClassDef | ast.FunctionDef] = []
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            found.append(node)
    return found


@pytest.mark.parametrize("name", modules())
def test_public_things_have_docstrings(name: str) -> None:
    path = modules()[name]
    text = path.read_text(encoding="utf-8")
    assert not text.strip() or ast.get_docstring(ast.parse(text)), f"module {name} has no docstring"
    missing = [node.name for node in public_definitions(path) if not ast.get_docstring(node)]
    assert not missing, f"{name}: no docstring on {', '.join(missing)}"


@pytest.mark.parametrize("name", modules())
def test_public_functions_are_typed(name: str) -> None:
    for node in public_definitions(modules()[name]):
        functions = [node] if isinstance(node, ast.FunctionDef) else node.body
        for function in functions:
            if not isinstance(function, ast.FunctionDef) or (
                function.name.startswith("_") and function.name != "__init__"
            ):
                continue
            arguments = [
                a
                for a in [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
                if a.arg not in ("self", "cls")
            ]
            untyped = [a.arg for a in arguments if a.annotation is None]
            assert not untyped, f"{name}.{function.name}: no type on {', '.join(untyped)}"
            assert function.returns is not None, f"{name}.{function.name}: no return type"


def test_nothing_is_unpickled_or_evaluated() -> None:
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {a.name for a in node.names} | {getattr(node, "module", None)}
                assert not names & {"pickle", "shelve", "marshal", "joblib", "dill"}, name
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("eval", "exec", "torch.load", "torch.save"), f"{name} calls {called}"


def test_public_names_exist_and_are_documented() -> None:
    assert set(forcegp.__all__) <= set(dir(forcegp))
    for name in forcegp.__all__:
        thing = getattr(forcegp, name)
        assert inspect.getdoc(thing), f"forcegp.{name} has no docstring"
    with pytest.raises(AttributeError, match="No forcegp attribute StructuredGp"):
        forcegp.StructuredGp  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    assert importlib.import_module("forcegp.gp")
