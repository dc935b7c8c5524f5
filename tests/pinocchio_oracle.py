"""The same quantities from Pinocchio, in the order of our joints."""

from __future__ import annotations

import numpy as np
import pytest

from forcegp.robot.model import RobotModel
from robots import Arm

try:
    import pinocchio as pin
except ModuleNotFoundError:  # it needs a newer NumPy than the library does
    pin = None


class Oracle:
    """Pinocchio's model of an arm, with joint vectors in our order."""

    def __init__(self, arm: Arm, robot: RobotModel) -> None:
        if pin is None:
            pytest.skip("Pinocchio is not installed")
        self.model = pin.buildModelFromUrdf(str(arm.path))
        if arm.locked:
            q = pin.neutral(self.model)
            locked = [self.model.getJointId(name) for name in arm.locked]
            for index, value in zip(locked, arm.locked.values(), strict=True):
                q[self.model.joints[index].idx_q] = value
            self.model = pin.buildReducedModel(self.model, locked, q)
        self.model.gravity.linear = np.array(robot.gravity)
        self.model.armature = np.zeros(self.model.nv)
        self.data = self.model.createData()
        self.joints = [self.model.joints[self.model.getJointId(name)] for name in robot.joint_names]
        self.order = [joint.idx_v for joint in self.joints]

    def vector(self, x: np.ndarray) -> np.ndarray:
        """A velocity-like vector in Pinocchio's order."""
        out = np.zeros(self.model.nv)
        out[self.order] = x
        return out

    def position(self, q: np.ndarray) -> np.ndarray:
        """A configuration; Pinocchio keeps an unlimited joint as (cos, sin)."""
        out = pin.neutral(self.model)
        for joint, value in zip(self.joints, q, strict=True):
            entry = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            out[joint.idx_q : joint.idx_q + joint.nq] = entry
        return out

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """M(q)."""
        M = pin.crba(self.model, self.data, self.position(q))
        M = np.triu(M) + np.triu(M, 1).T
        return M[np.ix_(self.order, self.order)]

    def inverse_dynamics(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """M q̈ − Q_C − Q_G."""
        arguments = self.position(q), self.vector(qd), self.vector(qdd)
        return pin.rnea(self.model, self.data, *arguments)[self.order]

    def forward_dynamics(self, q: np.ndarray, qd: np.ndarray, force: np.ndarray) -> np.ndarray:
        """M⁻¹(force + Q_C + Q_G)."""
        arguments = self.position(q), self.vector(qd), self.vector(force)
        return pin.aba(self.model, self.data, *arguments)[self.order]

    def frame(self, q: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation, position and Jacobian [angular; linear] of a link frame in world axes."""
        index = self.model.getFrameId(name, pin.FrameType.BODY)
        position = self.position(q)
        pin.computeJointJacobians(self.model, self.data, position)
        pin.updateFramePlacements(self.model, self.data)
        J = pin.getFrameJacobian(self.model, self.data, index, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        pose = self.data.oMf[index]
        return pose.rotation, pose.translation, np.vstack([J[3:], J[:3]])[:, self.order]
