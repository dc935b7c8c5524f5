"""Terms of the equations of motion (M, Q_C, Q_G and moving points) from a single compiled call."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from forcegp.compiled.program import (
    Links,
    Program,
    _joint_force,
    _mass_matrix,
    _Motion,
    _motion,
    cross,
    numbers,
)
from forcegp.compiled.source import cpu_kernel, cpu_source
from forcegp.kinematics import Anchor
from forcegp.robot.model import BASE, RobotModel


class CompiledMechanics:
    """Mechanics of a robot and of given points on it, as a compiled function of (q, q̇) on the CPU.

    `batch` returns M, Q_C and Q_G. For each point, it returns the axes of its frame `(3, 3)`, its world
    position, the Jacobian J `(6, nq)` with [ω; ṗ] = J q̇, and the bias acceleration J̇ q̇ `(6,)`.

    Raises:
        MissingDependencyError: there is no C++ compiler.
    """

    def __init__(self, robot: RobotModel, points: Sequence[Anchor]) -> None:
        links = Links(robot)
        blocks = _forces(links)
        for frame, point in points:
            blocks += _point_blocks(links, robot, robot.frame_index(frame), np.asarray(point, dtype=float))
        ends = np.cumsum([0, *(block.size for block in blocks)]).tolist()
        self._places = [(slice(*at), x.shape) for at, x in zip(pairwise(ends), blocks, strict=True)]
        outputs = [entry for block in blocks for entry in block.flat]
        program = Program(("q", "qd"), (len(outputs),), links.graph, outputs)
        source = cpu_source(program, robot.nq, robot.dtype)
        self._arrays, self._kernel, self._dtype = source.arrays, cpu_kernel(source.text), robot.dtype

    def batch(self, q: Tensor, qd: Tensor) -> list[Tensor]:
        """Return the mechanics at the states q, q̇ `(*batch, nq)`, without autograd."""
        shape, q, qd = q.shape[:-1], q.reshape(-1, q.shape[-1]), qd.reshape(-1, qd.shape[-1])
        values = {"q": lambda: q, "qd": lambda: qd, "sin": lambda: torch.sin(q), "cos": lambda: torch.cos(q)}
        out = torch.empty(len(q), self._places[-1][0].stop, dtype=self._dtype)
        if len(q):
            self._kernel([values[name]().contiguous() for name in self._arrays], out)
        blocks = out.split([place.stop - place.start for place, _ in self._places], dim=1)
        return [x.reshape(*shape, *size) for x, (_, size) in zip(blocks, self._places, strict=True)]


def _forces(links: Links) -> list[np.ndarray]:
    """Return M, Q_C and Q_G."""
    return [
        _mass_matrix(links),
        -_joint_force(links, links.vector("qd"), None, gravity=False),
        -_joint_force(links, None, None, gravity=True),
    ]


def _point_blocks(links: Links, robot: RobotModel, index: int, point: np.ndarray) -> list[np.ndarray]:
    """Return rotation and position in the world, Jacobian and bias acceleration of a point in a frame."""
    graph, parent, n = links.graph, robot.frame_parents[index], robot.nq
    zero = graph.constants(np.zeros(3))
    R, p, moves = graph.constants(numbers(robot.base_rotation)), zero, _Motion(zero, zero, zero, zero)
    if parent != BASE:
        motion = _motion(links, links.vector("qd"), None, gravity=False)
        R, p, moves = links.R[parent], links.p[parent], motion[parent]
    local = numbers(robot.frame_position[index]) + numbers(robot.frame_rotation[index]) @ point
    x = p + R @ graph.constants(local)
    J = graph.constants(np.zeros((6, n)))
    for j in [] if parent == BASE else links.ancestors(parent):
        J[:3, j] = links.z[j]
        J[3:, j] = links.l[j] + cross(links.z[j], x)
    omega, v, alpha, a = moves
    bias = a + cross(alpha, x) + cross(omega, v + cross(omega, x))
    rotation = R @ graph.constants(numbers(robot.frame_rotation[index]))
    return [rotation, x + graph.constants(numbers(robot.base_position)), J, np.concatenate([alpha, bias])]
