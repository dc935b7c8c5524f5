"""A simulated run: plan a motion, move the robot through it in a physics engine, log what a robot would."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import torch

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.unilateral import any_row, contact_forces, land
from forcegp.control.plan import Plan, make_plan
from forcegp.control.task_space import Target, control_torque
from forcegp.resources import one_thread
from forcegp.simulate.config import SimulationConfig
from forcegp.simulate.contact_solver import ContactSolverEngine
from forcegp.simulate.engine import Engine, make_engine
from forcegp.simulate.guard import Progress, check_speed, report, torque_limit
from forcegp.simulate.mechanics import Mechanics
from forcegp.simulate.result import Log, SimulationResult, make_result
from forcegp.simulate.solver_run import follow_with_solver

ON_SURFACE = 1e-8
"""A contact is closed at the start where the error is below this [m]; placement leaves less."""


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
        The data set with the reference, the actual motion of the tool and statistics of the run.

    Example:
        >>> import forcegp
        >>> from forcegp.simulate import SimulationConfig
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> result = simulate(system, SimulationConfig(duration=0.1, engine="mujoco"))
        >>> len(result.data)
        24

    Raises:
        NumericalError: the motion cannot be reached, or the run diverges (names time and state).
        MissingDependencyError: the engine is not installed.
        MemoryLimitError: the log needs more memory than is free.
    """
    system = system.with_robot(system.robot.to(device="cpu"))
    system.announce_states(config.steps, 1.0, f"a simulation of {config.steps:,} steps")
    generator = torch.Generator().manual_seed(config.seed)
    with torch.no_grad(), one_thread():
        plan = make_plan(system, config, generator)
        if config.contact == "solver":
            engine = ContactSolverEngine(system, config.dt, config.solver)
            log = follow_with_solver(system, config, plan, engine, generator, progress)
            return make_result(system, config, plan, log, engine.name, generator)
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
    log, mechanics = Log.empty(config.steps, system), Mechanics(system, plan)
    rows, limit, targets = log.arrays(), torque_limit(system, config).numpy(), plan.arrays()
    closed = _closed_at_start(mechanics, plan.start.numpy())
    engine.reset(plan.start, torch.zeros_like(plan.start))
    q, qd = (x.numpy() for x in engine.state())
    for k in range(config.steps):
        check_speed(k * config.dt, q, qd)
        landing = land(mechanics, q, qd, closed)
        if landing.impact:
            qd = landing.qd
            engine.reset(torch.from_numpy(q), torch.from_numpy(qd))
        eom, target = landing.eom, Target(*(values[k] for values in targets))
        wanted = control_torque(eom.tool, eom, q, qd, target, plan.press(eom), config.gains)
        Q_u = np.clip(wanted, -limit, limit)
        forces = contact_forces(mechanics, q, qd, landing, Q_u, config.viscous_friction)
        engine.step(torch.from_numpy(Q_u + forces.Q_D + forces.Q_I + forces.Q_z))
        q_next, qd_next = (x.numpy() for x in engine.state())
        rows.write(k, q=q, qd=qd, qdd=(qd_next - qd) / config.dt, tau=Q_u, saturated=(Q_u != wanted).any())
        rows.write(k, Q=forces.Q, Q_I=forces.Q_I, Q_z=forces.Q_z)
        rows.write(k, multiplier=forces.multiplier, c=forces.c, contact=forces.closed)
        closed, q, qd = forces.closed, q_next, qd_next
        report(progress, k + 1, config.steps)
    return log


def _closed_at_start(mechanics: Mechanics, q: np.ndarray) -> np.ndarray:
    """Constraints that hold at the start; inverse kinematics puts the tool on the surface, up to rounding."""
    c = mechanics.equations(q, 0.0 * q).c
    return ~any_row(mechanics, np.abs(c) > ON_SURFACE)
