"""Equations of motion computed by a compiled kernel.

For a few states, the overhead of tensor operations far exceeds the cost of the computation itself. The kernel
is built by the local C++ compiler and cached on disk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from forcegp import dynamics, kinematics
from forcegp.compiled.mechanics import CompiledMechanics
from forcegp.constraints.gauss import Equations
from forcegp.constraints.system import ConstrainedSystem
from forcegp.errors import MissingDependencyError
from forcegp.kinematics import Anchor
from forcegp.robot.model import RobotModel
from forcegp.types import JointVector

POINT = 4
"""Number of output blocks per point: rotation, position, Jacobian, and bias acceleration."""
_KERNELS: WeakKeyDictionary[RobotModel, dict[tuple[Anchor, ...], CompiledMechanics | None]] = (
    WeakKeyDictionary()
)
_SYSTEMS: WeakKeyDictionary[ConstrainedSystem, ConstrainedSystem] = WeakKeyDictionary()
"""Compiled systems, kept as long as the original systems exist."""


@dataclass(frozen=True, eq=False, repr=False)
class CompiledSystem(ConstrainedSystem):
    """A constrained system whose equations of motion come from a compiled kernel unless gradients are needed.

    Use `compiled_system` to create one. The kernel also computes the motion of additional `points`.
    """

    points: tuple[Anchor, ...] = ()

    @cached_property
    def _anchors(self) -> tuple[Anchor, ...]:
        return _anchors_of(self, self.points)

    @cached_property
    def _mechanics(self) -> CompiledMechanics | None:
        return _kernel(self.robot, self._anchors)

    def with_robot(self, robot: RobotModel) -> ConstrainedSystem:
        """Return the same constraints on a robot with different parameters, without the kernel."""
        return ConstrainedSystem(robot, self.contacts, self.baumgarte)

    def equations(self, q: JointVector, qd: JointVector, active: Tensor | None = None) -> Equations:
        """See `ConstrainedSystem.equations`."""
        if self._mechanics is None or q.shape != qd.shape or _traced(q) or _traced(qd):
            return super().equations(q, qd, active)
        self.robot.check_state(q=q, qd=qd)
        M, Q_C, Q_G, *blocks = self._mechanics.batch(q, qd)
        parts = zip(self._anchors, range(0, len(blocks), POINT), strict=True)
        points = {a: kinematics.PointMotion.of(blocks[i : i + POINT], qd) for a, i in parts}

        def point_motion(frame: str, point: Sequence[float]) -> kinematics.PointMotion:
            known = points.get(_key((frame, point)))
            return self._moving(q, qd)[2](frame, point) if known is None else known

        robot_terms = M, Q_C, Q_G, dynamics.damping_force(self.robot, qd)
        return self._assembled(q, qd, active, robot_terms, point_motion, lambda: self._moving(q, qd)[:2])


def compiled_system(system: ConstrainedSystem, *points: Anchor) -> ConstrainedSystem:
    """Return the system with compiled equations of motion, for repeated evaluations of the same robot.

    The first call for a robot takes a few seconds to compile the kernel; later calls, in any process, load it
    from the cache. The system is returned unchanged if there is no compiler, or if the robot's parameters
    require gradients or are on a GPU. `points` are additional points for `Equations.point_motion`.

    Example:
        >>> import torch, forcegp
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> q, qd = torch.zeros(2, 7, dtype=torch.float64)
        >>> float(compiled_system(system).equations(q, qd).c - system.equations(q, qd).c)
        0.0
    """
    if isinstance(system, CompiledSystem) or _kernel(system.robot, _anchors_of(system, points)) is None:
        return system
    if points:
        return CompiledSystem(system.robot, system.contacts, system.baumgarte, points)
    return _SYSTEMS.setdefault(system, CompiledSystem(system.robot, system.contacts, system.baumgarte))


def _anchors_of(system: ConstrainedSystem, points: Sequence[Anchor]) -> tuple[Anchor, ...]:
    """Return the points used by the constraints, followed by the additional points, without duplicates."""
    read = (anchor for contact in system.contacts for anchor in contact.anchors)
    return tuple(dict.fromkeys(map(_key, (*read, *points))))


def _key(anchor: Anchor) -> Anchor:
    frame, point = anchor
    return frame, tuple(float(x) for x in point)


def _kernel(robot: RobotModel, anchors: tuple[Anchor, ...]) -> CompiledMechanics | None:
    """Return the kernel for a robot, cached as long as the robot exists; `None` if compilation fails."""
    kept = _KERNELS.setdefault(robot, {})
    if anchors not in kept:
        known = robot.device.type == "cpu" and robot.dtype in (torch.float64, torch.float32)
        try:
            kept[anchors] = CompiledMechanics(robot, anchors) if known and not robot.learned else None
        except MissingDependencyError:
            kept[anchors] = None
    return kept[anchors]


def _traced(x: Tensor) -> bool:
    """Return whether x may be differentiated by autograd or a `torch.func` transform."""
    if x.requires_grad and torch.is_grad_enabled():
        return True
    try:
        x.data_ptr()
    except RuntimeError:  # A transform wraps its tensors, which then have no storage of their own.
        return True
    return False
