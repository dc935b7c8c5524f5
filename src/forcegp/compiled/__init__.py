"""Opt-in compiled dynamics: one fused kernel per robot and quantity, cached on disk.

The robot's figures are folded into the kernel. The eager functions of `forcegp.dynamics` need no
compiler and take robots that are being learned; these are for many evaluations of one robot.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.compiled.build import Kernel, cpu_kernel, cuda_kernel
from forcegp.compiled.program import QUANTITIES, trace
from forcegp.compiled.source import cpu_source, cuda_source
from forcegp.errors import ModelError, ShapeError, UnknownNameError
from forcegp.kinematics import common_states
from forcegp.robot.model import RobotModel

__all__ = ["CompiledDynamics", "compile_dynamics"]


class CompiledDynamics:
    """One quantity of one robot as a compiled function of the joint-space arguments.

    Call it as the function of the same name in `forcegp.dynamics`, without the robot. Derivatives of any
    order are those of that function.
    """

    def __init__(self, robot: RobotModel, quantity: str) -> None:
        self.robot, self.quantity = robot, quantity
        program = trace(robot, quantity)
        on_cuda = robot.device.type == "cuda"
        source = (cuda_source if on_cuda else cpu_source)(program, robot.nq, robot.dtype)
        self._kernel: Kernel = (cuda_kernel if on_cuda else cpu_kernel)(source.text)
        self._arrays, self._arguments, self._shape = source.arrays, program.arguments, program.shape
        self._eager: Callable[..., Tensor] = getattr(dynamics, quantity)

    def __call__(self, *states: Tensor) -> Tensor:
        """The quantity at states `(*batch, nq)`.

        Raises:
            ShapeError: an argument is missing or does not fit the robot.
        """
        if len(states) != len(self._arguments):
            raise ShapeError(
                f"compiled {self.quantity} takes {len(self._arguments)} arguments",
                expected=", ".join(self._arguments),
                got=len(states),
            )
        common = common_states(self.robot, **dict(zip(self._arguments, states, strict=True)))
        return _Kernel.apply(self, *common)  # pyright: ignore[reportReturnType]

    def eager(self, *states: Tensor) -> Tensor:
        """The same by `forcegp.dynamics`."""
        return self._eager(self.robot, *states)

    def run(self, *states: Tensor) -> Tensor:
        """Call the kernel on states of one shape, outside of autograd."""
        batch = states[0].shape[:-1]
        given = {
            name: x.reshape((math.prod(batch), self.robot.nq)).contiguous()
            for name, x in zip(self._arguments, states, strict=True)
        }
        turned = {"sin": torch.sin, "cos": torch.cos}
        arrays = [turned[name](given["q"]) if name in turned else given[name] for name in self._arrays]
        out = torch.empty((math.prod(batch), *self._shape), dtype=self.robot.dtype, device=self.robot.device)
        if out.shape[0]:
            self._kernel(arrays, out)
        return out.reshape((*batch, *self._shape))


class _Kernel(torch.autograd.Function):
    """The kernel under autograd and torch.func, with the derivatives of the eager function."""

    @staticmethod
    def forward(compiled: CompiledDynamics, *states: Tensor) -> Tensor:
        return compiled.run(*states)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.compiled = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])

    @staticmethod
    def backward(ctx, gradient):  # pyright: ignore[reportIncompatibleMethodOverride]
        _, pull = torch.func.vjp(ctx.compiled.eager, *ctx.saved_tensors)
        return None, *pull(gradient)

    @staticmethod
    def jvp(ctx, _, *tangents):  # pyright: ignore[reportIncompatibleMethodOverride]
        given = tuple(
            torch.zeros_like(x) if t is None else t for x, t in zip(ctx.saved_tensors, tangents, strict=True)
        )
        return torch.func.jvp(ctx.compiled.eager, ctx.saved_tensors, given)[1]

    @staticmethod
    def vmap(info, in_dims, compiled, *states):  # pyright: ignore[reportIncompatibleMethodOverride]
        moved = [
            x.expand(info.batch_size, *x.shape) if d is None else x.movedim(d, 0)
            for x, d in zip(states, in_dims[1:], strict=True)
        ]
        return _Kernel.apply(compiled, *moved), 0


def compile_dynamics(robot: RobotModel, quantity: str = "forward_dynamics") -> CompiledDynamics:
    """Compile a function of `forcegp.dynamics` for one robot.

    The first call on a machine runs its C++ compiler (a few seconds); later ones, in any process, read
    the kernel from the cache (`$FORCEGP_CACHE`, or `forcegp` in the user's cache folder). On a CUDA robot
    the kernel is compiled by NVRTC in each process.

    Args:
        robot: the robot; its figures become constants.
        quantity: `forward_dynamics`, `inverse_dynamics`, `mass_matrix`, `bias_force` or `gravity_force`.

    Returns:
        A function of `(q, qd, force)`, `(q, qd, qdd)`, `(q)`, `(q, qd)` or `(q)`.

    Raises:
        UnknownNameError: no such quantity.
        ModelError: a figure of the robot is being learned, or its precision has no kernel.
        MissingDependencyError: there is no compiler.
    """
    if quantity not in QUANTITIES:
        raise UnknownNameError("quantity to compile", quantity, QUANTITIES)
    learned = [
        field.name
        for field in dataclasses.fields(robot)
        if isinstance(value := getattr(robot, field.name), Tensor) and value.requires_grad
    ]
    if learned:
        raise ModelError(
            "a robot whose figures require a gradient cannot be compiled, as they become constants",
            got=", ".join(learned),
            hint="use forcegp.dynamics while learning, and compile the robot with detached figures afterwards",
        )
    if robot.dtype not in (torch.float64, torch.float32):
        raise ModelError(
            "the compiled dynamics have no kernel in this precision",
            expected="float64 or float32",
            got=robot.dtype,
        )
    return CompiledDynamics(robot, quantity)
