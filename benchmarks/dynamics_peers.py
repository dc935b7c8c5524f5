"""The other libraries of the dynamics benchmark, each behind `prepare(quantity, q, qd, force) -> call`."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

Call = Callable[[], object]
"""Computes the whole batch once; returns the result where it is an acceleration or a mass matrix."""


class Pinocchio:
    """Pinocchio, one state at a time from Python, and its own threaded batch."""

    def __init__(self, urdf: Path, frame: str, point: tuple[float, float, float], threads: int) -> None:
        import pinocchio as pin

        self.pin, self.threads = pin, threads
        self.model = pin.buildModelFromUrdf(str(urdf))
        self.model.armature[:] = 0.0
        self.data = self.model.createData()
        self.pool = pin.ModelPool(self.model, threads)
        parent = self.model.frames[self.model.getFrameId(frame)]
        placement = parent.placement * pin.SE3(np.eye(3), np.array(point))
        self.tip = self.model.addFrame(
            pin.Frame("tip", parent.parentJoint, placement, pin.FrameType.OP_FRAME)
        )
        self.data = self.model.createData()

    def loop(self, quantity: str, *states: Tensor) -> Call | None:
        q, v, tau = (x.numpy() for x in states)
        one = {
            "forward_dynamics": lambda i: self.pin.aba(self.model, self.data, q[i], v[i], tau[i]).copy(),
            "mass_matrix": lambda i: self._mass_matrix(q[i]),
            "constraint_terms": lambda i: self._constraint_terms(q[i], v[i]),
            "gradient": lambda i: [
                np.array(x) for x in self.pin.computeABADerivatives(self.model, self.data, q[i], v[i], tau[i])
            ],
        }[quantity]
        if quantity in ("forward_dynamics", "mass_matrix"):
            return lambda: np.stack([one(i) for i in range(len(q))])
        return lambda: [one(i) for i in range(len(q))] and None

    def threaded(self, quantity: str, *states: Tensor) -> Call | None:
        if quantity != "forward_dynamics":
            return None
        # The columns are the states; the layout that Pinocchio wants is made outside of the timing.
        q, v, tau = (np.asfortranarray(x.numpy().T) for x in states)
        out = np.empty_like(v)

        def call() -> np.ndarray:
            self.pin.abaInParallel(self.threads, self.pool, q, v, tau, out)
            return out.T

        return call

    def _mass_matrix(self, q: np.ndarray) -> np.ndarray:
        M = self.pin.crba(self.model, self.data, q)
        return np.triu(M) + np.triu(M, 1).T

    def _constraint_terms(self, q: np.ndarray, v: np.ndarray) -> tuple:
        """M, bias, A, b, L, T, H for one row along the vertical."""
        pin, model, data = self.pin, self.model, self.data
        pin.forwardKinematics(model, data, q, v, 0.0 * v)
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        A = pin.computeFrameJacobian(model, data, q, self.tip, axes)[2:3]
        M, bias = self._mass_matrix(q), pin.nonLinearEffects(model, data, q, v)
        pin.forwardKinematics(model, data, q, v, 0.0 * v)
        b = -pin.getFrameClassicalAcceleration(model, data, self.tip, axes).linear[2:3]
        inverse = np.linalg.inv(M)
        L = inverse @ A.T / (A @ inverse @ A.T)
        T = np.eye(len(q)) - L @ A
        return M, bias, A, b, L, T, T @ inverse


class Adam:
    """adam-robotics on PyTorch: composite inertias and Newton-Euler of the fixed-base arm, then a solve."""

    def __init__(self, urdf: Path, joints: tuple[str, ...]) -> None:
        from adam.pytorch import KinDynComputationsBatch

        gravity = torch.tensor([0.0, 0.0, -9.81, 0.0, 0.0, 0.0], dtype=torch.float64)
        self.kin = KinDynComputationsBatch(
            str(urdf), list(joints), device=torch.device("cpu"), dtype=torch.float64, gravity=gravity
        )

    def prepare(self, quantity: str, *states: Tensor) -> Call | None:
        q = states[0]
        base = torch.eye(4, dtype=q.dtype).expand(len(q), 4, 4).contiguous()
        still = torch.zeros(len(q), 6, dtype=q.dtype)

        def matrix(q: Tensor) -> Tensor:
            M = self.kin.mass_matrix(base, q)
            return M.reshape(len(q), *M.shape[-2:])[:, 6:, 6:]

        def acceleration(q: Tensor, qd: Tensor, force: Tensor) -> Tensor:
            bias = self.kin.bias_force(base, q, still, qd).reshape(len(q), -1)[:, 6:]
            return torch.linalg.solve(matrix(q), (force - bias)[..., None])[..., 0]

        return torch_call(quantity, matrix, acceleration, *states)


class DifferentiableRobotModel:
    """differentiable-robot-model: its articulated-body algorithm and its mass matrix, in float64."""

    def __init__(self, urdf: Path) -> None:
        from differentiable_robot_model.robot_model import DifferentiableRobotModel as Model

        logging.disable(logging.WARNING)
        # Its constants are float32 by name; read under that name as float64 they are compared like for like.
        doubled = mock.patch.object(torch, "float32", torch.float64)
        with _float64(), doubled, contextlib.redirect_stdout(io.StringIO()):
            self.model = Model(str(urdf), "arm", device="cpu")

    def prepare(self, quantity: str, *states: Tensor) -> Call | None:
        def matrix(q: Tensor) -> Tensor:
            with _float64():
                return self.model.compute_lagrangian_inertia_matrix(q)

        def acceleration(q: Tensor, qd: Tensor, force: Tensor) -> Tensor:
            with _float64():
                return self.model.compute_forward_dynamics(q, qd, force, use_damping=False)

        return torch_call(quantity, matrix, acceleration, *states)


class Mujoco:
    """MuJoCo's `mj_forward`, one state at a time from Python."""

    def __init__(self, urdf: Path) -> None:
        mujoco: Any = importlib.import_module("mujoco")
        self.mujoco = mujoco
        self.model = mujoco.MjModel.from_xml_path(str(urdf))
        self.model.dof_damping[:] = 0.0
        self.model.dof_frictionloss[:] = 0.0
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        self.data = mujoco.MjData(self.model)

    def prepare(self, quantity: str, *states: Tensor) -> Call | None:
        q, v, tau = (x.numpy() for x in states)
        mujoco, model, data = self.mujoco, self.model, self.data

        def acceleration(i: int) -> np.ndarray:
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q[i], v[i], tau[i]
            mujoco.mj_forward(model, data)
            return data.qacc.copy()

        if quantity != "forward_dynamics":
            return None
        return lambda: np.stack([acceleration(i) for i in range(len(q))])


