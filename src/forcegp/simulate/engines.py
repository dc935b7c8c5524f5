"""PyBullet and MuJoCo as physics engines in which only gravity and the applied forces act."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.errors import (
    InertiaError,
    MissingDependencyError,
    UnsupportedRobotError,
    check_name,
    optional_module,
)
from forcegp.robot.model import RobotModel
from forcegp.simulate.engine import Engine
from forcegp.simulate.urdf import compile_spec, principal_axes, write_urdf
from forcegp.types import JointMatrix, JointVector

NEEDS_MUJOCO = "the engine 'mujoco'"
MAX_JOINT_VELOCITY = 1e6
"""Joint velocity limit for Bullet. By default, Bullet clamps at 100 rad/s, which adds an unwanted force."""
COMPARED, DIFFERENT = 2, 1e-6
"""Number of random states at which an engine is compared with the robot; largest relative difference."""


def compare(
    robot: RobotModel, engine: str, equations: Callable[[JointVector], tuple[Tensor, Tensor]]
) -> None:
    """Compare an engine's M and Q_G as functions of q with those of the robot at random positions.

    Raises:
        UnsupportedRobotError: the engine simulates a different robot.
    """
    generator, exact = torch.Generator().manual_seed(0), robot.to(dtype=torch.float64)
    tolerance = max(DIFFERENT, 100.0 * torch.finfo(robot.dtype).eps)
    for _ in range(COMPARED):
        q = 2.0 * torch.rand(robot.nq, dtype=torch.float64, generator=generator) - 1.0
        M, Q_G = dynamics.mass_matrix(exact, q), dynamics.gravity_force(exact, q)
        theirs_M, theirs_G = equations(q.to(robot.dtype))
        scale = M.diagonal().sqrt()
        difference = (theirs_M - M).abs() / (scale[:, None] * scale)
        difference_G = (theirs_G - Q_G).abs() / (Q_G.abs().max() + 1e-9)
        worst = torch.maximum(difference.amax(-1), difference_G)
        if not float(worst.max()) <= tolerance:
            joint = robot.joint_names[int(worst.argmax())]
            raise UnsupportedRobotError(
                f"{engine} simulates a different robot: its dynamics differ at joint {joint!r}",
                expected=f"relative differences in M and gravity below {tolerance:.0e}",
                got=f"{float(worst.max()):.3g}",
                hint="use another engine",
            )


class PyBulletEngine(Engine):
    """A robot in a separate PyBullet world with step size dt [s].

    Raises:
        MissingDependencyError: PyBullet is not installed.
        UnsupportedRobotError: a drive has inertia, which PyBullet does not support.
        InertiaError: the principal moments of a link violate the triangle inequality. PyBullet would set them
            to zero.
    """

    def __init__(self, robot: RobotModel, dt: float) -> None:
        try:
            import pybullet
            from pybullet_utils.bullet_client import BulletClient
        except ImportError:
            raise MissingDependencyError(
                "the engine 'pybullet' needs the package pybullet",
                hint='pip install "forcegp[pybullet]" (Python 3.11 or older), or use the engine "mujoco"',
            ) from None
        _check_for_bullet(robot)
        self._robot, self._dt = robot, dt
        # The constructor of a client passes options, and PyBullet prints a line if there are any.
        self._bullet: Any = BulletClient.__new__(BulletClient)
        vars(self._bullet).update(_shapes={}, _pid=os.getpid(), _client=pybullet.connect(pybullet.DIRECT))
        self._bullet.setTimeStep(dt)
        self._bullet.setGravity(*robot.gravity.tolist())
        self._body = self._load()
        count = self._bullet.getNumJoints(self._body)
        info = (self._bullet.getJointInfo(self._body, i) for i in range(count))
        index = {entry[1].decode(): entry[0] for entry in info}
        self._joints = [index[name] for name in robot.joint_names]
        # PyBullet's vectors are ordered by joint index.
        self._order = np.argsort(np.argsort(self._joints)).tolist()
        self._silence()
        still = torch.zeros(robot.nq, dtype=robot.dtype)
        compare(robot, self.name, lambda q: (self.mass_matrix(q), -self.inverse_dynamics(q, still, still)))

    @property
    def name(self) -> str:
        return f"pybullet {version('pybullet')}"

    @property
    def dt(self) -> float:
        return self._dt

    def reset(self, q: JointVector, qd: JointVector) -> None:
        for joint, position, velocity in zip(self._joints, q.tolist(), qd.tolist(), strict=True):
            self._bullet.resetJointState(self._body, joint, position, velocity)

    def state(self) -> tuple[JointVector, JointVector]:
        states = self._bullet.getJointStates(self._body, self._joints)
        q, qd = zip(*((state[0], state[1]) for state in states), strict=True)
        return torch.tensor(q, dtype=self._robot.dtype), torch.tensor(qd, dtype=self._robot.dtype)

    def step(self, force: JointVector) -> None:
        mode, forces = self._bullet.TORQUE_CONTROL, force.tolist()
        self._bullet.setJointMotorControlArray(self._body, self._joints, mode, forces=forces)
        self._bullet.stepSimulation()

    def mass_matrix(self, q: JointVector) -> JointMatrix:
        M = self._bullet.calculateMassMatrix(self._body, self._ordered(q))
        return torch.tensor(M, dtype=self._robot.dtype)[self._order][:, self._order]

    def inverse_dynamics(self, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
        force = self._bullet.calculateInverseDynamics(self._body, *map(self._ordered, (q, qd, qdd)))
        return torch.tensor(force, dtype=self._robot.dtype)[self._order]

    def close(self) -> None:
        if self._bullet.isConnected():
            self._bullet.disconnect()

    def _load(self) -> int:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(write_urdf(self._robot), encoding="utf-8")
            flags = self._bullet.URDF_USE_INERTIA_FROM_FILE
            return self._bullet.loadURDF(str(path), useFixedBase=True, flags=flags)

    def _silence(self) -> None:
        damping = {"linearDamping": 0.0, "angularDamping": 0.0, "jointDamping": 0.0}
        for link in (-1, *self._joints):
            self._bullet.changeDynamics(self._body, link, **damping, maxJointVelocity=MAX_JOINT_VELOCITY)
        motors, none = self._bullet.VELOCITY_CONTROL, [0.0] * len(self._joints)
        self._bullet.setJointMotorControlArray(self._body, self._joints, motors, forces=none)

    def _ordered(self, values: JointVector) -> list[float]:
        return values[np.argsort(self._joints)].tolist()


def _check_for_bullet(robot: RobotModel) -> None:
    """Raise typed errors for drives and inertias that PyBullet does not support."""
    for i, (joint, armature) in enumerate(zip(robot.joint_names, robot.armature.tolist(), strict=True)):
        if armature != 0.0:
            raise UnsupportedRobotError(
                f"joint {joint!r} of robot {robot.name!r} has a drive with inertia",
                expected="armature 0, since PyBullet does not support it",
                got=armature,
                hint='use the engine "mujoco"',
            )
        low, mid, high = principal_axes(robot.inertia[i])[0].tolist()
        if high > low + mid:
            raise InertiaError(
                f"PyBullet would set the inertia of the link of joint {joint!r} to zero",
                expected="principal moments that obey the triangle inequality",
                got=f"{low:.6g} + {mid:.6g} < {high:.6g} kg m²",
                hint="correct the <inertial> of the link in the robot file",
            )


class MuJoCoWorld:
    """A robot in a compiled MuJoCo model, which has the robot's joint names, gravity and armature."""

    def __init__(self, robot: RobotModel, model: Any, dt: float) -> None:
        self._mujoco, self._robot, self.model = optional_module("mujoco", NEEDS_MUJOCO), robot, model
        model.opt.timestep = dt
        model.opt.gravity[:] = robot.gravity.numpy()
        self._dof = np.array([model.joint(name).dofadr[0] for name in robot.joint_names])
        model.dof_armature[self._dof] = robot.armature.numpy()
        self._data = self._mujoco.MjData(model)
        compare(robot, self.name, self._equations)

    @property
    def name(self) -> str:
        """Name and version of the engine."""
        return f"mujoco {self._mujoco.__version__}"

    def reset(self, q: JointVector, qd: JointVector) -> None:
        """Set the positions q and velocities qd, `(nq,)` each."""
        self._set(self._data, q, qd)

    def state(self) -> tuple[JointVector, JointVector]:
        """Return the current q and qd, `(nq,)` each [rad, rad/s]."""
        return self._tensor(self._data.qpos[self._dof]), self._tensor(self._data.qvel[self._dof])

    def close(self) -> None:
        """Release the engine's resources. MuJoCo has none."""

    def _set(self, data: Any, q: JointVector, qd: JointVector) -> None:
        data.qpos[self._dof] = q.numpy()
        data.qvel[self._dof] = qd.numpy()

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=self._robot.dtype)

    def _equations(self, q: JointVector) -> tuple[Tensor, Tensor]:
        """Return M and Q_G at rest."""
        data = self._mujoco.MjData(self.model)
        self._set(data, q, torch.zeros_like(q))
        self._mujoco.mj_forward(self.model, data)
        M = self._mass_matrix(data)[np.ix_(self._dof, self._dof)]
        return self._tensor(M), self._tensor(-data.qfrc_bias[self._dof])

    def _mass_matrix(self, data: Any) -> np.ndarray:
        """Return M `(nv, nv)` after positions were updated. `mj_fullM` differs between versions of MuJoCo."""
        M = np.zeros((self.model.nv, self.model.nv))
        for column, unit in zip(M, np.eye(self.model.nv), strict=True):
            self._mujoco.mj_mulM(self.model, data, column, unit)
        return M


