"""Columns of the inertia at the most probable accelerations: errors in variables."""

from __future__ import annotations

import torch
from torch import Tensor

import forcegp
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.learning import fit as learning

DRIVES = torch.tensor([0.3, 0.2], dtype=torch.float64)
"""Inertia of the drives [kg m²], which the robot file lacks; that of the links is 1.7 and 0.3."""
NOISE = 6.0
"""Standard deviation of the noise of accelerations [rad/s²], that of the motion being 6 to 8."""


def noisy() -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    robot = forcegp.load_robot("double_pendulum")
    robot = robot.replace(damping=0.0 * robot.damping, friction=0.0 * robot.friction)
    generator = torch.Generator().manual_seed(4)
    t = 0.01 * torch.arange(1500, dtype=torch.float64)
    w = 1.0 + 4.0 * torch.rand(4, 2, generator=generator, dtype=torch.float64)
    angle = w * t[:, None, None] + 6.3 * torch.rand(4, 2, generator=generator, dtype=torch.float64)
    q, qd, qdd = (0.5 * x.sum(1) for x in (angle.sin(), w * angle.cos(), -(w**2) * angle.sin()))
    true = robot.replace(armature=robot.armature + DRIVES)
    tau = forcegp.dynamics.inverse_dynamics(true, q, qd, qdd) + 0.2 * qd
    tau, qdd = (
        x + size * torch.randn(x.shape, generator=generator, dtype=x.dtype)
        for x, size in ((tau, 0.05), (qdd, NOISE))
    )
    return forcegp.ConstrainedSystem(robot), forcegp.Dataset(t, q, qd, tau, qdd, robot.joint_names)


def found(system: forcegp.ConstrainedSystem, data: forcegp.Dataset) -> Tensor:
    """Inertia of the drives that a fit with priors on links and drives finds."""
    priors = [JointFrictionPrior(), InertialPrior().with_drives(torch.ones(2, dtype=torch.float64))]
    noise = forcegp.Noise(acceleration=NOISE, torque="learn")
    return forcegp.StructuredGP(system, "analytical", priors, noise).fit(data).system.robot.armature


def test_noisy_accelerations_do_not_attenuate_inertia(monkeypatch) -> None:
    system, data = noisy()
    assert ((found(system, data) / DRIVES - 1.0).abs() < 0.1).all()
    monkeypatch.setattr(learning, "with_likely_accelerations", lambda problem, values, training: training)
    assert (found(system, data) < 0.75 * DRIVES).all()
