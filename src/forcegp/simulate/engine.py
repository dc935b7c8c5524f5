"""What a physics engine must offer to simulate a robot, and where to get one."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from forcegp.errors import MissingDependencyError, UnknownNameError
from forcegp.robot.model import RobotModel
from forcegp.types import JointMatrix, JointVector

ENGINES = ("pybullet", "mujoco")


@runtime_checkable
class Engine(Protocol):
    """A physics engine that holds one robot, moves it under gravity and adds no other force of its own.

    One step is semi-implicit Euler: q̇ₖ₊₁ = q̇ₖ + dt q̈(qₖ, q̇ₖ), qₖ₊₁ = qₖ + dt q̇ₖ₊₁, so the acceleration
    during a step is (q̇ₖ₊₁ − q̇ₖ)/dt. Contacts, collisions, joint limits, motors and damping are off; all
    forces but gravity are given with `step`.
    """

    @property
    def name(self) -> str:
        """Name and version, for the record."""
        ...

    @property
    def dt(self) -> float:
        """Step [s]."""
        ...

    def reset(self, q: JointVector, qd: JointVector) -> None:
        """Put the robot at q `(nq,)` moving at qd `(nq,)`."""
        ...

    def state(self) -> tuple[JointVector, JointVector]:
        """The present q and qd, `(nq,)` each [rad, rad/s]."""
        ...

    def step(self, force: JointVector) -> None:
        """Advance by dt under the generalized force `(nq,)` [N m], all but gravity and bias forces."""
        ...

    def mass_matrix(self, q: JointVector) -> JointMatrix:
        """The engine's own M(q) `(nq, nq)`, an oracle for ours."""
        ...

    def inverse_dynamics(self, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
        """The engine's own M q̈ − Q_C − Q_G `(nq,)`, an oracle for ours."""
        ...

    def close(self) -> None:
        """Release the engine's resources; it is not used afterwards."""
        ...


def make_engine(robot: RobotModel, dt: float, name: str = "auto") -> Engine:
    """An engine by name.

    Args:
        robot: the robot it holds.
        dt: step [s].
        name: `"pybullet"`, `"mujoco"`, or `"auto"` for PyBullet where it is installed, else MuJoCo.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> engine = make_engine(robot, dt=0.001, name="mujoco")
        >>> engine.mass_matrix(torch.zeros(2, dtype=torch.float64)).shape
        torch.Size([2, 2])

    Raises:
        UnknownNameError: no such engine.
        MissingDependencyError: the engine's package is not installed.
    """
    from forcegp.simulate.mujoco import MuJoCoEngine
    from forcegp.simulate.pybullet import PyBulletEngine

    makers = dict(zip(ENGINES, (PyBulletEngine, MuJoCoEngine), strict=True))
    if name != "auto" and name not in makers:
        raise UnknownNameError("engine", name, ["auto", *makers])
    if name != "auto":
        return makers[name](robot, dt)
    try:
        return PyBulletEngine(robot, dt)
    except MissingDependencyError:
        return MuJoCoEngine(robot, dt)
