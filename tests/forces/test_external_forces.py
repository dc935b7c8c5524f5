"""Unknown forces of stated size on joints: a joint without a torque sensor, a hand that moves the robot."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.measurements import unmeasured_forces
from forcegp.forces.quantities import affine_map, states_at
from forcegp.models.structured_fit import StructuredFit

SIZE = 3.0


def pushed(rows: int, seed: int) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset, Tensor]:
    """A double pendulum whose first joint is pushed by hand, and the pushes."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    generator = torch.Generator().manual_seed(seed)
    q, qd, tau, noise = torch.randn(4, rows, 2, generator=generator, dtype=torch.float64)
    push = torch.stack([SIZE * noise[:, 0], torch.zeros(rows, dtype=torch.float64)], dim=-1)
    friction = -0.3 * torch.tanh(qd / 0.05)
    qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau + push + friction)
    qdd = qdd + 0.05 * torch.randn(rows, 2, generator=generator, dtype=torch.float64)
    t = 0.01 * torch.arange(rows, dtype=torch.float64)
    return system, forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names), push


def held(system: forcegp.ConstrainedSystem, data: forcegp.Dataset, noise: forcegp.Noise) -> StructuredFit:
    model = forcegp.StructuredGP(system, "analytical", [forcegp.priors.JointFrictionPrior()], noise=noise)
    return model.fit(data, learn=[])


def test_an_unknown_force_is_noise_of_the_torque_that_acts() -> None:
    """Learned as with noise of the torque of that size; predicted with its variance more, H Σ Hᵀ."""
    system, data, _ = pushed(40, 0)
    sizes = dict(zip(system.robot.joint_names, (SIZE, 0.5), strict=True))
    sensed = held(system, data, forcegp.Noise(0.1, torque=tuple(sizes.values())))
    acting = held(system, data, forcegp.Noise(0.1, torque=None, external=sizes))
    acting = acting.condition(data, sensed.hyperparameters)
    one, two = (fit.predict(data.q, data.qd, data.tau) for fit in (sensed, acting))
    torch.testing.assert_close(one.mean, two.mean, atol=1e-10, rtol=1e-9)
    at, _ = states_at(system, data.q, data.qd, data.tau, None)
    B = affine_map(system, at, "qdd").B_Q
    more = (B * torch.tensor([SIZE, 0.5], dtype=torch.float64) ** 2) @ B.mT
    assert one.covariance is not None and two.covariance is not None
    torch.testing.assert_close(two.covariance, one.covariance + more, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("stated", [True, False])
def test_pushes_of_one_joint_are_no_friction_of_another(stated: bool) -> None:
    """Accelerations of a new log are covered, whether the size is stated or the log lacks the torque."""
    system, data, _ = pushed(400, 1)
    if not stated:
        names = system.robot.joint_names[:1]
        data = data.replace(header=data.header.model_copy(update={"unmeasured_torques": names}))
    noise = forcegp.Noise(0.05, external={system.robot.joint_names[0]: SIZE} if stated else None)
    fit = forcegp.StructuredGP(system, "analytical", noise=noise).fit(data)
    assert fit.torque_std is not None
    assert list(fit.specification.noise.external or {}) == [system.robot.joint_names[0]]
    _, test, _ = pushed(200, 2)
    at, _ = states_at(system, test.q, test.qd, test.tau, None)
    prediction = fit.predict(test.q, test.qd, test.tau, noise=True)
    assert prediction.std is not None
    inside = ((prediction.mean - test.qdd).abs() <= 2.0 * prediction.std).double().mean(0)
    assert bool((inside > 0.9).all())
    torque = fit.predict(test.q, test.qd, test.tau, "joint_force").mean - test.tau - at.eom.Q_K
    error = (torque + 0.3 * torch.tanh(test.qd / 0.05))[:, 1]
    assert float(error.square().mean().sqrt()) < 0.1


def test_a_measured_contact_force_is_no_unknown_force() -> None:
    """M q̈ = Q_K + τ + push + J_EᵀF: the push alone is what the joint without a sensor lacks."""
    robot = forcegp.load_robot("double_pendulum")
    floor = forcegp.SurfaceContact(
        "floor", robot.frame_names[-1], (0.0, 0.0, 0.0), forcegp.Plane((0.0, 0.0, 1.0), 0.0)
    )
    system = forcegp.ConstrainedSystem(robot, [floor])
    generator = torch.Generator().manual_seed(5)
    q, qd, tau, random = torch.randn(4, 500, 2, generator=generator, dtype=torch.float64)
    push, tau = SIZE * random * torch.tensor([1.0, 0.0], dtype=torch.float64), 0.1 * tau
    tau[:, 0] = 0.0
    force = 40.0 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    J = forcegp.kinematics.point_jacobian(robot, q, floor.frame, tuple(floor.point))
    lever = (J.mT @ force[..., None])[..., 0]
    data = forcegp.Dataset(
        0.01 * torch.arange(500, dtype=torch.float64),
        q,
        qd,
        tau,
        forcegp.dynamics.forward_dynamics(robot, q, qd, tau + push + lever),
        robot.joint_names,
        contact={"floor": torch.ones(500, dtype=torch.bool)},
        header=forcegp.data.DataHeader(unmeasured_torques=robot.joint_names[:1]),
    )
    Q = tau + push + forcegp.ConstrainedSystem(robot).equations(q, qd).Q_K
    moved = forcegp.priors.Observation(data)
    joint = forcegp.priors.Observation(data.replace(extras={"Q": Q}), "joint_force", 0.1)
    sensed = data.replace(contact_extras={"F_I": {"floor": force}})
    true = float(push[:, 0].square().mean().sqrt())
    added = float(lever[:, 0].square().mean().sqrt())
    name = robot.joint_names[0]
    assert unmeasured_forces(system, [moved])[name] > 0.8 * added > 2.0 * true
    assert unmeasured_forces(system, [moved, joint])[name] == pytest.approx(true, rel=1e-6)
    exact, vague = (forcegp.priors.Observation(sensed, "contact_force", std) for std in (1e-6, 1e4))
    assert unmeasured_forces(system, [exact, moved])[name] == pytest.approx(true, rel=1e-6)
    assert unmeasured_forces(system, [vague, moved]) == unmeasured_forces(system, [moved])


def test_a_saved_fit_keeps_unknown_forces(tmp_path: Path) -> None:
    system, data, _ = pushed(60, 3)
    noise = forcegp.Noise(0.1, external={system.robot.joint_names[0]: SIZE})
    fit = held(system, data, noise)
    fit.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model")
    one, two = (each.predict(data.q, data.qd, data.tau) for each in (fit, again))
    assert one.covariance is not None and two.covariance is not None
    torch.testing.assert_close(two.covariance, one.covariance, atol=1e-9, rtol=1e-9)


def test_forces_that_cannot_be_are_refused() -> None:
    with pytest.raises(ModelError, match="'knee' has an invalid standard deviation"):
        forcegp.Noise(external={"knee": 0.0})
    system, data, _ = pushed(20, 4)
    with pytest.raises(UnknownNameError, match="joint with an unknown force"):
        held(system, data, forcegp.Noise(0.1, external={"knee": 1.0}))
