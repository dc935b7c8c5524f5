"""Inputs to a rollout: a model, and motor torques from an array, a log, a feedback law or a controller."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, Equations
from forcegp.control.plan import Plan
from forcegp.control.task_space import Gains
from forcegp.data import Dataset
from forcegp.errors import DataError, ModelError, ShapeError, UnknownNameError
from forcegp.forces.quantities import ForceField

STEP = 1.0 / 240.0
"""Step size of a rollout under a feedback law in continuous time [s]."""
INTERPOLATIONS = ("hold", "linear")
EDGE = 1e-6
"""Fraction of a sampling period within which a time counts as a sampling time, to allow for rounding."""
EVEN = 0.02
"""Largest relative deviation of a time step from the sampling period in a log that is replayed."""
CompiledMotion = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, bool], tuple[Tensor, ...]]
"""A function without gradients. It maps q, q̇, τ, closed contacts, step lengths h `(n, 1)` and whether joints
may stick to q̈, λ, the constraint error and its rate, and the joints held by friction."""


class ForwardModel(ABC):
    """Interface of forward dynamics models for rollouts."""

    kind: str
    """Name of the model class in saved files."""
    has_function_samples: bool = False
    """Whether `force_samples` draws functions from a posterior over forces."""

    system: ConstrainedSystem
    """The robot and contacts to which predictions refer."""

    def force_field(self) -> ForceField | None:
        """Return the mean impressed force Q̄ as a force field, or `None` if the model has no forces."""
        return None

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        """Return a force field with several functions drawn from the posterior.

        Args:
            samples: number S of functions.
            generator: random generator.

        Returns:
            A force field on states `(S * k, nq)`. The s-th block of k states belongs to function s.

        Raises:
            ModelError: the model has no posterior over force functions.
        """
        raise ModelError(
            f"a {self.kind!r} model has no function samples", hint="use StructuredGP, or samples=0"
        )

    def compiled_motion(self, system: ConstrainedSystem, force: ForceField) -> CompiledMotion | None:
        """Return C code for the motion under the mean force or its samples, or `None` if unavailable."""
        return None

    @property
    def disturbance(self) -> Disturbance | None:
        """Random forces to be added in the rollouts of function samples, or `None`."""
        return None

    @abstractmethod
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
    ) -> Any:
        """Return `mean` and `std` (or `None`) `(*batch, d)` of a quantity at states `(*batch, nq)`."""


class Disturbance(NamedTuple):
    """Random forces to be added in the rollouts of function samples.

    Attributes:
        density: square root of the spectral density of the torque noise `(nq,)` [N m √s, N √s].
        constant: standard deviation `(nq,)` of an unknown force on each joint [N m, N]. Since its variation
            over time is unknown, the force is constant over a trajectory.
    """

    density: Tensor
    constant: Tensor


@dataclass(frozen=True)
class Reached:
    """The current states of a rollout.

    Attributes:
        system: the robot and its contacts.
        q, qd: positions and velocities, `(n, nq)`.
        active: mask `(n, n_contacts)` of closed contacts.
    """

    system: ConstrainedSystem
    q: Tensor
    qd: Tensor
    active: Tensor

    @cached_property
    def eom(self) -> Equations:
        """Equations of motion at the current states."""
        return self.system.equations(self.q, self.qd, self.active)


class Inputs(ABC):
    """Motor torques as a function of time and state."""

    @property
    def period(self) -> float | None:
        """Sampling period [s], or `None` for a continuous-time law."""
        return None

    @abstractmethod
    def torque(self, t: Tensor, end: Tensor, at: Reached) -> Tensor:
        """Return the motor torque Q_u `(n, nq)` [N m].

        Args:
            t: time, `(n, 1)` [s].
            end: end of the current step, `(n, 1)` [s]. If the torque jumps at `end`, the value before the
                jump is returned.
            at: the current states with their equations of motion.
        """


Torque = Tensor | Dataset | Inputs | Callable[[Tensor, Tensor, Tensor], Tensor]
"""An array `(samples, nq)` or `(*batch, samples, nq)`, a log, whose torques or commanded positions are used,
`Inputs`, or a function of (t, q, q̇)."""


@dataclass(frozen=True)
class Sampled(Inputs):
    """Torques `(n or 1, samples, nq)` with period dt [s], held or interpolated. The last torque is held."""

    values: Tensor
    dt: float
    linear: bool = False

    @property
    def period(self) -> float:
        return self.dt

    def torque(self, t: Tensor, end: Tensor, at: Reached) -> Tensor:
        last = self.values.shape[1] - 1
        k = torch.floor(t / self.dt + EDGE)
        k = torch.minimum(k, torch.ceil(end / self.dt - EDGE) - 1.0).clamp(0, last)
        before = self._at(k)
        if not self.linear:
            return before
        after = self._at((k + 1).clamp(max=last))
        return before + (t / self.dt - k).clamp(0.0, 1.0) * (after - before)

    def _at(self, k: Tensor) -> Tensor:
        index = k[:, 0].long()
        if len(self.values) == 1:
            return self.values[0, index]
        return self.values[torch.arange(len(index), device=index.device), index]


@dataclass(frozen=True)
class Commands(Inputs):
    """Servos that follow commanded positions, τ = k_p (q_c(t) − q) − k_d q̇.

    Args:
        positions: commands q_c, interpolated linearly.
        stiffness, damping: k_p and k_d `(nq,)` [N m/rad, N m s/rad].
    """

    positions: Sampled
    stiffness: Tensor
    damping: Tensor

    @property
    def period(self) -> float:
        """Largest step of at most `STEP` of which the sampling period of the commands is a multiple [s]."""
        return self.positions.dt / math.ceil(self.positions.dt / STEP - 1e-6)

    @classmethod
    def of(cls, log: Dataset) -> Commands:
        """Return the commands of the log of servos.

        Raises:
            DataError: the log lacks commands, or is not a single trajectory with a constant sampling period.
        """
        if "command" not in log.extras:
            raise DataError("the log of servos has no commands", expected="the column 'command'")
        positions = Sampled(log.extras["command"][None], sampling_period(log), linear=True)
        gains = (log.q.new_tensor(x) for x in (log.header.servo_stiffness, log.header.servo_damping))
        return cls(positions, *gains)

    def torque(self, t: Tensor, end: Tensor, at: Reached) -> Tensor:
        ahead = self.positions.torque(t, end, at) - at.q
        return self.stiffness * ahead - self.damping * at.qd


@dataclass(frozen=True)
class Feedback(Inputs):
    """A feedback law that maps tensors `t` `(n, 1)`, `q` `(n, nq)` and `qd` `(n, nq)` to τ `(n, nq)`."""

    function: Callable[[Tensor, Tensor, Tensor], Tensor]

    def torque(self, t: Tensor, end: Tensor, at: Reached) -> Tensor:
        return self.function(t, at.q, at.qd).expand_as(at.q)


@dataclass(frozen=True)
class Disturbed(Inputs):
    """Inputs with additive noise `(n, steps, nq)` [N m]. Each value of the noise is held for dt [s]."""

    inputs: Inputs
    noise: Tensor
    dt: float

    @property
    def period(self) -> float | None:
        return self.inputs.period

    def torque(self, t: Tensor, end: Tensor, at: Reached) -> Tensor:
        return self.inputs.torque(t, end, at) + Sampled(self.noise, self.dt).torque(t, end, at)

    @classmethod
    def drawn(
        cls, inputs: Inputs, by: Disturbance, rows: int, steps: int, dt: float, generator: torch.Generator
    ) -> Disturbed:
        """Draw white noise and a constant force for each of n trajectories."""
        density, constant = by
        white = torch.randn(rows, steps, len(density), generator=generator, dtype=density.dtype)
        kept = torch.randn(rows, 1, len(density), generator=generator, dtype=density.dtype)
        noise = white.to(density.device) * density / dt**0.5 + kept.to(density.device) * constant
        return cls(inputs, noise, dt)


@dataclass(frozen=True)
class TaskSpaceControl(Inputs):
    """The simulator's task-space controller, which tracks a plan with sampling period dt [s].

    The controller uses the analytical mechanics of `system`. `limit` contains the torque limits `(nq,)` [N
    m], which are those of the robot by default.
    """

    system: ConstrainedSystem
    plan: Plan
    dt: float
    gains: Gains
    limit: Tensor | None = None

    @property
    def period(self) -> float:
        return self.dt

    def torque(self, t: Tensor, end: Tensor, at: Reached) -> Tensor:
        robot, eom, q, qd = self.system.robot, at.eom, at.q, at.qd
        if at.system.robot is not robot:
            eom = self.system.equations(q, qd)
        k = torch.floor(t[:, 0] / self.dt + EDGE).long().clamp(max=len(self.plan.reference.t) - 1)
        command = self.plan.command(eom, q, qd, k, self.gains)
        limit = robot.effort_limit if self.limit is None else self.limit
        return command.clamp(-limit, limit)


def inputs_of(
    tau: Torque, batch: torch.Size, rows: int, dt: float | None, interpolation: str = "hold"
) -> Inputs:
    """Return the inputs that `tau` defines for `rows` trajectories, a multiple of the batch size.

    `tau` is an array `(*batch, samples, nq)` or `(samples, nq)` with period dt [s], a log, a feedback law of
    (t, q, q̇), or `Inputs`. A single sample is a constant torque. `interpolation` is `"hold"` or `"linear"`.

    Raises:
        UnknownNameError: the interpolation is unknown.
        ShapeError: the array does not match the initial states.
        ModelError: the sampling period of an array is missing.
        DataError: the log is not a single trajectory with a constant sampling period.
    """
    if interpolation not in INTERPOLATIONS:
        raise UnknownNameError("interpolation", interpolation, INTERPOLATIONS)
    if isinstance(tau, Inputs):
        return tau
    if isinstance(tau, Dataset) and tau.header.servo_stiffness:
        return Commands.of(tau)
    if isinstance(tau, Dataset):
        return Sampled(tau.tau[None], sampling_period(tau), interpolation == "linear")
    if not isinstance(tau, Tensor):
        return Feedback(tau)
    if tau.ndim < 2 or tau.shape[-2] == 0 or tau.shape[:-2] not in (torch.Size(), batch):
        raise ShapeError(
            "the torques do not match the initial states",
            expected=f"shape (samples, nq) or {(*batch, 'samples', 'nq')}",
            got=tuple(tau.shape),
        )
    values = tau.reshape((-1, *tau.shape[-2:]))
    if len(values) > 1:
        values = values.expand(rows // len(values), *values.shape).flatten(0, 1)
    if values.shape[1] == 1:
        return Feedback(lambda t, q, qd: values[:, 0])
    if dt is None:
        raise ModelError(
            "the sampling period of an array of torques is not known",
            expected="the torques with their period",
            got=f"an array of shape {tuple(tau.shape)} without dt",
            hint="pass the log itself instead of log.tau, or options=RolloutOptions(dt=…)",
        )
    return Sampled(values, dt, interpolation == "linear")


def sampling_period(log: Dataset) -> float:
    """Return the sampling period [s] of a log with one trajectory, computed from the logged times.

    Raises:
        DataError: the rows are not in order or not consecutive, or the log has several trajectories or gaps.
    """
    steps = log.t.diff()
    period = float(log.t[-1] - log.t[0]) / max(len(steps), 1)
    one = len(steps) > 0 and log.header.ordered and bool((log.segment == log.segment[0]).all())
    if not one or bool(((steps - period).abs() > EVEN * period).any()):
        raise DataError(
            "the torques of this log cannot be replayed",
            expected="one trajectory of two or more rows in time order, at a constant sampling period",
            got=f"{len(log.t)} rows" + ("" if log.header.ordered else " in selection order"),
            hint="pass the rows of one trajectory, without gaps",
        )
    return period
