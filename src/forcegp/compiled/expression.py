"""Scalar expressions that fold constants and share equal subexpressions as they are built.

Scalars can be stored in NumPy object arrays. Code written for arrays of numbers therefore also runs on arrays
of `Scalar`, where it records a straight-line program.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass, field

import numpy as np

from forcegp.errors import ModelError

Node = tuple[str, object, object]
"""Operation and operands: ("const", value, None), ("input", name, index), or (op, left, right) positions."""
UNARY = ("exp", "log", "tanh", "sqrt", "sin", "cos", "step")
"""Functions of one operand. `step` is 1 for positive operands and 0 otherwise."""
Tangents = dict[int, "Scalar"]
"""Derivatives of a scalar, keyed by direction. Missing derivatives are zero."""


@dataclass
class Graph:
    """Nodes of a program without duplicates. Each node is placed after its operands."""

    nodes: list[Node] = field(default_factory=list)
    _positions: dict[Node, int] = field(default_factory=dict)

    def scalar(self, node: Node) -> Scalar:
        """Return the scalar that a node computes, reusing an equal node if there is one."""
        position = self._positions.setdefault(node, len(self.nodes))
        if position == len(self.nodes):
            self.nodes.append(node)
        return Scalar(self, position)

    def constant(self, value: float) -> Scalar:
        """Return a constant scalar."""
        # −0.0 and 0.0 share a key, since the sign of zero never matters here.
        return self.scalar(("const", float(value) + 0.0, None))

    def constants(self, values: object) -> np.ndarray:
        """Return an array of constant scalars."""
        array = np.asarray(values, dtype=float)
        return np.array([self.constant(x) for x in array.flat], dtype=object).reshape(array.shape)

    def input(self, name: str, index: int) -> Scalar:
        """Return an entry of an argument of the program."""
        return self.scalar(("input", name, index))

    def live(self, outputs: list[Scalar], known: Container[int] = ()) -> list[int]:
        """Return the nodes on which the outputs depend, in order of computation, stopping at known nodes."""
        needed, open_ = set(), [x.position for x in outputs]
        while open_:
            position = open_.pop()
            if position not in needed:
                needed.add(position)
                op, left, right = self.nodes[position]
                if op not in ("const", "input") and position not in known:
                    open_ += [x for x in (left, right) if isinstance(x, int)]
        return sorted(needed)

    def tangents(self, outputs: list[Scalar], seeds: dict[int, Tangents]) -> list[Tangents]:
        """Return the derivatives of the outputs by forward mode, given those of `seeds`, keyed by position.

        A seed need not be an input. For example, the solution of an equation can be seeded with its
        derivative. A scalar without directions is treated as a constant.
        """
        tangents = dict(seeds)
        for position in self.live(outputs, seeds):
            if position not in seeds:
                tangents[position] = self._tangents(position, tangents)
        return [tangents[x.position] for x in outputs]

    def _tangents(self, position: int, tangents: dict[int, Tangents]) -> Tangents:
        """Return the derivatives of one node, given those of its operands."""
        op, i, j = self.nodes[position]
        if op in ("const", "input", "step"):
            return {}
        value, a, by_a = Scalar(self, position), Scalar(self, i), tangents[i]  # pyright: ignore
        if j is None:
            factors = {"neg": lambda: self.constant(-1.0), "exp": lambda: value}
            factors |= {"tanh": lambda: 1.0 - value * value, "sqrt": lambda: 0.5 / value}
            factors |= {"sin": lambda: a.cos(), "cos": lambda: -a.sin(), "log": lambda: 1.0 / a}
            factor = factors[op]()
            return {d: t * factor for d, t in by_a.items()}
        b, by_b = Scalar(self, j), tangents[j]  # pyright: ignore
        one, by_left, by_right = self.constant(1.0), b, a
        if op in "+-":
            by_left, by_right = one, one if op == "+" else -one
        elif op == "/":
            by_left, by_right = one / b, -(value / b)
        total = {d: t * by_left for d, t in by_a.items()}
        for d, t in by_b.items():
            total[d] = total[d] + t * by_right if d in total else t * by_right
        return total


@dataclass(frozen=True, slots=True, eq=False)
class Scalar:
    """A number in a program, represented by its position in the graph, with arithmetic operations."""

    graph: Graph
    position: int

    @property
    def value(self) -> float | None:
        """Value of the scalar if it is a constant, otherwise `None`."""
        op, value, _ = self.graph.nodes[self.position]
        return value if op == "const" else None  # pyright: ignore[reportReturnType]

    @property
    def negated(self) -> Scalar | None:
        """x if the scalar is −x, otherwise `None`."""
        op, operand, _ = self.graph.nodes[self.position]
        return Scalar(self.graph, operand) if op == "neg" else None  # pyright: ignore[reportArgumentType]

    def _lift(self, other: Scalar | float) -> Scalar:
        return other if isinstance(other, Scalar) else self.graph.constant(other)

    def _node(self, op: str, other: Scalar) -> Scalar:
        return self.graph.scalar((op, self.position, other.position))

    def exp(self) -> Scalar:
        """Return the exponential."""
        return self._function("exp")

    def log(self) -> Scalar:
        """Return the natural logarithm."""
        return self._function("log")

    def __abs__(self) -> Scalar:
        return self * (2.0 * self.step() - 1.0)

    def tanh(self) -> Scalar:
        """Return the hyperbolic tangent."""
        return self._function("tanh")

    def sqrt(self) -> Scalar:
        """Return the square root."""
        return self._function("sqrt")

    def sin(self) -> Scalar:
        """Return the sine."""
        return self._function("sin")

    def cos(self) -> Scalar:
        """Return the cosine."""
        return self._function("cos")

    def step(self) -> Scalar:
        """Return 1 if the scalar is positive and 0 otherwise."""
        return self._function("step")

    def _function(self, name: str) -> Scalar:
        if self.value is not None:
            step = float(self.value > 0.0)
            return self.graph.constant(step if name == "step" else getattr(math, name)(self.value))
        return self.graph.scalar((name, self.position, None))

    def __neg__(self) -> Scalar:
        if self.value is not None:
            return self.graph.constant(-self.value)
        return self.negated or self.graph.scalar(("neg", self.position, None))

    def __add__(self, other: Scalar | float) -> Scalar:
        a, b = self, self._lift(other)
        if a.value is not None and b.value is not None:
            return a.graph.constant(a.value + b.value)
        if a.value == 0.0 or b.value == 0.0:
            return b if a.value == 0.0 else a
        if b.negated is not None:
            return a - b.negated
        if a.negated is not None:
            return b - a.negated
        return a._node("+", b) if a.position <= b.position else b._node("+", a)

    def __sub__(self, other: Scalar | float) -> Scalar:
        a, b = self, self._lift(other)
        if a.value is not None and b.value is not None:
            return a.graph.constant(a.value - b.value)
        if a.position == b.position:
            return a.graph.constant(0.0)
        if a.value == 0.0 or b.value == 0.0:
            return -b if a.value == 0.0 else a
        if b.negated is not None:
            return a + b.negated
        return a._node("-", b)

    def __mul__(self, other: Scalar | float) -> Scalar:
        a, b = self, self._lift(other)
        if a.value is not None and b.value is not None:
            return a.graph.constant(a.value * b.value)
        for x, y in ((a, b), (b, a)):
            if x.value in (0.0, 1.0):
                return y if x.value == 1.0 else x
            if x.value is not None and x.value < 0.0:
                return -(y * -x.value)
            if x.negated is not None:
                return -(x.negated * y)
        return a._node("*", b) if a.position <= b.position else b._node("*", a)

    def __truediv__(self, other: Scalar | float) -> Scalar:
        a, b = self, self._lift(other)
        if a.value is not None and b.value is not None:
            return a.graph.constant(a.value / b.value)
        return a if a.value == 0.0 else a._node("/", b)

    def __pow__(self, exponent: float) -> Scalar:
        """Return a power with an integer exponent, as a product."""
        if not float(exponent).is_integer():
            text, hint = "a power has no form in C and CasADi", "use products, or exp and log"
            raise ModelError(text, expected="an integer exponent", got=exponent, hint=hint)
        whole = math.prod([self] * abs(int(exponent)), start=self.graph.constant(1.0))
        return whole if exponent >= 0 else 1.0 / whole

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other: float) -> Scalar:
        return self._lift(other) - self

    def __rtruediv__(self, other: float) -> Scalar:
        return self._lift(other) / self