class Frax:
    """frax on JAX, compiled for a batch, in float64, on the GPU if JAX has one."""

    def __init__(self, urdf: Path) -> None:
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        jax: Any = importlib.import_module("jax")
        jax.config.update("jax_enable_x64", True)
        # It refuses a base without inertia, though the inertia of a base that is fixed has no effect.
        base = (
            '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
        )
        text = re.sub(r"(<link [^>]*>)(?!\s*<inertial)", rf"\1{base}", urdf.read_text(encoding="utf-8"))
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / urdf.name
            copy.write_text(text, encoding="utf-8")
            robot, self.jax = importlib.import_module("frax").Robot(str(copy)), jax

        def acceleration(q: Any, qd: Any, force: Any) -> Any:
            return robot.forward_dynamics(q, qd, force, None)

        each = jax.vmap(acceleration)
        self.functions = {
            "forward_dynamics": jax.jit(each),
            "mass_matrix": jax.jit(jax.vmap(lambda q, qd, force: robot.crba(q))),
            "gradient": jax.jit(jax.grad(lambda *x: each(*x).sum(), (0, 1, 2))),
            "jacobians": jax.jit(jax.vmap(jax.jacfwd(acceleration, (0, 1, 2)))),
        }

    def prepare(self, quantity: str, *states: Tensor) -> Call | None:
        if quantity not in self.functions:
            return None
        function, arrays = self.functions[quantity], [self.jax.device_put(x.numpy()) for x in states]
        return lambda: self.jax.block_until_ready(function(*arrays))


def torch_call(
    quantity: str,
    matrix: Callable[[Tensor], Tensor],
    acceleration: Callable[[Tensor, Tensor, Tensor], Tensor],
    *states: Tensor,
) -> Call | None:
    """The call of a PyTorch implementation: values without a graph, or one backward pass."""

    def value(function: Callable[..., Tensor], *arguments: Tensor) -> Tensor:
        with torch.no_grad():
            return function(*arguments)

    def gradient() -> None:
        inputs = [x.detach().requires_grad_() for x in states]
        torch.autograd.grad(acceleration(*inputs).sum(), inputs)

    return {
        "forward_dynamics": lambda: value(acceleration, *states),
        "mass_matrix": lambda: value(matrix, states[0]),
        "gradient": gradient,
    }.get(quantity)


@contextlib.contextmanager
def _float64():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
