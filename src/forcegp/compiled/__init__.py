"""Opt-in compiled dynamics with one fused kernel per robot and quantity, cached on disk.

The robot's parameters are compiled into the kernel as constants. Use compiled functions to evaluate one robot
many times. The eager functions in `forcegp.dynamics` need no compiler and accept learned robots.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor

from forcegp import derivatives, dynamics
from forcegp.compiled.program import QUANTITIES, trace
from forcegp.compiled.source import Kernel, cpu_kernel, cpu_source, cuda_kernel, cuda_source
from forcegp.errors import ModelError, ShapeError, check_name
from forcegp.kinematics import common_states
from forcegp.robot.model import RobotModel

__all__ = ["CompiledDynamics", "compile_dynamics"]


def _stacked_derivatives(robot: RobotModel, q: Tensor, qd: Tensor, force: Tensor) -> Tensor:
    return torch.stack(derivatives.forward_dynamics_derivatives(robot, q, qd, force), dim=-3)


class CompiledDynamics:
    """A robot quantity, such as the mass matrix, compiled as a function of joint-space arguments.

    Call it like the eager function of the same name, but without the robot. Derivatives of any order are
    those of the eager function. First derivatives of forward dynamics use a kernel built on first use.
    """

    def __init__(self, robot: RobotModel, quantity: str) -> None:
        self.robot, self.quantity = robot, quantity
        program = trace(robot, quantity)
        on_cuda = robot.device.type == "cuda"
        source = (cuda_source if on_cuda else cpu_source)(program, robot.nq, robot.dtype)
        self._kernel: Kernel = (cuda_kernel if on_cuda else cpu_kernel)(source.text)
        self._arrays, self._arguments, self._shape = source.arrays, program.arguments, program.shape
        stacked = quantity == "forward_dynamics_derivatives"
        self._eager: Callable[..., Tensor] = _stacked_derivatives if stacked else getattr(dynamics, quantity)

    @cached_property
    def _jacobians(self) -> CompiledDynamics:
        return CompiledDynamics(self.robot, "forward_dynamics_derivatives")

    def __call__(self, *states: Tensor) -> Tensor:
        """Return the quantity at the given states `(*batch, nq)`.

        Raises:
            ShapeError: an argument is missing or does not match the robot.
        """
        if len(states) != len(self._arguments):
            text = f"compiled {self.quantity} takes {len(self._arguments)} arguments"
            raise ShapeError(text, expected=", ".join(self._arguments), got=len(states))
        common = common_states(self.robot, **dict(zip(self._arguments, states, strict=True)))
        return _Kernel.apply(self, *common)  # pyright: ignore[reportReturnType]

    def eager(self, *states: Tensor) -> Tensor:
        """Evaluate the eager function at the given states."""
        return self._eager(self.robot, *states)

    def pull(self, gradient: Tensor, *states: Tensor) -> tuple[Tensor, ...]:
        """Return the product of gradientᵀ and the Jacobian with respect to each state."""
        if self.quantity == "forward_dynamics" and not torch.is_grad_enabled():
            jacobians = self._jacobians.run(*states)
            return (gradient[..., None, None, :] @ jacobians)[..., 0, :].unbind(-2)
        return torch.func.vjp(self.eager, *states)[1](gradient)

    def run(self, *states: Tensor) -> Tensor:
        """Run the kernel on states of equal shape, without autograd."""
        batch = states[0].shape[:-1]
        values = {
            name: x.reshape((math.prod(batch), self.robot.nq)).contiguous()
            for name, x in zip(self._arguments, states, strict=True)
        }
        turned = {"sin": torch.sin, "cos": torch.cos}
        arrays = [turned[name](values["q"]) if name in turned else values[name] for name in self._arrays]
        out = torch.empty((*batch, *self._shape), dtype=self.robot.dtype, device=self.robot.device)
        if out.numel():
            self._kernel(arrays, out.view((-1, *self._shape)))
        return out


class _Kernel(torch.autograd.Function):
    """The kernel as a function for autograd and torch.func, with the derivatives of the eager function."""

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
        return None, *ctx.compiled.pull(gradient, *ctx.saved_tensors)

    @staticmethod
    def jvp(ctx, _, *tangents):  # pyright: ignore[reportIncompatibleMethodOverride]
        states = ctx.saved_tensors
        pairs = zip(states, tangents, strict=True)
        directions = tuple(torch.zeros_like(x) if t is None else t for x, t in pairs)
        # PyTorch cannot nest forward mode, so J t is computed as the derivative of Jᵀ u with respect to u.
        value, pull = torch.func.vjp(ctx.compiled.eager, *states)[:2]
        return torch.func.vjp(pull, torch.zeros_like(value))[1](directions)[0].contiguous()

    @staticmethod
    def vmap(info, in_dims, compiled, *states):  # pyright: ignore[reportIncompatibleMethodOverride]
        moved = [
            x.expand(info.batch_size, *x.shape) if d is None else x.movedim(d, 0)
            for x, d in zip(states, in_dims[1:], strict=True)
        ]
        return _Kernel.apply(compiled, *moved), 0


def compile_dynamics(robot: RobotModel, quantity: str = "forward_dynamics") -> CompiledDynamics:
    """Compile a function of `forcegp.dynamics`, or the function of its derivatives, for one robot.

    The first call runs the local C++ compiler. This takes about one second for an arm, ten for a hand, and
    minutes for a hundred joints. Later calls in any process load the kernel from the cache (`$FORCEGP_CACHE`,
    or `forcegp` in the user's cache folder). On a CUDA device, NVRTC compiles the kernel in each process.

    Args:
        robot: the robot. Its parameters become constants.
        quantity: `forward_dynamics`, `forward_dynamics_derivatives`, `inverse_dynamics`, `mass_matrix`,
            `bias_force` or `gravity_force`.

    Returns:
        A function of the same states as the eager function. Derivatives with respect to q, q̇ and force are
        returned as one tensor `(*batch, 3, nq, nq)`.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> q = torch.zeros(5, 2, dtype=torch.float64)
        >>> fast = compile_dynamics(robot, "forward_dynamics")  # doctest: +SKIP
        >>> fast(q, 0 * q, 0 * q).shape  # doctest: +SKIP

    Raises:
        UnknownNameError: the quantity does not exist.
        ModelError: a parameter of the robot requires a gradient, or the robot's precision is not supported.
        MissingDependencyError: there is no compiler.
    """
    check_name("quantity to compile", quantity, QUANTITIES)
    if robot.learned:
        raise ModelError(
            "a robot with parameters that require a gradient cannot be compiled, since compilation makes "
            "them constants",
            got=", ".join(robot.learned),
            hint="use forcegp.dynamics while learning, and compile a detached robot afterwards",
        )
    if robot.dtype not in (torch.float64, torch.float32):
        text = "the compiled dynamics do not support this precision"
        raise ModelError(text, expected="float64 or float32", got=robot.dtype)
    return CompiledDynamics(robot, quantity)
