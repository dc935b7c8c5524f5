"""PyBullet as the physics engine, with everything off that would act beside the forces we apply."""

from __future__ import annotations

import tempfile
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import torch

from forcegp.errors import MissingDependencyError, UnsupportedRobotError
from forcegp.robot.model import RobotModel
from forcegp.simulate.urdf import write_urdf
from forcegp.types import JointMatrix, JointVector

MAX_JOINT_VELOCITY = 1e6
"""Bullet clamps joint velocities at 100 rad/s unless told otherwise; a clamp is a force nobody applied."""


class PyBulletEngine:
    """A robot in a PyBullet world of its own (see `Engine` for what is switched off).

    Args:
        robot: the robot.
        dt: step [s].

    Raises:
        MissingDependencyError: PyBullet is not installed.
        UnsupportedRobotError: a drive has inertia of its own, which PyBullet has no place for.
    """

    def __init__(self, robot: RobotModel, dt: float) -> None:
        self._bullet = bullet = _import_pybullet()
        _check_armature(robot)
        self._robot, self._dt = robot, dt
        self._client = bullet.connect(bullet.DIRECT)
        bullet.setTimeStep(dt, physicsClientId=self._client)
        bullet.setGravity(*robot.gravity.tolist(), physicsClientId=self._client)
        self._body = self._load()
        self._joints = self._find_joints()
        self._silence()

    @property
    def name(self) -> str:
        """Name and version, for the record."""
        return f"pybullet {version('pybullet')}"

    @property
    def dt(self) -> float:
        """Step [s]."""
        return self._dt

    def reset(self, q: JointVector, qd: JointVector) -> None:
        """Put the robot at q `(nq,)` moving at qd `(nq,)`."""
        for joint, position, velocity in zip(self._joints, q.tolist(), qd.tolist(), strict=True):
            self._bullet.resetJointState(self._body, joint, position, velocity, physicsClientId=self._client)

    def state(self) -> tuple[JointVector, JointVector]:
        """The present q and qd, `(nq,)` each."""
        states = self._bullet.getJointStates(self._body, self._joints, physicsClientId=self._client)
        q, qd = zip(*((state[0], state[1]) for state in states), strict=True)
        return torch.tensor(q, dtype=self._robot.dtype), torch.tensor(qd, dtype=self._robot.dtype)

    def step(self, force: JointVector) -> None:
        """Advance by dt under the generalized force `(nq,)`."""
        bullet = self._bullet
        bullet.setJointMotorControlArray(
            self._body,
            self._joints,
            bullet.TORQUE_CONTROL,
            forces=force.tolist(),
            physicsClientId=self._client,
        )
        bullet.stepSimulation(physicsClientId=self._client)

    def mass_matrix(self, q: JointVector) -> JointMatrix:
        """PyBullet's `calculateMassMatrix`, `(nq, nq)`."""
        M = self._bullet.calculateMassMatrix(self._body, self._ordered(q), physicsClientId=self._client)
        order = self._order()
        return torch.tensor(M, dtype=self._robot.dtype)[order][:, order]

    def inverse_dynamics(self, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
        """PyBullet's `calculateInverseDynamics`, `(nq,)`."""
        force = self._bullet.calculateInverseDynamics(
            self._body, *(self._ordered(x) for x in (q, qd, qdd)), physicsClientId=self._client
        )
        return torch.tensor(force, dtype=self._robot.dtype)[self._order()]

    def close(self) -> None:
        """Disconnect from the physics server."""
        if self._bullet.isConnected(self._client):
            self._bullet.disconnect(self._client)

    def _load(self) -> int:
        bullet = self._bullet
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(write_urdf(self._robot), encoding="utf-8")
            flags = bullet.URDF_USE_INERTIA_FROM_FILE
            return bullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=self._client)

    def _find_joints(self) -> list[int]:
        """PyBullet's index of each of our joints."""
        count = self._bullet.getNumJoints(self._body, physicsClientId=self._client)
        info = (self._bullet.getJointInfo(self._body, i, physicsClientId=self._client) for i in range(count))
        index = {entry[1].decode(): entry[0] for entry in info}
        return [index[name] for name in self._robot.joint_names]

    def _silence(self) -> None:
        bullet, client = self._bullet, self._client
        for link in (-1, *self._joints):
            bullet.changeDynamics(
                self._body,
                link,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                maxJointVelocity=MAX_JOINT_VELOCITY,
                physicsClientId=client,
            )
        bullet.setJointMotorControlArray(
            self._body,
            self._joints,
            bullet.VELOCITY_CONTROL,
            forces=[0.0] * len(self._joints),
            physicsClientId=client,
        )

    def _order(self) -> list[int]:
        """Place of each of our joints in PyBullet's vectors, which list joints by their index."""
        return [sorted(self._joints).index(joint) for joint in self._joints]

    def _ordered(self, values: JointVector) -> list[float]:
        ordered = sorted(zip(self._joints, values.tolist(), strict=True))
        return [value for _, value in ordered]


def _check_armature(robot: RobotModel) -> None:
    for joint, armature in zip(robot.joint_names, robot.armature.tolist(), strict=True):
        if armature != 0.0:
            raise UnsupportedRobotError(
                f"joint {joint!r} of robot {robot.name!r} has a drive with inertia",
                expected="armature 0, as PyBullet has no place for it",
                got=armature,
                hint='use the engine "mujoco"',
            )


def _import_pybullet() -> ModuleType:
    try:
        import pybullet
    except ImportError:
        raise MissingDependencyError(
            "the engine 'pybullet' needs the package pybullet",
            hint='pip install "forcegp[pybullet]" (Python 3.11 or older), or use the engine "mujoco"',
        ) from None
    return pybullet
