"""Random trees of revolute and prismatic joints, and the same trees in Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from forcegp.robot.model import BASE, JointType, RobotModel

try:
    import pinocchio as pin
except ModuleNotFoundError:  # it needs a newer NumPy than the library does
    pin = None


def _rotation(random: np.random.Generator) -> np.ndarray:
    Q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return Q * np.sign(np.linalg.det(Q))


def _inertia(random: np.random.Generator) -> np.ndarray:
    """Inertia of a box of random size and turn: physical by construction."""
    a, b, c = random.uniform(0.05, 0.4, 3) ** 2
    R = _rotation(random)
    return R @ np.diag([b + c, a + c, a + b]) @ R.T * random.uniform(0.2, 1.0)


def random_robot(seed: int, nq: int = 6, aligned: bool = False) -> RobotModel:
    """A robot whose joints hang on any earlier joint or the base; `aligned` keeps axes on x, y, z.

    The order of the joints is any in which parents come first, not only depth first.
    """
    random = np.random.default_rng(seed)
    axis = np.eye(3)[random.integers(0, 3, nq)] if aligned else random.normal(size=(nq, 3))
    kinds: list[JointType] = ["prismatic" if random.random() < 0.3 else "revolute" for _ in range(nq)]

    def t(x: object) -> torch.Tensor:
        return torch.as_tensor(np.asarray(x, dtype=float))

    turn = [np.eye(3) if aligned else _rotation(random) for _ in range(nq)]
    zero, unlimited = torch.zeros(nq, dtype=torch.float64), torch.full((nq,), torch.inf, dtype=torch.float64)
    names = tuple(f"joint{i}" for i in range(nq))
    return RobotModel(
        name=f"random{seed}",
        joint_names=names,
        joint_types=tuple(kinds),
        parents=tuple(int(random.integers(max(BASE, i - 3), i)) for i in range(nq)),
        placement_rotation=t(turn),
        placement_position=t(random.normal(size=(nq, 3)) * 0.3),
        axis=t(axis / np.linalg.norm(axis, axis=1, keepdims=True)),
        mass=t(random.uniform(0.5, 3.0, nq)),
        com=t(random.normal(size=(nq, 3)) * 0.1),
        inertia=t([_inertia(random) for _ in range(nq)]),
        damping=zero,
        friction=zero,
        stribeck=zero,
        stribeck_velocity=zero + 0.1,
        friction_velocity=zero + 0.01,
        armature=t(random.uniform(0.0, 0.2, nq)),
        lower=-unlimited,
        upper=unlimited,
        velocity_limit=unlimited,
        effort_limit=unlimited,
        frame_names=("base", *(f"link{i}" for i in range(nq)), "tool"),
        frame_parents=(BASE, *range(nq), nq - 1),
        frame_rotation=t([np.eye(3)] * (nq + 1) + [_rotation(random)]),
        frame_position=t([np.zeros(3)] * (nq + 1) + [[0.1, -0.2, 0.3]]),
        base_rotation=t(_rotation(random)),
        base_position=t(random.normal(size=3)),
        gravity=t(random.normal(size=3) * 5.0),
    )


class Mirror:
    """The same tree in Pinocchio, with vectors and matrices in our order of joints."""

    def __init__(self, robot: RobotModel) -> None:
        if pin is None:
            pytest.skip("Pinocchio is not installed")
        self.model = pin.Model()
        self.model.gravity.linear = robot.gravity.numpy()
        self._add(robot, BASE, 0)
        self.data = self.model.createData()
        self.ids = [self.model.getJointId(name) for name in robot.joint_names]
        self.order = [self.model.joints[i].idx_v for i in self.ids]
        armature = np.zeros(robot.nq)
        armature[self.order] = robot.armature.numpy()
        self.model.armature = armature

    def _add(self, robot: RobotModel, parent: int, parent_id: int) -> None:
        """Add the children of a joint depth first, as Pinocchio's algorithms require."""
        for i in [i for i, p in enumerate(robot.parents) if p == parent]:
            placement = pin.SE3(robot.placement_rotation[i].numpy(), robot.placement_position[i].numpy())
            if parent == BASE:
                placement = pin.SE3(robot.base_rotation.numpy(), robot.base_position.numpy()) * placement
            revolute = robot.joint_types[i] == "revolute"
            kind = pin.JointModelRevoluteUnaligned if revolute else pin.JointModelPrismaticUnaligned
            joint = self.model.addJoint(
                parent_id, kind(robot.axis[i].numpy()), placement, robot.joint_names[i]
            )
            figures = float(robot.mass[i]), robot.com[i].numpy(), robot.inertia[i].numpy()
            self.model.appendBodyToJoint(joint, pin.Inertia(*figures), pin.SE3.Identity())
            self._add(robot, i, joint)

    def sorted(self, x: torch.Tensor) -> np.ndarray:
        """A joint vector in Pinocchio's order."""
        out = np.zeros(self.model.nv)
        out[self.order] = x.numpy()
        return out

    def matrix(self, X: np.ndarray) -> np.ndarray:
        """A joint-space matrix in our order."""
        return X[np.ix_(self.order, self.order)]

    def mass_matrix(self, q: torch.Tensor) -> np.ndarray:
        M = np.triu(pin.crba(self.model, self.data, self.sorted(q)))
        return self.matrix(M + np.triu(M, 1).T)

    def inverse_dynamics(self, *states: torch.Tensor) -> np.ndarray:
        return pin.rnea(self.model, self.data, *map(self.sorted, states))[self.order]

    def forward_dynamics(self, *states: torch.Tensor) -> np.ndarray:
        return pin.aba(self.model, self.data, *map(self.sorted, states))[self.order]

    def gravity_force(self, q: torch.Tensor) -> np.ndarray:
        return -pin.computeGeneralizedGravity(self.model, self.data, self.sorted(q))[self.order]

    def forward_derivatives(self, *states: torch.Tensor) -> list[np.ndarray]:
        found = pin.computeABADerivatives(self.model, self.data, *map(self.sorted, states))
        inverse = np.triu(found[2]) + np.triu(found[2], 1).T
        return [self.matrix(np.array(x)) for x in (found[0], found[1], inverse)]

    def inverse_derivatives(self, *states: torch.Tensor) -> list[np.ndarray]:
        dq, dqd, M = pin.computeRNEADerivatives(self.model, self.data, *map(self.sorted, states))
        M = np.triu(M) + np.triu(M, 1).T
        return [self.matrix(np.array(x)) for x in (dq, dqd, M)]

    def link_pose(self, q: torch.Tensor, link: int) -> tuple[np.ndarray, np.ndarray]:
        pin.forwardKinematics(self.model, self.data, self.sorted(q))
        pose = self.data.oMi[self.ids[link]]
        return pose.rotation, pose.translation
