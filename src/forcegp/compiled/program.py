"""The dynamics of a robot expanded to scalars. The algorithms are those of `forcegp.dynamics`, link by link.

The robot's parameters are numbers. Products with the zeros and ones in joint axes and placements are
therefore eliminated while the program is built. Poses, joint screws and inertias of the links are expressed
in world axes about the base origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from torch import Tensor

from forcegp.compiled.expression import Graph, Scalar
from forcegp.robot.model import BASE, RobotModel


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product a × b of two vectors of expressions."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def skew(v: np.ndarray) -> np.ndarray:
    """Return the cross-product matrix [v]× of a vector of expressions."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class Links:
    """Poses, screws and inertias of all links as scalars.

    Attributes:
        R, p: the rotation and origin of each link.
        z, l: the angular and linear parts of each joint screw.
        c, mass: the centre of mass and mass of each link. `moment` is m c.
        I: the inertia about the centre of mass. `inertia` is the inertia about the base origin.
    """

    def __init__(self, robot: RobotModel) -> None:
        self.graph = graph = Graph()
        self.parents = robot.parents
        self.gravity, self.drives = graph.constants(numbers(robot.gravity)), numbers(robot.drive_inertia)
        self.mass = numbers(robot.mass)
        self.R, self.p, self.z, self.l, self.c, self.I = [], [], [], [], [], []
        base = graph.constants(numbers(robot.base_rotation)), graph.constants(np.zeros(3))
        for i, parent in enumerate(robot.parents):
            R, p = base if parent == BASE else (self.R[parent], self.p[parent])
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
        """Return the pose of link i in its parent link by Rodrigues' formula about a constant axis."""
        graph, a, P = self.graph, numbers(robot.axis[i]), numbers(robot.placement_rotation[i])
        shift = graph.constants(numbers(robot.placement_position[i]))
        if robot.joint_types[i] == "prismatic":
            return graph.constants(P), shift + graph.constants(P @ a) * graph.input("q", i)
        along = np.outer(P @ a, a)
        turn = graph.constants(along) + graph.constants(P @ skew(a)) * graph.input("sin", i)
        return turn + graph.constants(P - along) * graph.input("cos", i), shift

    def vector(self, name: str) -> list[Scalar]:
        """Return a joint-space argument of the program."""
        return [self.graph.input(name, i) for i in range(len(self.parents))]

    def composite(self, values: list) -> list:
        """Sum the values over the subtree of each link, including the link itself."""
        total = list(values)
        for i in reversed(range(len(total))):
            if (parent := self.parents[i]) != BASE:
                total[parent] = total[parent] + total[i]
        return total

    def ancestors(self, i: int) -> list[int]:
        """Return the joints that move link i, starting with joint i."""
        chain = [i]
        while self.parents[chain[-1]] != BASE:
            chain.append(self.parents[chain[-1]])
        return chain


def numbers(x: Tensor) -> np.ndarray:
    """Convert a tensor to constant expressions."""
    return x.detach().cpu().double().numpy()


