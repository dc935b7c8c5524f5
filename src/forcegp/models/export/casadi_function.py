"""The posterior mean of a fit as a CasADi function, with exact derivatives of any order."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from typing import Any

import torch

from forcegp.compiled.expression import UNARY, Scalar
from forcegp.errors import MissingDependencyError
from forcegp.gp import kernels
from forcegp.gp.basis import KernelPart
from forcegp.gp.features import stacked
from forcegp.models.export.mean import ARGUMENTS, DIFFERENTIATED, LearnedMotion
from forcegp.models.export.model import ExportedModel, Functions, row_of

OPERATORS = {
    "neg": operator.neg,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
}
AT_REST = 1e-30
"""Added to a squared distance whose root is taken, so that the root has a slope at a support point."""

PROFILES = {
    kernels.SquaredExponential: lambda ca, u: ca.exp(-0.5 * u),
    kernels.Matern32: lambda ca, u: _matern(ca, 3.0 * u, 0.0),
    kernels.Matern52: lambda ca, u: _matern(ca, 5.0 * u, 1.0 / 3.0),
}
"""Stationary kernels by the square of the distance."""


def _matern(ca: Any, square: Any, more: float) -> Any:
    """(1 + r + more r²) e^{−r}."""
    r = ca.sqrt(square + AT_REST)
    return (1.0 + r + more * square) * ca.exp(-r)


def casadi_function(model: ExportedModel, name: str = "forcegp") -> Any:
    """A `casadi.Function` from (q, q̇, τ, closed) to the mean of each of `DIFFERENTIATED`.

    `closed` has a 1 for each contact that is closed, and a 0 for one that is open. The closed contacts must be
    independent of each other.

    Raises:
        ModelError: a part of the model has no such form; names it.
        MissingDependencyError: CasADi is not installed.
    """
    try:
        import casadi
    except ImportError as cause:
        raise MissingDependencyError(
            "a CasADi function needs the package casadi", hint="pip install 'forcegp[casadi]'"
        ) from cause
    ca: Any = casadi
    model.check()
    parts, nq, contacts = model.parts(), model.system.robot.nq, len(model.system.contacts)
    mean = LearnedMotion(model, parts, differentiate=False)
    values, supported = mean.quantities(), [p for p, part in enumerate(parts) if part.size]
    sizes = dict(
        zip(
            (*ARGUMENTS, "f"),
            (nq, nq, nq, contacts, sum(parts[p].components for p in supported)),
            strict=True,
        )
    )
    given = {x: ca.SX.sym(x, n) for x, n in sizes.items()}
    state = [given[x] for x in ARGUMENTS]
    results = [_vector(ca, mean, given, values[x].flat) for x in DIFFERENTIATED]
    names = list(ARGUMENTS), list(DIFFERENTIATED)
    if not supported:
        return ca.Function(name, state, results, *names)
    motion = ca.Function("motion", [*state, given["f"]], results)
    inputs = ca.Function(
        "inputs", state, [_vector(ca, mean, given, row) for p in supported for row in mean.x[p]]
    )
    # The functions with support points are written as matrices; as scalars, their Jacobian is faster.
    state = [ca.MX.sym(x, sizes[x]) for x in ARGUMENTS]
    x, f = iter(inputs.call(state)), []
    for p in supported:
        part, rows, known = parts[p], [next(x) for _ in mean.x[p]], dict[tuple, Any]()
        assert part.rest is not None
        for k in range(part.components):
            covariances = _covariances(ca, part, part.rest, k, rows[k if len(rows) > 1 else 0], known)
            f.append(covariances @ ca.DM(part.weights[k, : part.size].numpy()))
    whole = ca.Function(name, state, motion.call([*state, ca.vertcat(*f)]), *names)
    return whole.expand()


def _vector(ca: Any, mean: LearnedMotion, given: Mapping[str, Any], outputs: Iterable[Scalar]) -> Any:
    """Scalars as one CasADi vector."""
    nodes, outputs = mean.graph.nodes, list(outputs)
    values: dict[int, Any] = {}
    for position in mean.graph.live(outputs):
        op, left, right = nodes[position]
        if op == "const":
            values[position] = ca.SX(left)
        elif op == "input":
            values[position] = (
                getattr(ca, left)(given["q"][right]) if left in ("sin", "cos") else given[left][right]
            )
        elif op == "step":
            values[position] = values[left] > 0.0
        elif op in UNARY:
            values[position] = getattr(ca, op)(values[left])
        else:
            values[position] = OPERATORS[op](*(values[x] for x in (left, right) if x is not None))
    return ca.vertcat(*(values[x.position] for x in outputs)) if outputs else ca.SX(0, 1)


def _covariances(ca: Any, part: Functions, rest: KernelPart, k: int, x: Any, known: dict) -> Any:
    """k(x, z_j) of component k, `(1, m)`, or a number."""
    kernel, params = rest.kernel, rest.params
    if isinstance(kernel, kernels.Sum):
        a, b = (_covariances(ca, part, KernelPart(*side), k, x, known) for side in kernel.parts(params))
        return a * b if isinstance(kernel, kernels.Product) else a + b
    if isinstance(kernel, kernels.Constant):
        return float(row_of(kernel.std(params), k).square())
    linear, z = isinstance(kernel, kernels.Linear), stacked(part.support, kernel.inputs)
    scale = row_of(kernel.slope_std(params) if linear else torch.exp(-params["log_lengthscale"]), k)
    Z, columns = (z if z.ndim == 2 else z[k]) * scale, part.columns(kernel.inputs)
    scaled = x[columns].T * ca.DM(scale.expand(len(columns)).tolist()).T
    if linear:
        return scaled @ ca.DM(Z.T.numpy()) + float(row_of(kernel.bias_std(params), k).square())
    key = (id(x), *Z.flatten().tolist())
    if key not in known:
        apart = ca.repmat(scaled, len(Z), 1) - ca.DM(Z.numpy())
        known[key] = PROFILES[type(kernel)](ca, ca.sum2(apart * apart).T)
    return known[key] * float(row_of((2.0 * params["log_std"]).exp(), k))
