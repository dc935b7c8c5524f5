"""MuJoCo as the physics engine, for Python versions that PyBullet publishes no wheels for."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.errors import MissingDependencyError
from forcegp.robot.model import RobotModel
from forcegp.simulate.urdf import write_urdf
from forcegp.types import JointMatrix, JointVector


class MuJoCoEngine:
    """A robot in a MuJoCo world of its own (see `Engine` for what is switched off).

    Args:
        robot: the robot.
        dt: step [s].

    Raises:
        MissingDependencyError: MuJoCo is not installed.
    """

    def __init__(self, robot: RobotModel, dt: float) -> None:
        self._mujoco = mujoco = import_mujoco()
        self._robot = robot
        self._model = model = mujoco.MjModel.from_xml_string(write_urdf(robot))
        model.opt.timestep = dt
        model.opt.gravity[:] = robot.gravity.numpy()
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self._dof = np.array([model.joint(name).dofadr[0] for name in robot.joint_names])
        model.dof_armature[self._dof] = robot.armature.numpy()
        self._data = mujoco.MjData(model)
        self._scratch = mujoco.MjData(model)

    @property
    def name(self) -> str:
        """Name and version, for the record."""
        return f"mujoco {self._mujoco.__version__}"

    @property
    def dt(self) -> float:
        """Step [s]."""
        return float(self._model.opt.timestep)

    def reset(self, q: JointVector, qd: JointVector) -> None:
        """Put the robot at q `(nq,)` moving at qd `(nq,)`."""
        self._set(self._data, q, qd)

    def state(self) -> tuple[JointVector, JointVector]:
        """The present q and qd, `(nq,)` each."""
        return self._tensor(self._data.qpos[self._dof]), self._tensor(self._data.qvel[self._dof])

    def step(self, force: JointVector) -> None:
        """Advance by dt under the generalized force `(nq,)`."""
        self._data.qfrc_applied[self._dof] = force.numpy()
        self._mujoco.mj_step(self._model, self._data)

    def mass_matrix(self, q: JointVector) -> JointMatrix:
        """MuJoCo's own mass matrix, `(nq, nq)`."""
        data = self._scratch
        self._set(data, q, torch.zeros_like(q))
        self._mujoco.mj_forward(self._model, data)
        return self._tensor(full_mass_matrix(self._model, data)[np.ix_(self._dof, self._dof)])

    def inverse_dynamics(self, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
        """MuJoCo's own `mj_inverse`, `(nq,)`."""
        data = self._scratch
        self._set(data, q, qd)
        data.qacc[self._dof] = qdd.numpy()
        self._mujoco.mj_inverse(self._model, data)
        return self._tensor(data.qfrc_inverse[self._dof])

    def close(self) -> None:
        """Nothing to release: MuJoCo holds no process."""

    def _set(self, data: Any, q: JointVector, qd: JointVector) -> None:
        data.qpos[self._dof] = q.numpy()
        data.qvel[self._dof] = qd.numpy()

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=self._robot.dtype)


def full_mass_matrix(model: Any, data: Any) -> np.ndarray:
    """M `(nv, nv)` of a state whose positions are up to date; `mj_fullM` differs between versions."""
    mujoco, M = import_mujoco(), np.zeros((model.nv, model.nv))
    for column, unit in zip(M, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return M


def import_mujoco() -> Any:
    """The package `mujoco`.

    Raises:
        MissingDependencyError: it is not installed.
    """
    # MuJoCo's classes live in a compiled module that has no stubs.
    try:
        import mujoco
    except ImportError:
        raise MissingDependencyError(
            "the engine 'mujoco' needs the package mujoco", hint='pip install "forcegp[mujoco]"'
        ) from None
    return mujoco