class MuJoCoEngine(MuJoCoWorld, Engine):
    """A robot in a separate MuJoCo world with step size dt [s].

    Raises:
        InertiaError: the principal moments of a link violate the triangle inequality.
        MissingDependencyError: MuJoCo is not installed.
    """

    def __init__(self, robot: RobotModel, dt: float) -> None:
        mujoco = optional_module("mujoco", NEEDS_MUJOCO)
        super().__init__(robot, compile_spec(mujoco.MjSpec.from_string(write_urdf(robot)), robot), dt)
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self._scratch = mujoco.MjData(self.model)

    @property
    def dt(self) -> float:
        return float(self.model.opt.timestep)

    def step(self, force: JointVector) -> None:
        self._data.qfrc_applied[self._dof] = force.numpy()
        self._mujoco.mj_step(self.model, self._data)

    def mass_matrix(self, q: JointVector) -> JointMatrix:
        self._set(self._scratch, q, torch.zeros_like(q))
        self._mujoco.mj_forward(self.model, self._scratch)
        return self._tensor(self._mass_matrix(self._scratch)[np.ix_(self._dof, self._dof)])

    def inverse_dynamics(self, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
        data = self._scratch
        self._set(data, q, qd)
        data.qacc[self._dof] = qdd.numpy()
        self._mujoco.mj_inverse(self.model, data)
        return self._tensor(data.qfrc_inverse[self._dof])


MAKERS = {"pybullet": PyBulletEngine, "mujoco": MuJoCoEngine}


def make_engine(robot: RobotModel, dt: float, name: str = "auto") -> Engine:
    """Return an engine by name.

    Args:
        robot: the robot.
        dt: step size [s].
        name: `"pybullet"`, `"mujoco"`, or `"auto"` for PyBullet if it is installed and supports the robot,
            and MuJoCo otherwise.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> engine = make_engine(robot, dt=0.001, name="mujoco")
        >>> engine.mass_matrix(torch.zeros(2, dtype=torch.float64)).shape
        torch.Size([2, 2])

    Raises:
        UnknownNameError: the engine does not exist.
        MissingDependencyError: the engine's package is not installed.
        InertiaError: the principal moments of a link violate the triangle inequality.
        UnsupportedRobotError: the engine does not support the robot, or simulates a different one.
    """
    check_name("engine", name, ["auto", *MAKERS])
    if name != "auto":
        return MAKERS[name](robot, dt)
    try:
        return PyBulletEngine(robot, dt)
    except (MissingDependencyError, UnsupportedRobotError, InertiaError):
        return MuJoCoEngine(robot, dt)
