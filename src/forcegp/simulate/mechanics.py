"""Equations of motion and tool motion of one state at a time, in NumPy.

At a single state, the overhead of tensors dominates. So the simulator uses a compiled kernel for the robot's
mechanics if there is a C++ compiler, otherwise the functions for batches, and solves for the multiplier in
NumPy. Constraints, contact mechanics and control are shared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from forcegp import dynamics
from forcegp.compiled.mechanics import CompiledMechanics
from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.gauss import RANK_TOLERANCE
from forcegp.control.plan import Plan
from forcegp.control.task_space import POTRF, POTRS
from forcegp.errors import MissingDependencyError
from forcegp.kinematics import Anchor, PointMotion, point_motion

Vector = NDArray[np.floating]
Blocks = Callable[[Vector, Vector], Sequence[Vector]]
"""M, Q_C and Q_G at a state, then rotation, position, Jacobian and bias acceleration of each point."""
POINT = 4


class TouchingPoint(NamedTuple):
    """A `ContactPoint` at one state, in arrays.

    Attributes:
        position, velocity: `(3,)` in the world [m], [m/s].
        jacobian: J_E `(3, nq)`, world axes.
        normal: ∇c `(3,)` at the point.
    """

    position: Vector
    velocity: Vector
    jacobian: Vector
    normal: Vector


@dataclass(frozen=True, eq=False)
class StateEquations:
    """The constrained equations of motion at one state; see `forcegp.constraints.gauss.Equations`.

    Attributes:
        M, A, b, c, cd, Q_C, Q_D, Q_K: as in `Equations`, without a batch.
        contact_points: the touching point of each surface contact, by name.
        tool: motion of the tool.
    """

    M: Vector
    A: Vector
    b: Vector
    c: Vector
    cd: Vector
    Q_C: Vector
    Q_D: Vector
    Q_K: Vector
    contact_points: dict[str, TouchingPoint]
    tool: PointMotion

    @cached_property
    def _M_cholesky(self) -> Vector:
        return POTRF(self.M, lower=1)[0]

    @cached_property
    def _M_inv_At(self) -> Vector:
        return POTRS(self._M_cholesky, self.A.T, lower=1)[0]

    @cached_property
    def _constraint_inertia(self) -> Vector:
        """(A M⁻¹ Aᵀ)⁺; redundant and inactive rows count as zero."""
        S = self.A @ self._M_inv_At
        if S.shape == (1, 1):
            return 1.0 / S if S[0, 0] != 0.0 else S
        return np.linalg.pinv(S, hermitian=True, rcond=RANK_TOLERANCE)

    @property
    def L(self) -> Vector:
        """L = M⁻¹Aᵀ(A M⁻¹ Aᵀ)⁺ `(nq, m)`."""
        return self._M_inv_At @ self._constraint_inertia

    def multiplier(self, Q_bar: Vector) -> Vector:
        """λ = (A M⁻¹ Aᵀ)⁺(b − A M⁻¹ Q̄) `(m,)`."""
        return self._constraint_inertia @ (self.b - self._M_inv_At.T @ Q_bar)


class Mechanics:
    """A system with equations of motion at one state at a time; the plan names the tool point.

    `contacts` and `m` are those of the system; `compiled` is true if the kernel is used.
    """

    def __init__(self, system: ConstrainedSystem, plan: Plan) -> None:
        self._system, self.contacts, self.m = system, system.contacts, system.m
        tool = (plan.frame, plan.point)
        self._anchors = [tool, *(a for contact in system.contacts for a in contact.anchors if a != tool)]
        self._places = [[self._anchors.index(a) for a in contact.anchors] for contact in system.contacts]
        self._rows = np.array([contact.rows for contact in system.contacts], dtype=int)
        self._blocks, self.compiled = _blocks(system, self._anchors)

    def equations(self, q: Vector, qd: Vector, active: NDArray[np.bool_] | None = None) -> StateEquations:
        """The equations of motion at a state `(nq,)`; `active` `(n_contacts,)` defaults to all."""
        velocity = torch.from_numpy(qd)
        M, Q_C, Q_G, *points = self._blocks(q, qd)
        frames = [points[i : i + POINT] for i in range(0, len(points), POINT)]
        moving = [PointMotion.of([torch.from_numpy(x) for x in frame], velocity) for frame in frames]
        pairs = zip(self.contacts, self._places, strict=True)
        terms = [contact.terms_of([moving[k] for k in places]) for contact, places in pairs]
        nq = len(q)
        c = np.concatenate([np.zeros(0), *(x.c.numpy() for x in terms)])
        A = np.concatenate([np.zeros((0, nq)), *(x.A.numpy() for x in terms)])
        b = np.concatenate([np.zeros(0), *(x.b.numpy() for x in terms)])
        cd = A @ qd
        if self._system.baumgarte is not None:
            b = self._system.baumgarte.stabilized(*(torch.from_numpy(x) for x in (b, c, cd))).numpy()
        rows = np.ones(len(b)) if active is None else np.repeat(active, self._rows)
        holds = [np.ones(x.b.shape) if x.holds is None else x.holds.numpy() for x in terms]
        rows = rows * np.concatenate([np.zeros(0), *holds])
        Q_D = dynamics.damping_force(self._system.robot, velocity).numpy()
        rotation, position, jacobian, bias = frames[0]
        tool = PointMotion(rotation, position, jacobian @ qd, jacobian, bias)
        touching = {
            contact.name: TouchingPoint(*(getattr(x.point, f).numpy() for f in TouchingPoint._fields))
            for contact, x in zip(self.contacts, terms, strict=True)
            if x.point is not None
        }
        Q_K = Q_C + Q_G + Q_D
        return StateEquations(M, A * rows[:, None], b * rows, c, cd, Q_C, Q_D, Q_K, touching, tool)


def _blocks(system: ConstrainedSystem, anchors: Sequence[Anchor]) -> tuple[Blocks, bool]:
    """The mechanics of the robot and of points of it at one state, and whether they are compiled."""
    try:
        return CompiledMechanics(system.robot, anchors), True
    except MissingDependencyError:
        pass

    def eager(q: Vector, qd: Vector) -> Sequence[Vector]:
        state = torch.from_numpy(q), torch.from_numpy(qd)
        eom = system.equations(*state)
        links = system.robot, eom.poses, eom.motion, state[1]
        tools = [point_motion(*links, *anchor) for anchor in anchors]
        points = [x for t in tools for x in (t.rotation, t.position, t.jacobian, t.bias)]
        return [x.numpy() for x in (eom.M, eom.Q_C, eom.Q_G, *points)]

    return eager, False
