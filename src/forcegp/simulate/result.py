"""Result of a simulated run."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.control.plan import Plan
from forcegp.control.trajectory import Reference
from forcegp.data.dataset import Dataset
from forcegp.data.fields import DataHeader
from forcegp.simulate.config import SimulationConfig

CHUNK = 8192
"""Number of states for which equations of motion are in memory at a time."""


@dataclass(frozen=True)
class RunLog:
    """Quantities recorded at every step.

    Attributes:
        q, qd, qdd, tau, Q, Q_I, Q_z: motion and forces, `(n, nq)`. `qdd` is noise-free.
        multiplier, c: multipliers and constraint errors, `(n, m)`.
        contact, saturated: masks of closed contacts `(n, n_contacts)` and of samples at a torque limit
            `(n,)`.
        contact_forces: forces `(n, 3)` [N] from the engine, keyed by name (`F_I`, `F_z`) and contact, if any.
        measured: sensor values of `q`, `qd` and `tau` if the sensors are imperfect.
    """

    q: Tensor
    qd: Tensor
    qdd: Tensor
    tau: Tensor
    Q: Tensor
    Q_I: Tensor
    Q_z: Tensor
    multiplier: Tensor
    c: Tensor
    contact: Tensor
    saturated: Tensor
    contact_forces: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    measured: dict[str, Tensor] = field(default_factory=dict)

    @staticmethod
    def empty(steps: int, system: ConstrainedSystem) -> RunLog:
        """Return an empty log for a number of steps."""

        def columns(width: int, dtype: torch.dtype = system.robot.dtype) -> Tensor:
            return torch.zeros(steps, width, dtype=dtype)

        nq, m = system.robot.nq, system.m
        q, qd, qdd, tau, Q, Q_I, Q_z = (columns(nq) for _ in range(7))
        contact, saturated = columns(len(system.contacts), torch.bool), columns(1, torch.bool)[:, 0]
        return RunLog(q, qd, qdd, tau, Q, Q_I, Q_z, columns(m), columns(m), contact, saturated)

    def write(self, k: int, **values: Tensor) -> None:
        """Write the values of row k from a mapping of columns to values."""
        for name, value in values.items():
            getattr(self, name)[k] = value


def noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Draw white noise of unit variance in double precision, and convert it to the type of `like`."""
    return torch.randn(like.shape, dtype=torch.float64, generator=generator).to(like.dtype)


@dataclass(frozen=True)
class SimulationResult:
    """A simulated run.

    Attributes:
        data: the log as a data set.
        reference: planned motion of the tool point.
        position, velocity, acceleration: actual motion of the point in the world, `(n, 3)` [m, m/s, m/s²].
        c: constraint error, `(n, m)` [m].
        saturated: number of samples at a torque limit.
        beyond_limits: number of samples with a joint outside its limits.
        acceleration_mismatch: largest difference in acceleration between engine and library [rad/s²].
        engine: name and version of the engine.
    """

    data: Dataset
    reference: Reference
    position: Tensor
    velocity: Tensor
    acceleration: Tensor
    c: Tensor
    saturated: int
    beyond_limits: int
    acceleration_mismatch: float
    engine: str

    def summary(self) -> dict[str, float | int | str]:
        """Return statistics of the run. Their names include the units."""
        touching = torch.stack(list(self.data.contact.values()), dim=-1) if self.data.contact else None
        figures: dict[str, float | int | str] = {
            "engine": self.engine,
            "samples": len(self.data),
            "tracking_error_m": float((self.position - self.reference.position).norm(dim=-1).max()),
            "tool_speed_m_s": float(self.velocity.norm(dim=-1).max()),
            "torque_Nm": float(self.data.tau.abs().max()),
            "acceleration_mismatch_rad_s2": self.acceleration_mismatch,
            "saturated_samples": self.saturated,
            "beyond_joint_limits_samples": self.beyond_limits,
            "lengthened_segments": self.reference.lengthened,
        }
        if touching is not None and bool(touching.any()):
            force = torch.stack(list(self.data.contact_extras["multiplier"].values()), dim=-1)[touching]
            figures |= {
                "constraint_error_m": float(self.c[touching].abs().max()),
                "multiplier_min_N": float(force.min()),
                "multiplier_max_N": float(force.max()),
                "in_contact_fraction": float(touching.float().mean()),
            }
        return figures


def make_result(
    system: ConstrainedSystem,
    config: SimulationConfig,
    plan: Plan,
    log: RunLog,
    engine: str,
    generator: torch.Generator,
) -> SimulationResult:
    """Build the result of a run from its log."""
    robot = system.robot
    poses = kinematics.link_poses(robot, log.q)
    motion = kinematics.link_motion(robot, poses, log.qd)
    tool = kinematics.point_motion(robot, poses, motion, log.qd, plan.frame, plan.point)
    beyond = ((log.q < robot.lower) | (log.q > robot.upper)).any(-1)
    return SimulationResult(
        data=_dataset(system, config, plan, log, engine, generator),
        reference=plan.reference,
        position=tool.position,
        velocity=tool.twist[:, 3:],
        acceleration=((tool.jacobian @ log.qdd[..., None])[..., 0] + tool.bias)[:, 3:],
        c=log.c,
        saturated=int(log.saturated.sum()),
        beyond_limits=int(beyond.sum()),
        acceleration_mismatch=_mismatch(system, config, log),
        engine=engine,
    )


def _mismatch(system: ConstrainedSystem, config: SimulationConfig, log: RunLog) -> float:
    """Return the largest difference between the engine's accelerations and L b + H Q̄ [rad/s²].

    Contact forces that the engine computed are treated as impressed forces in free motion.
    """
    Q_bar, active = log.Q + log.Q_z, log.contact
    if config.contact == "solver":
        system, Q_bar, active = ConstrainedSystem(system.robot), Q_bar + log.Q_I, active[:, :0]
    worst = 0.0
    for rows in torch.arange(len(log.q)).split(CHUNK):
        eom = system.equations(log.q[rows], log.qd[rows], active=active[rows])
        worst = max(worst, float((eom.acceleration(Q_bar[rows]) - log.qdd[rows]).abs().max()))
    return worst


def _dataset(
    system: ConstrainedSystem,
    config: SimulationConfig,
    plan: Plan,
    log: RunLog,
    engine: str,
    generator: torch.Generator,
) -> Dataset:
    robot, names = system.robot, system.contact_names
    header = DataHeader(
        dt=config.dt,
        noise_std=config.noise_std,
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        seed=config.seed,
        provenance=(f"simulated for {config.duration:g} s with {engine}",),
        joint_names=robot.joint_names,
        contact_names=names,
    )
    multipliers = {
        contact.name: log.multiplier[:, system.rows[contact.name].start]
        for contact in system.contacts
        if isinstance(contact, SurfaceContact)
    }
    clean = {f"{name}_clean": getattr(log, name) for name in ("qdd", *log.measured)}
    return Dataset(
        t=plan.reference.t,
        q=log.measured.get("q", log.q),
        qd=log.measured.get("qd", log.qd),
        qdd=log.qdd + config.noise_std * noise(log.qdd, generator),
        tau=log.measured.get("tau", log.tau),
        joint_names=robot.joint_names,
        contact={name: log.contact[:, i] for i, name in enumerate(names)},
        extras={**clean, "Q": log.Q, "Q_z": log.Q_z, "Q_I": log.Q_I},
        contact_extras=({"multiplier": multipliers} if multipliers else {}) | log.contact_forces,
        header=header,
    )
