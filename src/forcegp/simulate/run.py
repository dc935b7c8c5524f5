"""Simulated runs in which a motion is planned, executed in a physics engine, and logged.

Contact forces come from the library's equations of motion, or from MuJoCo's solver and simulated sensors.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import closing, nullcontext

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.compiled_system import compiled_system
from forcegp.constraints.unilateral import any_row, contact_forces, land
from forcegp.control.plan import MotionConfig, Plan, joint_plan, make_plan
from forcegp.control.task_space import JointTarget
from forcegp.data import Dataset
from forcegp.errors import NumericalError, ParameterError
from forcegp.resources import one_thread
from forcegp.simulate.config import Sensors, SimulationConfig
from forcegp.simulate.contact_solver import NO_FORCE, ContactSolverEngine
from forcegp.simulate.engine import Engine
from forcegp.simulate.engines import make_engine
from forcegp.simulate.passive import PassiveForces
from forcegp.simulate.result import RunLog, SimulationResult, make_result, noise

RUNAWAY_SPEED = 50.0
"""Joint speed at which the simulation has diverged, since no planned motion reaches it [rad/s]."""
PROGRESS_STRIDE = 24
"""Number of steps between calls of the progress function, a tenth of a second at 240 Hz."""

Progress = Callable[[int, int], None]
"""A function called with the number of completed steps and the total number."""


def _torque_limit(system: ConstrainedSystem, config: MotionConfig) -> Tensor:
    """Return the torque limits `(nq,)` [N m] in the settings, or those of the robot."""
    robot = system.robot
    if config.torque_limit is None:
        return robot.effort_limit
    limit = torch.tensor(config.torque_limit, dtype=robot.dtype)
    robot.check_state(torque_limit=limit)
    return limit


def _check_speed(t: float, q: Tensor, qd: Tensor) -> None:
    """Raise `NumericalError` if a joint is too fast or the state is not finite."""
    if not (bool(q.isfinite().all()) and float(qd.abs().max()) < RUNAWAY_SPEED):
        raise NumericalError(
            f"the simulation diverges at t = {t:.4f} s",
            expected=f"joint speeds below {RUNAWAY_SPEED:g} rad/s",
            got=f"q = {q.tolist()}, qd = {qd.tolist()}",
            hint="use smaller gains, a longer travel time, or a rectangle farther inside the workspace",
        )


def _report(progress: Progress | None, done: int, steps: int) -> None:
    if progress is not None and (done % PROGRESS_STRIDE == 0 or done == steps):
        progress(done, steps)


def _follow_with_solver(
    system: ConstrainedSystem,
    config: SimulationConfig,
    plan: Plan,
    engine: ContactSolverEngine,
    generator: torch.Generator,
    progress: Progress | None,
) -> RunLog:
    """Step the engine through the plan, with a controller that uses sensor values."""
    log, sensors, limit = RunLog.empty(config.steps, system), config.sensors, _torque_limit(system, config)
    seen = compiled_system(system, (plan.frame, plan.point))
    measured = {"q": torch.zeros_like(log.q), "qd": torch.zeros_like(log.qd)}
    F_I, F_z = (log.q.new_zeros(config.steps, len(system.contacts), 3) for _ in range(2))
    engine.reset(plan.start, torch.zeros_like(plan.start))
    for k in range(config.steps):
        true_q, true_qd = engine.state()
        _check_speed(k * config.dt, true_q, true_qd)
        q, qd = true_q, true_qd
        if sensors.encoder_resolution > 0.0:
            q = (q / sensors.encoder_resolution).round() * sensors.encoder_resolution
        if sensors.velocity_noise > 0.0:
            qd = qd + sensors.velocity_noise * noise(qd, generator)
        measured["q"][k], measured["qd"][k] = q, qd
        command = plan.command(seen.equations(q, qd), q, qd, k, config.gains)
        Q_u = command.clamp(-limit, limit)
        solution = {name: torch.from_numpy(x) for name, x in engine.forces(Q_u.numpy())._asdict().items()}
        F_I[k], F_z[k] = solution.pop("F_I"), solution.pop("F_z")
        log.write(k, q=true_q, qd=true_qd, tau=Q_u, saturated=(Q_u != command).any(), **solution)
        engine.step()
        _report(progress, k + 1, config.steps)
    log.c.copy_(system.equations(log.q, log.qd).c)
    log.contact.copy_(log.multiplier > NO_FORCE)
    forces = {
        name: {contact: F[:, i] for i, contact in enumerate(system.contact_names)}
        for name, F in (("F_I", F_I), ("F_z", F_z))
        if system.contacts
    }
    # The logged torque is delayed by whole samples, with the first value repeated, and noise is added.
    late = (torch.arange(len(log.tau)) - round(sensors.torque_delay / config.dt)).clamp(min=0)
    measured["tau"] = log.tau[late] + sensors.torque_noise * noise(log.tau, generator)
    measured = {} if sensors == Sensors() else measured
    return dataclasses.replace(log, contact_forces=forces, measured=measured)


ON_SURFACE = 1e-8
"""Constraint error below which a contact is initially closed [m]."""


def simulate(
    system: ConstrainedSystem,
    config: SimulationConfig,
    *,
    motion: Dataset | None = None,
    forces: PassiveForces | None = None,
    progress: Progress | None = None,
) -> SimulationResult:
    """Simulate a motion of the robot, in contact or free, and log it.

    The engine moves the robot under Q_u + Q_D + Q_I + Q_z. These are the motor torque of a task-space
    controller, joint friction, the normal force from the constrained equations of motion with Baumgarte
    terms, and viscous contact friction (section 5 of the paper). A contact opens when its multiplier would
    become negative, and closes with an inelastic impact. The simulation runs on the CPU.

    Args:
        system: the robot and its contacts. Without contacts, the motion is free.
        config: settings of the simulation.
        motion: joint motion to follow for the configured duration, in place of a random tool motion.
        forces: learned joint forces that replace the robot's friction if `contact = "solver"`.
        progress: a function called every few steps and after the last step.

    Returns:
        The data set with the reference, the actual motion of the tool, and statistics of the run.

    Example:
        >>> import forcegp
        >>> from forcegp.simulate import SimulationConfig
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> len(simulate(system, SimulationConfig(duration=0.1, engine="mujoco")).data)
        24

    Raises:
        NumericalError: the motion is out of reach, or the run diverges (the message gives time and state).
        MissingDependencyError: the engine is not installed.
        MemoryLimitError: the log needs more memory than is free.
    """
    system = system.with_robot(system.robot.to(device="cpu"))
    system.announce_states(config.steps, 1.0, f"a simulation of {config.steps:,} steps")
    generator = torch.Generator().manual_seed(config.seed)
    with torch.no_grad(), one_thread():
        if motion is None:
            plan = make_plan(system, config, generator)
        else:
            followed = motion.select(system.robot.joint_names)
            plan = joint_plan(system, config, followed.t, JointTarget(followed.q, followed.qd, followed.qdd))
        if config.contact == "solver":
            engine = ContactSolverEngine(system, config.dt, config.solver)
            with nullcontext() if forces is None else forces.installed(engine.model):
                log = _follow_with_solver(system, config, plan, engine, generator, progress)
            name = engine.name if forces is None else f"{engine.name}, learned forces of joints"
            return make_result(system, config, plan, log, name, generator)
        if forces is not None:
            text = "learned forces need MuJoCo's solver"
            raise ParameterError(text, expected='contact = "solver"', got=config.contact)
        with closing(make_engine(system.robot, config.dt, config.engine)) as engine:
            log = _follow(system, config, plan, engine, progress)
            return make_result(system, config, plan, log, engine.name, generator)


def _follow(
    system: ConstrainedSystem, config: SimulationConfig, plan: Plan, engine: Engine, progress: Progress | None
) -> RunLog:
    """Step the engine through the plan."""
    log, limit = RunLog.empty(config.steps, system), _torque_limit(system, config)
    system = compiled_system(system, (plan.frame, plan.point))
    engine.reset(plan.start, torch.zeros_like(plan.start))
    q, qd = engine.state()
    # Inverse kinematics places the tool on the surface, up to rounding errors.
    closed = ~any_row(system, system.equations(q, qd).c.abs() > ON_SURFACE)
    for k in range(config.steps):
        _check_speed(k * config.dt, q, qd)
        landing = land(system, q, qd, closed)
        if landing.impact:
            qd = landing.qd
            engine.reset(q, qd)
        command = plan.command(landing.eom, q, qd, k, config.gains)
        Q_u = command.clamp(-limit, limit)
        forces = contact_forces(system, q, qd, landing, Q_u, config.viscous_friction)
        engine.step(Q_u + forces.Q_D + forces.Q_I + forces.Q_z)
        q_next, qd_next = engine.state()
        log.write(k, q=q, qd=qd, qdd=(qd_next - qd) / config.dt, tau=Q_u, saturated=(Q_u != command).any())
        log.write(k, Q=forces.Q, Q_I=forces.Q_I, Q_z=forces.Q_z)
        log.write(k, multiplier=forces.multiplier, c=forces.c, contact=forces.closed)
        closed, q, qd = forces.closed, q_next, qd_next
        _report(progress, k + 1, config.steps)
    return log
