"""Protocol for physics engines, and their comparison with the library's equations of motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.constraints import ConstrainedSystem
from forcegp.types import JointMatrix, JointVector


@runtime_checkable
class Engine(Protocol):
    """A physics engine with one robot and no forces other than gravity.

    A step uses the semi-implicit Euler method, q̇ₖ₊₁ = q̇ₖ + dt q̈(qₖ, q̇ₖ) and qₖ₊₁ = qₖ + dt q̇ₖ₊₁. The
    acceleration during a step is therefore (q̇ₖ₊₁ − q̇ₖ)/dt. Contacts, collisions, joint limits, motors and
    damping are disabled. All forces except gravity are passed to `step`.
    """

    @property
    def name(self) -> str:
        """Name and version of the engine."""
        ...

    @property
    def dt(self) -> float:
        """Step size [s]."""
        ...

    def reset(self, q: JointVector, qd: JointVector) -> None:
        """Set the positions q and velocities qd, `(nq,)` each."""
        ...

    def state(self) -> tuple[JointVector, JointVector]:
        """Return the current q and qd, `(nq,)` each [rad, rad/s]."""
        ...

    def step(self, force: JointVector) -> None:
        """Advance by dt under a generalized force `(nq,)` [N m] that excludes gravity and bias forces."""
        ...

    def mass_matrix(self, q: JointVector) -> JointMatrix:
        """Return M(q) `(nq, nq)`, computed by the engine."""
        ...

    def inverse_dynamics(self, q: JointVector, qd: JointVector, qdd: JointVector) -> JointVector:
        """Return M q̈ − Q_C − Q_G `(nq,)`, computed by the engine."""
        ...

    def close(self) -> None:
        """Release the engine's resources."""
        ...


@dataclass(frozen=True)
class EngineCheck:
    """Largest differences between an engine and the library at random states.

    Attributes:
        engine: name and version of the engine.
        states: number of compared states.
        mass_matrix: difference in the mass matrix [kg m²].
        inverse_dynamics: difference in inverse dynamics [N m].
        free_acceleration: difference in acceleration over one step under a random force [rad/s²].
        constrained_acceleration: the same with an additional constraint force and joint friction [rad/s²].
        largest_acceleration: largest acceleration in any step, as a reference for scale [rad/s²].
    """

    engine: str
    states: int
    mass_matrix: float
    inverse_dynamics: float
    free_acceleration: float
    constrained_acceleration: float
    largest_acceleration: float

    def __str__(self) -> str:
        return (
            f"{self.engine}, {self.states} random states, largest differences: "
            f"mass matrix {self.mass_matrix:.1e} kg m², inverse dynamics {self.inverse_dynamics:.1e} N m, "
            f"free acceleration {self.free_acceleration:.1e} rad/s², "
            f"constrained acceleration {self.constrained_acceleration:.1e} rad/s² "
            f"(of {self.largest_acceleration:.0f})"
        )


def check_engine(
    system: ConstrainedSystem, engine: Engine, generator: torch.Generator, states: int = 50
) -> EngineCheck:
    """Return the largest differences between an engine and the library at random states of a system.

    Angles lie within ±π. Speeds and accelerations are a few rad/s and rad/s².
    """
    robot = system.robot

    def draw(scale: float) -> Tensor:
        return scale * torch.randn(states, robot.nq, dtype=torch.float64, generator=generator).to(robot.dtype)

    with torch.no_grad():
        turns = torch.rand(states, robot.nq, dtype=torch.float64, generator=generator).to(robot.dtype)
        q, qd, qdd, force = math.pi * (2.0 * turns - 1.0), draw(1.0), draw(5.0), draw(20.0)
        eom = system.equations(q, qd)
        Q_bar = eom.Q_K + force
        free = dynamics.forward_dynamics(robot, q, qd, force)
        constrained = eom.acceleration(Q_bar)
        held = force + eom.Q_D + eom.constraint_force(Q_bar)
        needed = torch.stack([engine.inverse_dynamics(*x) for x in zip(q, qd, qdd, strict=True)])
        return EngineCheck(
            engine=engine.name,
            states=states,
            mass_matrix=_largest(torch.stack([engine.mass_matrix(x) for x in q]) - eom.M),
            inverse_dynamics=_largest(needed - dynamics.inverse_dynamics(robot, q, qd, qdd)),
            free_acceleration=_largest(_step(engine, q, qd, force) - free),
            constrained_acceleration=_largest(_step(engine, q, qd, held) - constrained),
            largest_acceleration=max(_largest(free), _largest(constrained)),
        )


def _step(engine: Engine, q: Tensor, qd: Tensor, force: Tensor) -> Tensor:
    """Return the accelerations over one step from each state."""
    accelerations = []
    for state in zip(q, qd, force, strict=True):
        engine.reset(state[0], state[1])
        engine.step(state[2])
        accelerations.append((engine.state()[1] - state[1]) / engine.dt)
    return torch.stack(accelerations)


def _largest(difference: Tensor) -> float:
    return float(difference.abs().max())
