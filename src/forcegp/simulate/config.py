"""Settings of a simulation: the motion and the simulated world."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from forcegp.control.plan import NOT_NEGATIVE, MotionConfig, check_setting

CONTACTS = ("rigid", "solver")
LONGEST_STEP = 5e-4
"""Longest step of the contact solver [s], an eighth of the default time constant of a contact."""
WHOLE = 1e-6
"""Tolerance for ratios that should be integers."""


@dataclass(frozen=True)
class ContactSolver:
    """Settings for MuJoCo's contact solver: dry friction in joints and contacts, and a rounded tip.

    Args:
        friction: Coulomb friction coefficient μ between the tool and the surface.
        tip_radius: radius [m] of a sphere that ends at the contact point, if the contact has no radius.
        joint_friction: additional Coulomb friction of each joint [N m], or empty for none.
        joint_damping: additional viscous friction coefficient of each joint [N m s/rad], or empty for none.
        stiffness_time: time constant of the contact's restoring force [s]. A shorter time is stiffer.
        step: step size of the engine, which must divide the sampling period [s]. The default is the longest
            such step up to `LONGEST_STEP`.

    Raises:
        ParameterError: a value is out of range. The message names it.
    """

    friction: float = 0.3
    tip_radius: float = 0.015
    joint_friction: tuple[float, ...] = ()
    joint_damping: tuple[float, ...] = ()
    stiffness_time: float = 0.004
    step: float | None = None

    def __post_init__(self) -> None:
        for name in ("tip_radius", "stiffness_time", "step"):
            value = getattr(self, name)
            if value is not None:
                check_setting(name, 0.0 < value < float("inf"), "a positive finite number", value)
        for name in ("joint_friction", "joint_damping"):
            values = getattr(self, name)
            valid = all(0.0 <= x < float("inf") for x in values)
            check_setting(name, valid, "finite numbers, 0 or above", values)
        check_setting("friction", 0.0 <= self.friction < float("inf"), NOT_NEGATIVE, self.friction)

    def substeps(self, dt: float) -> int:
        """Return the engine steps per period dt [s]; raise `ParameterError` unless `step` divides dt."""
        if self.step is None:
            return math.ceil(dt / LONGEST_STEP - WHOLE)
        steps = dt / self.step
        whole = steps > 0.5 and abs(steps - round(steps)) < WHOLE
        check_setting("step", whole, f"a divisor of dt = {dt} s", self.step)
        return round(steps)


@dataclass(frozen=True)
class Sensors:
    """Sensors, perfect by default, which provide the values for the controller and the log.

    Args:
        encoder_resolution: resolution of the measured joint positions [rad, m].
        velocity_noise: standard deviation of the noise in q̇ [rad/s, m/s].
        torque_noise: standard deviation of the noise in the logged torque [N m, N].
        torque_delay: delay of the logged torque relative to the motion [s], rounded to whole samples.

    Raises:
        ParameterError: a value is out of range. The message names it.
    """

    encoder_resolution: float = 0.0
    velocity_noise: float = 0.0
    torque_noise: float = 0.0
    torque_delay: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_setting(name, 0.0 <= value < float("inf"), NOT_NEGATIVE, value)


@dataclass(frozen=True)
class SimulationConfig(MotionConfig):
    """Settings of a simulation. The defaults are the paper's task on the bundled arm.

    The following settings are added to those of the motion (`MotionConfig`).

    Args:
        seed: random seed for the waypoints, the postures and the noise.
        engine: `"pybullet"`, `"mujoco"` or `"auto"`.
        contact: `"rigid"` computes contact forces with the library's equations of motion. `"solver"` uses
            MuJoCo's contact solver, which is an independent reference.
        viscous_friction: θ_v in F_z = −θ_v ṗ_E, tangential to the surface, for rigid contact [N s/m].
        noise_std: standard deviation of the noise in q̈ [rad/s²].
        solver: friction and geometry for `contact="solver"`.
        sensors: resolution, noise and delay of the measurements for `contact="solver"`.

    Example:
        >>> SimulationConfig(duration=2.0).steps
        480

    Raises:
        ParameterError: a value is out of range. The message names it.
    """

    seed: int = 0
    engine: str = "auto"
    contact: str = "rigid"
    viscous_friction: float = 1.0
    noise_std: float = 0.1
    solver: ContactSolver = field(default_factory=ContactSolver)
    sensors: Sensors = field(default_factory=Sensors)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("viscous_friction", "noise_std"):
            self._check(name, 0.0 <= getattr(self, name) < float("inf"), NOT_NEGATIVE)
        self._check("contact", self.contact in CONTACTS, "'rigid' or 'solver'")
        if self.contact == "solver":
            self._check("engine", self.engine in ("auto", "mujoco"), "'mujoco', whose solver it is")
            self.solver.substeps(self.dt)
