"""The links of one robot on scalars: poses, joint screws and inertias in world axes about the base origin."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from forcegp.compiled.expression import Graph, Scalar
from forcegp.robot.model import BASE, RobotModel


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b of expressions."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def skew(v: np.ndarray) -> np.ndarray:
    """[v]× of expressions."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class Links:
    """Poses, screws and inertias of all links as scalars.

    Attributes:
        R, p: rotation and origin of each link.
        z, l: angular and linear part of each joint screw.
        c, mass: centre and mass of each link; moment = m c.
        I: inertia about the centre, inertia about the base origin in `inertia`.
    """

    def __init__(self, robot: RobotModel) -> None:
        self.graph = graph = Graph()
        self.parents = robot.parents
        self.gravity, self.armature = graph.constants(numbers(robot.gravity)), numbers(robot.armature)
        self.mass = numbers(robot.mass)
        self.R, self.p, self.z, self.l, self.c, self.I = [], [], [], [], [], []
        for i, parent in enumerate(robot.parents):
            R, p = (
                (graph.constants(numbers(robot.base_rotation)), graph.constants(np.zeros(3)))
                if parent == BASE
                else (self.R[parent], self.p[parent])
            )
            turn, shift = self._joint(robot, i)
            self.R.append(R @ turn)
            self.p.append(p + R @ shift)
            axis = self.R[i] @ graph.constants(numbers(robot.axis[i]))
            revolute = robot.joint_types[i] == "revolute"
            self.z.append(axis if revolute else graph.constants(np.zeros(3)))
            self.l.append(cross(self.p[i], axis) if revolute else axis)
            self.c.append(self.p[i] + self.R[i] @ graph.constants(numbers(robot.com[i])))
            self.I.append(congruent(self.R[i], graph.constants(numbers(robot.inertia[i]))))
        self.moment = [c * m for c, m in zip(self.c, self.mass, strict=True)]
        self.inertia = [I + _shift(*x) for I, *x in zip(self.I, self.c, self.moment, strict=True)]

    def _joint(self, robot: RobotModel, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Pose of a link in its parent link (Rodrigues' formula about a constant axis)."""
        graph, a = self.graph, numbers(robot.axis[i])
        P, shift = (
            numbers(robot.placement_rotation[i]),
            graph.constants(numbers(robot.placement_position[i])),
        )
        if robot.joint_types[i] == "prismatic":
            return graph.constants(P), shift + graph.constants(P @ a) * graph.input("q", i)
        along = np.outer(P @ a, a)
        turn = graph.constants(along) + graph.constants(P @ skew(a)) * graph.input("sin", i)
        return turn + graph.constants(P - along) * graph.input("cos", i), shift

    def vector(self, name: str) -> list[Scalar]:
        """A joint-space argument of the program."""
        return [self.graph.input(name, i) for i in range(len(self.parents))]

    def composite(self, values: list) -> list:
        """Sums over the subtree of each link, the link itself included."""
        total = list(values)
        for i in reversed(range(len(total))):
            if (parent := self.parents[i]) != BASE:
                total[parent] = total[parent] + total[i]
        return total

    def ancestors(self, i: int) -> list[int]:
        """The joints that move link i, itself first."""
        chain = [i]
        while self.parents[chain[-1]] != BASE:
            chain.append(self.parents[chain[-1]])
        return chain


def numbers(x: Tensor) -> np.ndarray:
    """A tensor as numbers that are folded into the expressions."""
    return x.detach().cpu().double().numpy()


def congruent(R: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """R I Rᵀ with its six different entries computed once."""
    turned = R @ inertia
    upper = {(r, c): turned[r] @ R[c] for r in range(3) for c in range(r, 3)}
    return np.array([[upper[min(r, c), max(r, c)] for c in range(3)] for r in range(3)], dtype=object)


def _shift(c: np.ndarray, h: np.ndarray) -> np.ndarray:
    """cᵀh 1 − c hᵀ with its six different entries computed once (h = m c)."""
    diagonal = [c[1] * h[1] + c[2] * h[2], c[0] * h[0] + c[2] * h[2], c[0] * h[0] + c[1] * h[1]]
    rows = [[diagonal[r] if r == s else -(c[min(r, s)] * h[max(r, s)]) for s in range(3)] for r in range(3)]
    return np.array(rows, dtype=object)
