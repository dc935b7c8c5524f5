"""Scalar expressions: what is folded, what is shared, and that arithmetic stays arithmetic."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forcegp.compiled.expression import UNARY, Graph, Scalar
from forcegp.errors import ModelError


def evaluate(x: Scalar, values: list[float]) -> float:
    """The number that an expression stands for."""
    done: list[float] = []
    for op, left, right in x.graph.nodes[: x.position + 1]:
        if op == "const":
            done.append(float(left))  # type: ignore[arg-type]
        elif op == "input":
            done.append(values[right])  # type: ignore[index]
        else:
            a, b = done[left], 0.0 if right is None else done[right]  # type: ignore[index]
            if op in UNARY:
                done.append(float(a > 0.0) if op == "step" else getattr(math, op)(a))
                continue
            done.append({"+": a + b, "-": a - b, "*": a * b, "neg": -a, "/": a / b if b else math.inf}[op])
    return done[x.position]


def test_zeros_ones_and_signs_vanish() -> None:
    graph = Graph()
    x, y, zero = graph.input("q", 0), graph.input("q", 1), graph.constant(0.0)
    assert (
        (x + zero).position == (zero + x).position == (x * 1.0).position == (x - 0.0).position == x.position
    )
    assert (x * zero).value == (x - x).value == 0.0
    opposite = -x
    assert (-opposite).position == x.position
    assert (x + -y).position == (x - y).position
    assert (x * -1.0).negated is not None
    assert (graph.constant(2.0) * 3.0 + 1.0).value == 7.0


def test_equal_expressions_are_one_node() -> None:
    graph = Graph()
    x, y = graph.input("q", 0), graph.input("q", 1)
    assert (x * y + x).position == (x + y * x).position
    assert (x - y).position != (y - x).position


@pytest.mark.parametrize("exponent", [-2, 0, 1, 2, 3.0])
def test_integer_powers_are_products(exponent: float) -> None:
    x = Graph().input("q", 0)
    assert evaluate(x**exponent, [1.7]) == pytest.approx(1.7**exponent, rel=1e-15)
    with pytest.raises(ModelError, match="a power has no form"):
        _ = x**0.5


def test_only_live_nodes_are_listed() -> None:
    graph = Graph()
    x, y = graph.input("q", 0), graph.input("q", 1)
    _ = x * y
    total = x + y
    assert graph.live([total]) == sorted({x.position, y.position, total.position})


numbers = st.sampled_from([0.0, 1.0, -1.0, 2.0, 0.5, -3.0])


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from("+-*"), st.integers(0, 9), st.integers(0, 9)), min_size=1),
    numbers,
    numbers,
)
def test_any_program_computes_what_numbers_compute(steps: list, a: float, b: float) -> None:
    graph = Graph()
    symbols = [graph.input("q", 0), graph.input("q", 1), *(graph.constant(c) for c in (0.0, 1.0, -2.0))]
    values = [a, b, 0.0, 1.0, -2.0]
    for op, i, j in steps:
        i, j = i % len(symbols), j % len(symbols)
        symbols.append(
            {"+": lambda p, q: p + q, "-": lambda p, q: p - q, "*": lambda p, q: p * q}[op](
                symbols[i], symbols[j]
            )
        )
        values.append(
            {"+": values[i] + values[j], "-": values[i] - values[j], "*": values[i] * values[j]}[op]
        )
        if abs(values[-1]) > 1e12:  # keep sums exact
            return
    assert evaluate(symbols[-1], [a, b]) == values[-1]


def test_object_arrays_multiply() -> None:
    graph = Graph()
    A, x = graph.constants(np.eye(3)), np.array([graph.input("q", i) for i in range(3)], dtype=object)
    assert [(a).position for a in A @ x] == [b.position for b in x]


def test_tangents_are_derivatives() -> None:
    graph, at = Graph(), [0.7, -0.4, 1.3]
    x, y, z = (graph.input("q", i) for i in range(3))
    inner = (x * y - z).tanh()
    whole = (inner * x + (-y).exp() / (z * z + 1.0).sqrt() - x.step() * y) / (2.0 - y) - -z
    whole = whole + (x * 3.0).sin() * (y * z).cos() + abs(x - y) * (1.0 + x * x).log()
    one = graph.constant(1.0)
    seeds = {entry.position: {i: one} for i, entry in enumerate((x, y, z))}
    (rates,) = graph.tangents([whole], seeds)
    for i, rate in rates.items():
        pair = [[v + sign * 1e-6 * (i == k) for k, v in enumerate(at)] for sign in (1.0, -1.0)]
        slope = (evaluate(whole, pair[0]) - evaluate(whole, pair[1])) / 2e-6
        assert abs(evaluate(rate, at) - slope) < 1e-8
    assert sorted(rates) == [0, 1, 2]
    # A seed behind which nothing is looked at, and a constant
    assert graph.tangents([inner * inner], {inner.position: {}}) == [{}]
    (given,) = graph.tangents([inner * x], {inner.position: {5: one}, x.position: {}})
    assert {d: t.position for d, t in given.items()} == {5: x.position}
    assert (graph.constant(4.0).sqrt().value, graph.constant(-1.0).step().value) == (2.0, 0.0)
