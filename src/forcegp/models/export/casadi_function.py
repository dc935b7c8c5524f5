"""The posterior mean of a fit as a CasADi function, with exact derivatives of any order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from operator import add, mul, neg, sub, truediv
from pathlib import Path
from typing import Any

from forcegp.compiled.expression import UNARY, Graph, Scalar
from forcegp.destination import folder_or_keep
from forcegp.errors import optional_module
from forcegp.models.export.mean import ARGUMENTS, DIFFERENTIATED, LearnedMotion
from forcegp.models.export.model import ExportedModel
from forcegp.models.export.source import template

OPERATORS = {"neg": neg, "+": add, "-": sub, "*": mul, "/": truediv}


def casadi_function(model: ExportedModel, name: str = "forcegp") -> Any:
    """Return a `casadi.Function` that maps (q, q̇, τ, closed) to the means of `DIFFERENTIATED` quantities.

    `closed` is 1 for each closed contact and 0 for each open contact. Closed contacts must be independent.

    Raises:
        ModelError: a part of the model cannot be exported. The message names it.
        MissingDependencyError: CasADi is not installed.
    """
    ca: Any = optional_module("casadi", "a CasADi function")
    model.check()
    mean, nq = LearnedMotion(model, model.parts(), differentiate=False), model.system.robot.nq
    sizes = dict(zip(ARGUMENTS, (nq, nq, nq, len(model.system.contacts)), strict=True))
    inputs = {x: ca.SX.sym(x, n) for x, n in sizes.items()}
    inputs |= {"sin": ca.sin(inputs["q"]), "cos": ca.cos(inputs["q"])}
    values = mean.quantities()
    results = [_vector(ca, mean.graph, inputs, values[x].flat) for x in DIFFERENTIATED]
    names = list(ARGUMENTS), list(DIFFERENTIATED)
    return ca.Function(name, [inputs[x] for x in ARGUMENTS], results, *names)


def _vector(ca: Any, graph: Graph, inputs: Mapping[str, Any], outputs: Iterable[Scalar]) -> Any:
    """Return the output scalars as a single CasADi vector."""
    outputs, values = list(outputs), dict[int, Any]()
    functions = {"step": lambda x: x > 0.0} | OPERATORS
    functions |= {op: getattr(ca, op) for op in UNARY if op != "step"}
    for position in graph.live(outputs):
        op, left, right = graph.nodes[position]
        if op == "const":
            values[position] = ca.SX(left)
        elif op == "input":
            values[position] = inputs[left][right]  # pyright: ignore[reportArgumentType]
        else:
            values[position] = functions[op](*(values[x] for x in (left, right) if isinstance(x, int)))
    return ca.vertcat(*(values[x.position] for x in outputs)) if outputs else ca.SX(0, 1)


def write_casadi(model: ExportedModel, path: Path, name: str) -> None:
    """Write the function and a README to a folder. The errors are those of `casadi_function`."""
    function = casadi_function(model, name)
    names = {"joints": model.system.robot.joint_names, "contacts": model.system.contact_names or ("none",)}
    fields: dict[str, object] = {"name": name, "robot": model.system.robot.name}
    fields |= {key: ", ".join(x) for key, x in names.items()}

    def fill(folder: Path) -> None:
        function.save(str(folder / f"{name}.casadi"))
        (folder / "README.md").write_text(template("casadi.md.in", fields), encoding="utf-8")

    folder_or_keep(fill, path)
