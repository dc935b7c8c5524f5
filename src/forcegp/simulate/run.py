"""A simulated run: plan a motion, move the robot through it in a physics engine, log what a robot would."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.unilateral import any_row, contact_forces, land
from forcegp.control.plan import Plan, make_plan
from forcegp.control.task_space import control_torque, tool_motion
from forcegp.errors import NumericalError
from forcegp.simulate.config import SimulationConfig
from forcegp.simulate.engine import Engine, make_engine
from forcegp.simulate.result import Log, SimulationResult, make_result
from forcegp.threads import one_thread

RUNAWAY_SPEED = 50.0
"""A joint faster than this [rad/s] is no motion that anybody planned."""
PROGRESS_STRIDE = 24
"""Steps between two calls of the progress function, a tenth of a second at 240 Hz."""

ON_SURFACE = 1e-8
"""A contact is closed at the start where the error is below this [m]; placement leaves less."""

Progress = Callable[[int, int], None]
"""Called with the number of steps done and the number in all."""


def simulate(
    system: ConstrainedSystem, config: SimulationConfig, *, progress: Progress | None = None
) -> SimulationResult:
    """Simulate a motion of the robot, in contact or free, and log it.

    The engine moves the robot under Q_u + Q_D + Q_I + Q_z, where the motor torque Q_u comes from a
    task-space controller, the normal force Q_I from the constrained equations of motion with their
    Baumgarte terms, and Q_z is viscous friction at the contact (section 5 of the paper).

    Surface contacts are unilateral: one opens when its multiplier would turn negative, and closes with an
    inelastic impact. The run is computed on the CPU, where the data stay.

    Args:
        system: robot and contacts; without contacts the motion is free.
        config: what is simulated.
        progress: called every few steps, and after the last.

    Returns:
        The data set with the reference, the actual motion of the tool and figures on the run.

    Raises:
        NumericalError: the motion cannot be reached, or the run diverges (names time and state).
        MissingDependencyError: the engine is not installed.
        ForceGPError: the robot has fewer than six joints.
    """
    system = system.with_robot(system.robot.to(device="cpu"))
    generator = torch.Generator().manual_seed(config.seed)
    with torch.no_grad(), one_thread():
        plan = make_plan(system, config, generator)
        with closing(make_engine(system.robot, config.dt, config.engine)) as engine:
            log = _follow(system, config, plan, engine, progress)
            return make_result(system, config, plan, log, engine.name, generator)


def _follow(
    system: ConstrainedSystem,
    config: SimulationConfig,
    plan: Plan,
    engine: Engine,
    progress: Progress | None,
) -> Log:
    """Step the engine through the plan."""
    log = Log.empty(config.steps, system)
    limit = _torque_limit(system, config)
    closed = _closed_at_start(system, plan.start)
    engine.reset(plan.start, torch.zeros_like(plan.start))
    q, qd = engine.state()
    for k in range(config.steps):
        _check_speed(k * config.dt, q, qd)
        landing = land(system, q, qd, closed)
        if landing.impact:
            qd = landing.qd
            engine.reset(q, qd)
        eom, target = landing.eom, plan.target(k)
        tool = tool_motion(system.robot, eom.poses, eom.motion, qd, plan.frame, plan.point)
        wanted = control_torque(tool, eom, q, qd, target, plan.normal(eom), config.gains)
        Q_u = wanted.clamp(-limit, limit)
        touch = contact_forces(system, q, qd, landing, Q_u, config.viscous_friction)
        engine.step(Q_u + touch.Q_D + touch.Q_I + touch.Q_z)
        log.write(k, q, qd, Q_u, touch, saturated=not torch.equal(Q_u, wanted))
        closed, (q, qd_next) = touch.closed, engine.state()
        log.qdd[k] = (qd_next - qd) / config.dt
        qd = qd_next
        if progress is not None and ((k + 1) % PROGRESS_STRIDE == 0 or k + 1 == config.steps):
            progress(k + 1, config.steps)
    return log


def _torque_limit(system: ConstrainedSystem, config: SimulationConfig) -> Tensor:
    robot = system.robot
    if config.torque_limit is None:
        return robot.effort_limit
    limit = torch.tensor(config.torque_limit, dtype=robot.dtype)
    robot.check_state(torque_limit=limit)
    return limit


def _closed_at_start(system: ConstrainedSystem, q: Tensor) -> Tensor:
    """Constraints that hold at the start; inverse kinematics puts the tool on the surface, up to rounding."""
    c = system.equations(q, torch.zeros_like(q)).c
    return ~any_row(system, c.abs() > ON_SURFACE)


def _check_speed(t: float, q: Tensor, qd: Tensor) -> None:
    if not (bool(torch.isfinite(q).all()) and float(qd.abs().max()) < RUNAWAY_SPEED):
        raise NumericalError(
            f"the simulation diverges at t = {t:.4f} s",
            expected=f"joint speeds below {RUNAWAY_SPEED:g} rad/s",
            got=f"q = {q.tolist()}, qd = {qd.tolist()}",
            hint="smaller gains, a longer travel time, or a rectangle further from the edge of the workspace",
        )
