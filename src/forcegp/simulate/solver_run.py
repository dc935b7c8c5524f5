"""A run in which MuJoCo's solver makes contact and friction, seen through sensors."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.control.plan import Plan
from forcegp.control.task_space import Target, control_torque
from forcegp.simulate.config import Sensors, SimulationConfig
from forcegp.simulate.contact_solver import NO_FORCE, ContactSolverEngine
from forcegp.simulate.guard import Progress, check_speed, report, torque_limit
from forcegp.simulate.mechanics import Mechanics
from forcegp.simulate.result import Log


def follow_with_solver(
    system: ConstrainedSystem,
    config: SimulationConfig,
    plan: Plan,
    engine: ContactSolverEngine,
    generator: torch.Generator,
    progress: Progress | None,
) -> Log:
    """Step the engine through the plan; the controller sees what the sensors measure.

    Args:
        system: robot and contacts, the mechanics that the controller assumes.
        config: settings of motion, solver and sensors.
        plan: the motion.
        engine: the robot in its world.
        generator: source of the sensors' noise.
        progress: called every few steps.

    Returns:
        The log: true motion and forces, and what was measured where sensors are not perfect.
    """
    log, mechanics, sensors = Log.empty(config.steps, system), Mechanics(system, plan), config.sensors
    rows, limit, targets = log.arrays(), torque_limit(system, config).numpy(), plan.arrays()
    measured = {"q": torch.zeros_like(log.q), "qd": torch.zeros_like(log.qd)}
    F_I, F_z = (log.q.new_zeros(config.steps, len(system.contacts), 3) for _ in range(2))
    engine.reset(plan.start, torch.zeros_like(plan.start))
    for k in range(config.steps):
        true_q, true_qd = engine.state()
        check_speed(k * config.dt, true_q.numpy(), true_qd.numpy())
        q, qd = _measured_state(true_q, true_qd, sensors, generator)
        measured["q"][k], measured["qd"][k] = q, qd
        eom, target = mechanics.equations(q.numpy(), qd.numpy()), Target(*(values[k] for values in targets))
        wanted = control_torque(eom.tool, eom, q.numpy(), qd.numpy(), target, plan.press(eom), config.gains)
        Q_u = np.clip(wanted, -limit, limit)
        found = engine.forces(Q_u)
        rows.write(k, q=true_q, qd=true_qd, tau=Q_u, saturated=(Q_u != wanted).any(), qdd=found.qdd)
        rows.write(k, Q=found.Q, Q_I=found.Q_I, Q_z=found.Q_z, multiplier=found.multiplier)
        F_I[k], F_z[k] = torch.from_numpy(found.F_I), torch.from_numpy(found.F_z)
        engine.step()
        report(progress, k + 1, config.steps)
    log.c.copy_(system.equations(log.q, log.qd).c)
    log.contact.copy_(log.multiplier > NO_FORCE)
    names = enumerate(system.contact_names)
    forces = {"F_I": {}, "F_z": {}} if system.contacts else {}
    for i, name in names:
        forces["F_I"][name], forces["F_z"][name] = F_I[:, i], F_z[:, i]
    measured["tau"] = _measured_torque(log.tau, config, generator)
    seen = {} if sensors == Sensors() else measured
    return dataclasses.replace(log, contact_forces=forces, measured=seen)


def _measured_state(
    q: Tensor, qd: Tensor, sensors: Sensors, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Joint positions at the resolution of the encoders, and noisy velocities."""
    if sensors.encoder_resolution > 0.0:
        q = (q / sensors.encoder_resolution).round() * sensors.encoder_resolution
    if sensors.velocity_noise > 0.0:
        qd = qd + sensors.velocity_noise * _noise(qd, generator)
    return q, qd


def _measured_torque(tau: Tensor, config: SimulationConfig, generator: torch.Generator) -> Tensor:
    """The torque as it is logged: late by whole samples, the first one repeated, and noisy."""
    late = round(config.sensors.torque_delay / config.dt)
    rows = (torch.arange(len(tau)) - late).clamp(min=0)
    return tau[rows] + config.sensors.torque_noise * _noise(tau, generator)


def _noise(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, dtype=torch.float64, generator=generator).to(like.dtype)