def congruent(R: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return R I Rᵀ, computing each of its six distinct entries once."""
    turned = R @ inertia
    upper = {(r, c): turned[r] @ R[c] for r in range(3) for c in range(r, 3)}
    return np.array([[upper[min(r, c), max(r, c)] for c in range(3)] for r in range(3)], dtype=object)


def _shift(c: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return cᵀh 1 − c hᵀ with h = m c, computing each of its six distinct entries once."""
    diagonal = [c[1] * h[1] + c[2] * h[2], c[0] * h[0] + c[2] * h[2], c[0] * h[0] + c[1] * h[1]]
    rows = [[diagonal[r] if r == s else -(c[min(r, s)] * h[max(r, s)]) for s in range(3)] for r in range(3)]
    return np.array(rows, dtype=object)


@dataclass(frozen=True)
class Program:
    """A straight-line program with the eager function's arguments, and with its result in row-major order."""

    arguments: tuple[str, ...]
    shape: tuple[int, ...]
    graph: Graph
    outputs: list[Scalar]


PARAMETERS = 10
"""Number of inertial parameters of a link: m, m c, and the inertia about its origin."""
_Inertia = tuple[float, np.ndarray, np.ndarray]
"""Mass, first moment and inertia about the base origin."""


class _Motion(NamedTuple):
    """Twist [ω; v] and spatial acceleration [α; a] of one link."""

    omega: np.ndarray
    v: np.ndarray
    alpha: np.ndarray
    a: np.ndarray


def _mass_matrix(links: Links) -> np.ndarray:
    """Return M_ij = s_iᵀ I^c_j s_j from composite inertias (composite rigid-body algorithm)."""
    n = len(links.parents)
    M = links.graph.constants(np.zeros((n, n)))
    for j, composite in enumerate(_composites(links)):
        angular, linear = _momentum(*composite, links.z[j], links.l[j])
        for i in links.ancestors(j):
            M[i, j] = M[j, i] = links.z[i] @ angular + links.l[i] @ linear
    for i, j in np.argwhere(links.drives):
        M[i, j] = M[i, j] + links.drives[i, j]
    return M


def _momentum(mass: float, moment: np.ndarray, inertia: np.ndarray, w: np.ndarray, v: np.ndarray) -> tuple:
    """Return [I w + h × v; m v − h × w]."""
    return inertia @ w + cross(moment, v), v * mass - cross(moment, w)


def _composites(links: Links) -> list[_Inertia]:
    """Return the mass, first moment and inertia of each subtree."""
    parts = (links.mass, links.moment, links.inertia)
    return list(zip(*(links.composite(list(x)) for x in parts), strict=True))


def _motion(links: Links, qd: list | None, qdd: list | None, gravity: bool) -> list[_Motion]:
    """Return the motion of all links. Gravity is included as an acceleration of the base."""
    zero, motion = links.graph.constants(np.zeros(3)), []
    rest = _Motion(zero, zero, zero, -links.gravity if gravity else zero)
    for i, parent in enumerate(links.parents):
        omega, v, alpha, a = rest if parent == BASE else motion[parent]
        z, l = links.z[i], links.l[i]
        if qd is not None:
            omega, v = omega + z * qd[i], v + l * qd[i]
            alpha = alpha + cross(omega, z) * qd[i]
            a = a + (cross(omega, l) + cross(v, z)) * qd[i]
        if qdd is not None:
            alpha, a = alpha + z * qdd[i], a + l * qdd[i]
        motion.append(_Motion(omega, v, alpha, a))
    return motion


def _link_forces(links: Links, motion: list[_Motion]) -> tuple[list, list]:
    """Return the torque and force on each joint's subtree by Newton-Euler about the centres of mass."""
    torques, forces = [], []
    for (omega, v, alpha, a), c, I, mass in zip(motion, links.c, links.I, links.mass, strict=True):
        force = (a + cross(alpha, c) + cross(omega, v + cross(omega, c))) * mass
        torques.append(I @ alpha + cross(omega, I @ omega) + cross(c, force))
        forces.append(force)
    return links.composite(torques), links.composite(forces)


def _joint_force(links: Links, qd: list | None, qdd: list | None, gravity: bool) -> np.ndarray:
    """Return the terms of M q̈ − Q_C − Q_G with given arguments by the recursive Newton-Euler algorithm."""
    torques, forces = _link_forces(links, _motion(links, qd, qdd, gravity))
    result = [z @ t + l @ f for z, l, t, f in zip(links.z, links.l, torques, forces, strict=True)]
    if qdd is not None:
        for i, j in np.argwhere(links.drives):
            result[i] = result[i] + qdd[j] * links.drives[i, j]
    return np.array(result, dtype=object)


def _solve(M: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """Return M⁻¹ rhs by elimination from the leaves, which preserves sparsity (Featherstone, §6.5)."""
    M, x, n = M.copy(), rhs.copy(), len(rhs)
    inverse = [1.0 / M[0, 0]] * n
    for k in reversed(range(n)):
        inverse[k] = 1.0 / M[k, k]
        for i in range(k):
            factor = M[k, i] * inverse[k]
            x[i] = x[i] - x[k] * factor
            for j in range(i + 1):
                M[i, j] = M[i, j] - factor * M[k, j]
    for k in range(n):
        for i in range(k):
            x[k] = x[k] - x[i] * M[k, i]
        x[k] = x[k] * inverse[k]
    return x


def _forward_dynamics(links: Links) -> np.ndarray:
    """Return M⁻¹(force + Q_C + Q_G)."""
    needed = _joint_force(links, links.vector("qd"), None, gravity=True)
    return _solve(_mass_matrix(links), np.array(links.vector("force"), dtype=object) - needed)


def _inverse_dynamics_derivatives(
    links: Links, qd: list | None, qdd: list, gravity: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return ∂ID/∂q and ∂ID/∂q̇ of the given terms, with the formulas of `forcegp.derivatives`."""
    motion = _motion(links, qd, qdd, gravity)
    torques, forces = _link_forces(links, motion)
    spin, momenta = [], []
    for (omega, v, _, _), m, h, I in zip(motion, links.mass, links.moment, links.inertia, strict=True):
        w = skew(omega)
        spin.append((w @ I - skew(h) @ skew(v)) * 2.0 - w * (I[0, 0] + I[1, 1] + I[2, 2]))
        momenta.append(v * m - cross(h, omega))
    spin, momenta, composites = links.composite(spin), links.composite(momenta), _composites(links)

    def pair(force: tuple, motion: tuple) -> Scalar:
        return force[0] @ motion[0] + force[1] @ motion[1]

    n = len(motion)
    dq, dqd = (links.graph.constants(np.zeros((n, n))) for _ in range(2))
    screws = list(zip(links.z, links.l, strict=True))
    moved = zip(motion, screws, strict=True)
    rates = [(cross(m.omega, z), cross(m.omega, l) + cross(m.v, z)) for m, (z, l) in moved]
    for i in range(n):
        z, l = screws[i]
        row, weight = spin[i].T @ z + cross(momenta[i], l) * 2.0, _momentum(*composites[i], z, l)
        column_q, column_v = _columns(motion[i], screws[i], rates[i], spin[i], momenta[i], composites[i])
        carried = cross(z, torques[i]) + cross(l, forces[i]), cross(z, forces[i])
        for j in links.ancestors(i):
            bend = _bend(motion[j], screws[j], rates[j])
            dq[i, j] = row @ rates[j][0] + pair(weight, bend)
            dqd[i, j] = row @ screws[j][0] + pair(weight, rates[j]) * 2.0
            if j != i:
                dq[j, i] = pair(screws[j], column_q) + pair(screws[j], carried)
                dqd[j, i] = pair(screws[j], column_v)
    return dq, dqd


def _bend(motion: _Motion, screw: tuple, rate: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Return S̈ = a × S + V × Ṡ for one joint."""
    (omega, v, alpha, a), (z, l) = motion, screw
    turned = cross(alpha, z) + cross(omega, rate[0])
    return turned, cross(alpha, l) + cross(a, z) + cross(omega, rate[1]) + cross(v, rate[0])


def _columns(
    motion: _Motion, screw: tuple, rate: tuple, spin: np.ndarray, momentum: np.ndarray, composite: _Inertia
) -> tuple[tuple, tuple]:
    """Return 2B Ṡ + I S̈ and 2B S + 2 I Ṡ for one joint and its subtree."""
    bent, turned = _momentum(*composite, *_bend(motion, screw, rate)), _momentum(*composite, *rate)
    return (
        (spin @ rate[0] + bent[0], cross(rate[0], momentum) * 2.0 + bent[1]),
        (spin @ screw[0] + turned[0] * 2.0, (cross(screw[0], momentum) + turned[1]) * 2.0),
    )


def _forward_dynamics_derivatives(links: Links) -> np.ndarray:
    """Return ∂q̈/∂q, ∂q̈/∂q̇ and M⁻¹, `(3, nq, nq)`."""
    qd, n = links.vector("qd"), len(links.parents)
    inverse = _solve(_mass_matrix(links), links.graph.constants(np.eye(n)))
    needed = _joint_force(links, qd, None, gravity=True)
    qdd = inverse @ (np.array(links.vector("force"), dtype=object) - needed)
    dq, dqd = _inverse_dynamics_derivatives(links, qd, list(qdd))
    return np.array([-(inverse @ dq), -(inverse @ dqd), inverse], dtype=object)


def regressor_program(links: Links) -> Program:
    """Return Y `(10 nq, nq)`, the transposed `identification.regressor`, from the motion of link origins."""
    n = len(links.parents)
    Y = links.graph.constants(np.zeros((PARAMETERS * n, n)))
    motion = _motion(links, links.vector("qd"), links.vector("qdd"), gravity=True)
    for i, ((omega, v, alpha, a), R, p) in enumerate(zip(motion, links.R, links.p, strict=True)):
        origin = a + cross(alpha, p) + cross(omega, v + cross(omega, p))
        zero, axes = links.graph.constants(np.zeros(3)), [R[:, x] for x in range(3)]
        wrenches = [(zero, origin)]
        # Moment and force about the link's origin, for m, then m c along each axis, then I
        wrenches += [(cross(e, origin), cross(alpha, e) + cross(omega, cross(omega, e))) for e in axes]
        for x in range(3):
            for y in range(x, 3):
                turn = [axes[x] * (axes[y] @ w) + axes[y] * (axes[x] @ w) for w in (alpha, omega)]
                half = 0.5 if x == y else 1.0
                wrenches.append(((turn[0] + cross(omega, turn[1])) * half, zero))
        for k, (torque, force) in enumerate(wrenches):
            about = torque + cross(p, force)
            for j in links.ancestors(i):
                Y[PARAMETERS * i + k, j] = links.z[j] @ about + links.l[j] @ force
    return Program(("q", "qd", "qdd"), Y.shape, links.graph, list(Y.flat))


QUANTITIES: dict[str, tuple[tuple[str, ...], Callable[[Links], np.ndarray]]] = {
    "forward_dynamics": (("q", "qd", "force"), _forward_dynamics),
    "forward_dynamics_derivatives": (("q", "qd", "force"), _forward_dynamics_derivatives),
    "inverse_dynamics": (
        ("q", "qd", "qdd"),
        lambda links: _joint_force(links, links.vector("qd"), links.vector("qdd"), gravity=True),
    ),
    "mass_matrix": (("q",), _mass_matrix),
    "bias_force": (("q", "qd"), lambda links: -_joint_force(links, links.vector("qd"), None, gravity=False)),
    "gravity_force": (("q",), lambda links: -_joint_force(links, None, None, gravity=True)),
}
"""Arguments and algorithm for each supported quantity."""


def trace(robot: RobotModel, quantity: str) -> Program:
    """Return the recorded program for one robot and one quantity in `QUANTITIES`."""
    arguments, algorithm = QUANTITIES[quantity]
    links = Links(robot)
    result = algorithm(links)
    return Program(arguments, result.shape, links.graph, list(result.flat))
