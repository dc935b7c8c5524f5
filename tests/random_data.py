"""Small data sets without a simulator: random states, accelerations by the equations of motion."""

from __future__ import annotations

import torch

import forcegp
from forcegp.data.fields import DataHeader

FRICTION = 1.0
"""Viscous friction at the contact [N s/m]."""
NOISE_STD = 0.1


def table_system(robot: str = "kuka_iiwa") -> forcegp.ConstrainedSystem:
    """The KUKA arm whose tip touches a table, without stabilization."""
    table = forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), forcegp.Plane())
    return forcegp.ConstrainedSystem(forcegp.load_robot(robot), [table])


def random_data(
    system: forcegp.ConstrainedSystem, n: int, seed: int = 0, friction: float = FRICTION, free: bool = True
) -> forcegp.Dataset:
    """Random states with contact friction and noisy accelerations; every third sample free of contact."""
    generator = torch.Generator().manual_seed(seed)
    robot = system.robot

    def draw(scale: float) -> torch.Tensor:
        uniform = torch.rand(n, robot.nq, generator=generator, dtype=torch.float64)
        return scale * (2.0 * uniform - 1.0)

    q, qd = draw(1.0), draw(0.5)
    tau = draw(3.0) - forcegp.dynamics.gravity_force(robot, q)
    active = torch.ones(n, 1, dtype=torch.bool)
    active[2::3] = not free
    eom = system.equations(q, qd, active)
    point = eom.contact_points["table"]
    slip = point.velocity - point.normal * (point.normal * point.velocity).sum(-1, keepdim=True)
    Q_z = (point.jacobian.mT @ (-friction * slip)[..., None])[..., 0] * active
    qdd = eom.acceleration(eom.Q_K + tau + Q_z)
    noise = NOISE_STD * torch.randn(n, robot.nq, generator=generator, dtype=torch.float64)
    return forcegp.Dataset(
        t=torch.arange(n, dtype=torch.float64) / 240.0,
        q=q,
        qd=qd,
        tau=tau,
        qdd=qdd + noise,
        joint_names=robot.joint_names,
        contact={"table": active[:, 0]},
        extras={"qdd_clean": qdd},
        header=DataHeader(noise_std=NOISE_STD, seed=seed),
    )
