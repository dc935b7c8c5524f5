"""The dynamics of one robot written out on scalars: the algorithms of `forcegp.dynamics`, link by link.

World axes about the base origin, as there. The robot's figures are numbers, so products with the zeros
and ones of joint axes and placements vanish while the program is built.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from forcegp.compiled.expression import Graph, Scalar
from forcegp.robot.model import BASE, RobotModel


@dataclass(frozen=True)
class Program:
    """A straight-line program: its graph and the entries of its result, in row-major order.

    Attributes:
        arguments: names of the joint-space arguments, in the order of the eager function.
        shape: shape of the result without the batch.
    """

    arguments: tuple[str, ...]
    shape: tuple[int, ...]
    graph: Graph
    outputs: list[Scalar]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class _Links:
    """Poses, screws and inertias of all links as scalars."""

    def __init__(self, robot: RobotModel) -> None:
        self.graph = graph = Graph()
        self.parents = robot.parents
        self.gravity, self.armature = graph.constants(_numbers(robot.gravity)), _numbers(robot.armature)
        self.mass = _numbers(robot.mass)
        self.R, self.p, self.z, self.l, self.c, self.I = [], [], [], [], [], []
        for i, parent in enumerate(robot.parents):
            R, p = (
                (graph.constants(_numbers(robot.base_rotation)), graph.constants(np.zeros(3)))
                if parent == BASE
                else (self.R[parent], self.p[parent])
            )
            turn, shift = self._joint(robot, i)
            self.R.append(R @ turn)
            self.p.append(p + R @ shift)
            axis = self.R[i] @ graph.constants(_numbers(robot.axis[i]))
            revolute = robot.joint_types[i] == "revolute"
            self.z.append(axis if revolute else graph.constants(np.zeros(3)))
            self.l.append(_cross(self.p[i], axis) if revolute else axis)
            self.c.append(self.p[i] + self.R[i] @ graph.constants(_numbers(robot.com[i])))
            self.I.append(_congruent(self.R[i], graph.constants(_numbers(robot.inertia[i]))))

    def _joint(self, robot: RobotModel, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Pose of a link in its parent link (Rodrigues' formula about a constant axis)."""
        graph, a = self.graph, _numbers(robot.axis[i])
        P, shift = _numbers(robot.placement_rotation[i]), graph.constants(_numbers(robot.placement_position[i]))
        if robot.joint_types[i] == "prismatic":
            return graph.constants(P), shift + graph.constants(P @ a) * graph.input("q", i)
        along = np.outer(P @ a, a)
        turn = graph.constants(along) + graph.constants(P @ _skew(a)) * graph.input("sin", i)
        return turn + graph.constants(P - along) * graph.input("cos", i), shift

    def vector(self, name: str) -> list[Scalar]:
        return [self.graph.input(name, i) for i in range(len(self.parents))]

    def ancestors(self, i: int) -> list[int]:
        """The joints that move link i, itself first."""
        chain = [i]
        while self.parents[chain[-1]] != BASE:
            chain.append(self.parents[chain[-1]])
        return chain


def _numbers(x) -> np.ndarray:
    return x.detach().cpu().double().numpy()


def _congruent(R: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """R I Rᵀ with its six different entries computed once."""
    turned = R @ inertia
    upper = {(r, c): turned[r] @ R[c] for r in range(3) for c in range(r, 3)}
    return np.array([[upper[min(r, c), max(r, c)] for c in range(3)] for r in range(3)], dtype=object)


def _mass_matrix(links: _Links) -> np.ndarray:
    """M_ij = s_iᵀ I^c_j s_j with the composite inertias about the base origin (CRBA)."""
    n, graph = len(links.parents), links.graph
    M = graph.constants(np.zeros((n, n)))
    mass = list(links.mass)
    moment = [links.c[i] * mass[i] for i in range(n)]
    inertia = []
    for i in range(n):
        c, h = links.c[i], moment[i]
        diagonal = [c[1] * h[1] + c[2] * h[2], c[0] * h[0] + c[2] * h[2], c[0] * h[0] + c[1] * h[1]]
        shift = [[diagonal[r] if r == s else -(c[min(r, s)] * h[max(r, s)]) for s in range(3)] for r in range(3)]
        inertia.append(links.I[i] + np.array(shift, dtype=object))
    for j in reversed(range(n)):
        parent, z, l = links.parents[j], links.z[j], links.l[j]
        angular = inertia[j] @ z + _cross(moment[j], l)
        linear = l * mass[j] - _cross(moment[j], z)
        for i in links.ancestors(j):
            M[i, j] = M[j, i] = links.z[i] @ angular + links.l[i] @ linear
        M[j, j] = M[j, j] + links.armature[j]
        if parent != BASE:
            mass[parent] += mass[j]
            moment[parent] = moment[parent] + moment[j]
            inertia[parent] = inertia[parent] + inertia[j]
    return M


def _joint_force(links: _Links, qd: list | None, qdd: list | None, gravity: bool) -> np.ndarray:
    """M q̈ − Q_C − Q_G, each term where its argument is given (recursive Newton-Euler)."""
    n, zero = len(links.parents), links.graph.constants(np.zeros(3))
    rest = (zero, zero, zero, -links.gravity if gravity else zero)
    motion, forces = [], []
    for i, parent in enumerate(links.parents):
        omega, v, alpha, a = rest if parent == BASE else motion[parent]
        z, l, c, I = links.z[i], links.l[i], links.c[i], links.I[i]
        if qd is not None:
            omega, v = omega + z * qd[i], v + l * qd[i]
            alpha = alpha + _cross(omega, z) * qd[i]
            a = a + (_cross(omega, l) + _cross(v, z)) * qd[i]
        if qdd is not None:
            alpha, a = alpha + z * qdd[i], a + l * qdd[i]
        motion.append((omega, v, alpha, a))
        force = (a + _cross(alpha, c) + _cross(omega, v + _cross(omega, c))) * links.mass[i]
        forces.append((I @ alpha + _cross(omega, I @ omega) + _cross(c, force), force))
    result = links.graph.constants(np.zeros(n))
    for i in reversed(range(n)):
        torque, force = forces[i]
        result[i] = links.z[i] @ torque + links.l[i] @ force
        if qdd is not None:
            result[i] = result[i] + qdd[i] * links.armature[i]
        if (parent := links.parents[i]) != BASE:
            forces[parent] = (forces[parent][0] + torque, forces[parent][1] + force)
    return result


def _solve(M: np.ndarray, rhs: np.ndarray) -> list[Scalar]:
    """M⁻¹ rhs, eliminated from the leaves so that the zeros of branched trees stay (Featherstone, §6.5)."""
    M, x, n = M.copy(), rhs.copy(), len(rhs)
    inverse = [M[0, 0]] * n
    for k in reversed(range(n)):
        inverse[k] = 1.0 / M[k, k]
        for i in range(k):
            factor = M[k, i] * inverse[k]
            x[i] = x[i] - factor * x[k]
            for j in range(i + 1):
                M[i, j] = M[i, j] - factor * M[k, j]
    for k in range(n):
        x[k] = (x[k] - M[k, :k] @ x[:k]) * inverse[k] if k else x[k] * inverse[k]
    return list(x)


def _forward_dynamics(links: _Links) -> np.ndarray:
    needed = _joint_force(links, links.vector("qd"), None, gravity=True)
    return np.array(_solve(_mass_matrix(links), np.array(links.vector("force")) - needed))


QUANTITIES: dict[str, tuple[tuple[str, ...], Callable[[_Links], np.ndarray]]] = {
    "forward_dynamics": (("q", "qd", "force"), _forward_dynamics),
    "inverse_dynamics": (
        ("q", "qd", "qdd"),
        lambda links: _joint_force(links, links.vector("qd"), links.vector("qdd"), gravity=True),
    ),
    "mass_matrix": (("q",), _mass_matrix),
    "bias_force": (("q", "qd"), lambda links: -_joint_force(links, links.vector("qd"), None, gravity=False)),
    "gravity_force": (("q",), lambda links: -_joint_force(links, None, None, gravity=True)),
}
"""Arguments and algorithm of each quantity that can be compiled; the names are those of `forcegp.dynamics`."""


def trace(robot: RobotModel, quantity: str) -> Program:
    """The program of one quantity of `QUANTITIES` for one robot."""
    arguments, algorithm = QUANTITIES[quantity]
    links = _Links(robot)
    result = algorithm(links)
    return Program(arguments, result.shape, links.graph, list(result.flat))
