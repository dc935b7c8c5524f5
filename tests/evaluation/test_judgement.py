"""The verdict: torque beyond gravity, motion in open loop, force in contact; reasons to doubt the numbers."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import forcegp
from forcegp import dynamics, evaluate, kinematics
from forcegp.data import DataHeader, Dataset
from forcegp.evaluation.judgement import beyond_gravity, explained, torque_response
from forcegp.evaluation.predicted import logged_forces
from random_data import random_data, table_system

ROBOT = forcegp.load_robot("double_pendulum")
FREE = forcegp.ConstrainedSystem(ROBOT)


def swinging(robot: forcegp.RobotModel = ROBOT, rate: float = 3.0, seconds: float = 8.0) -> Dataset:
    """Free motion of the double pendulum with the torque that a robot needs for it."""
    t = 0.005 * torch.arange(round(seconds / 0.005), dtype=torch.float64)
    w = rate * torch.tensor([1.0, 1.4], dtype=torch.float64)
    q = torch.sin(t[:, None] * w) + 0.3 * torch.sin(2.3 * t[:, None] * w)
    qd = w * torch.cos(t[:, None] * w) + 0.69 * w * torch.cos(2.3 * t[:, None] * w)
    qdd = -(w**2) * (torch.sin(t[:, None] * w) + 0.3 * 2.3**2 * torch.sin(2.3 * t[:, None] * w))
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd) - dynamics.damping_force(robot, qd)
    header = DataHeader(dt=0.005, joint_names=robot.joint_names)
    return Dataset(
        t=t, q=q, qd=qd, qdd=qdd, tau=tau, joint_names=robot.joint_names, contact={}, header=header
    )


def heavy(factor: float) -> forcegp.RobotModel:
    return ROBOT.replace(mass=factor * ROBOT.mass, inertia=factor * ROBOT.inertia)


def test_the_right_robot_explains_all_the_torque_and_the_motion() -> None:
    found = evaluate(forcegp.AnalyticalModel(FREE).nominal(), swinging())
    assert found.verdict.startswith("The model explains 100 % of the non-gravitational torque")
    assert found.motion is not None and max(x or 0.0 for x in found.motion.model) < 0.05
    assert found.response == pytest.approx((1.0, 1.0), abs=1e-9) and found.doubts == () and not found.poor


@pytest.mark.parametrize("mass", [0.0, 0.4, -0.3])
def test_a_change_of_the_payload_is_named_with_its_size(mass: float) -> None:
    added = mass * torch.tensor([0.0, 1.0], dtype=torch.float64)
    loaded = ROBOT.replace(mass=ROBOT.mass + added)
    found = evaluate(forcegp.AnalyticalModel(FREE).nominal(), swinging(loaded))
    named = [doubt for doubt in found.doubts if "on the last link than the model has" in doubt]
    assert bool(named) == bool(mass) and found.poor == bool(mass)
    if mass:
        assert found.payload is not None and ("more" if mass > 0.0 else "less") in named[0]
        assert found.payload.mass == pytest.approx(mass, rel=0.05)


def test_all_predictors_are_measured_by_the_mass_matrix_of_the_robot_file() -> None:
    """A mass matrix that is far too small or too large would hide the error of its own predictor."""
    data = swinging()
    rest, _ = beyond_gravity(FREE, data)
    for factor in (2.0, 0.01):
        model = forcegp.AnalyticalModel(forcegp.ConstrainedSystem(heavy(factor))).nominal()
        error = model.predict(data.q, data.qd, data.tau).mean - data.qdd
        torque = (dynamics.mass_matrix(ROBOT, data.q) @ error[..., None])[..., 0]
        found = evaluate(model, data, system=FREE)
        scores = found.predictors[0]
        assert scores.torque.all == pytest.approx(torque.square().mean(0).sqrt().tolist(), rel=1e-6)
        assert scores.explained == pytest.approx(explained(torque, rest), rel=1e-6)
        assert found.poor, "the page of a model that is worse than the robot file opens in red"


ARM = forcegp.load_robot("ur5").replace(friction=torch.zeros(6, dtype=torch.float64))


def with_wrist(factor: float) -> forcegp.ConstrainedSystem:
    """The arm with another inertia of its last drive, as a factor of the inertia of the joint."""
    inertia = dynamics.mass_matrix(ARM, torch.zeros(6, dtype=torch.float64))[5, 5]
    extra = torch.zeros(6, dtype=torch.float64)
    extra[5] = (factor - 1.0) * inertia
    return forcegp.ConstrainedSystem(ARM.replace(armature=ARM.armature + extra))


def moving_arm(robot: forcegp.RobotModel) -> Dataset:
    """Free motion of the arm, with noisy torques."""
    t = 0.005 * torch.arange(1600, dtype=torch.float64)
    w = torch.tensor([2.0, 1.4, 2.6, 3.1, 2.2, 3.7], dtype=torch.float64)
    q, qd = torch.sin(t[:, None] * w), w * torch.cos(t[:, None] * w)
    qdd = -(w**2) * q
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd) - dynamics.damping_force(robot, qd)
    noise = 1e-3 * torch.randn(q.shape, generator=torch.Generator().manual_seed(0)).to(q)
    header = DataHeader(dt=0.005, joint_names=robot.joint_names)
    return Dataset(
        t=t, q=q, qd=qd, qdd=qdd, tau=tau + noise, joint_names=robot.joint_names, contact={}, header=header
    )


def test_a_wrist_with_far_too_much_inertia_is_red_however_well_the_other_joints_do() -> None:
    data, file = moving_arm(ARM), with_wrist(1.0)
    found = evaluate(forcegp.AnalyticalModel(with_wrist(125.0)).nominal(), data, system=file)
    assert found.response is not None and found.own_response is not None
    assert found.response[5] == pytest.approx(1.0 / 125.0, rel=0.1)
    assert found.response[:5] == pytest.approx((1.0,) * 5, rel=0.1)
    assert found.own_response == pytest.approx((1.0,) * 6)
    (doubt,) = found.doubts
    assert "An added torque has another effect" in doubt and "wrist_3_joint 0.00" in doubt
    assert "shoulder" not in doubt and found.poor


def test_a_drive_that_the_log_supports_is_no_reason_for_doubt() -> None:
    """The robot file may lack a drive: the response differs from 1, and the accelerations fit."""
    true = with_wrist(125.0)
    found = evaluate(forcegp.AnalyticalModel(true).nominal(), moving_arm(true.robot), system=with_wrist(1.0))
    assert found.response is not None and found.response[5] < 0.01
    assert found.doubts == () and not found.poor


def test_a_joint_that_is_far_worse_than_the_mean_is_red() -> None:
    """A wrist without its drive: small torque errors of most joints, and wild accelerations."""
    robot, small = with_wrist(125.0), with_wrist(1.0)
    found = evaluate(forcegp.AnalyticalModel(small).nominal(), moving_arm(robot.robot), system=robot)
    assert found.predictors[0].beyond_gravity == pytest.approx(1.0, abs=0.05), "most joints are right"
    (doubt,) = [text for text in found.doubts if "far larger than those of the mean" in text]
    assert "wrist_3_joint" in doubt and "(mean: " in doubt and "shoulder" not in doubt and found.poor


def test_a_log_whose_torque_is_gravity_is_named() -> None:
    assert evaluate(forcegp.AnalyticalModel(FREE).nominal(), swinging(rate=3.0)).gravity < 0.95  # type: ignore[operator]
    slow = evaluate(forcegp.AnalyticalModel(FREE).nominal(), swinging(rate=0.1, seconds=40.0))
    assert slow.gravity is not None and slow.gravity > 0.99
    (doubt,) = slow.doubts
    assert "Gravity alone explains" in doubt and "hardly test anything else" in doubt


def test_a_model_that_has_learned_the_controller_is_named() -> None:
    """A network that has seen one motion answers no torque that the controller did not choose."""
    data = swinging()
    fit = forcegp.models.NeuralNetwork(FREE).fit(data[::8])
    found = evaluate(fit, data)
    assert found.response == torque_response(fit, ROBOT, data) and found.response is not None
    weak = min(found.response) < 0.5
    assert weak == any("learned the controller" in doubt for doubt in found.doubts)
    assert found.predictors[0].explained == () and "explains" not in found.verdict
    cancelled = replace(found, own_response=(0.02, 0.97), response=None)
    (doubt,) = [text for text in cancelled.doubts if "learned the controller" in text]
    assert "(expected: 1): shoulder 0.02." in doubt and "elbow" not in doubt


def test_a_joint_that_bears_next_to_nothing_does_not_count() -> None:
    rest = torch.tensor([[10.0, 0.1]] * 4, dtype=torch.float64)
    assert explained(torch.ones_like(rest), rest) == pytest.approx((0.99, None))


def test_the_force_in_contact_is_in_the_verdict() -> None:
    """Against a logged multiplier, and against the normal force of a sensor where there is none."""
    system = table_system()
    data, contact = random_data(system, 200), system.contacts[0]
    assert isinstance(contact, forcegp.SurfaceContact)
    model = forcegp.AnalyticalModel(system).nominal()
    force = model.predict(data.q, data.qd, data.tau, "multiplier", active=data.active(["table"])).mean[:, 0]
    logged = data.replace(contact_extras={"multiplier": {"table": force + 1.0}})
    (score,) = evaluate(model, logged).multipliers
    assert score.bias == pytest.approx(-1.0)
    assert evaluate(model, logged).verdict.endswith(
        f"the force at 'table' is off by 1 N (mean force {score.level:.3g} N)."
    )
    point = kinematics.point_position(system.robot, data.q, contact.frame, tuple(contact.point))
    F = (force + 2.0)[:, None] * contact.surface.gradient(point)
    sensed = data.replace(contact_extras={"F_sensor": {"table": F}})
    torch.testing.assert_close(logged_forces(model, sensed)["table"], force + 2.0)
    assert evaluate(model, sensed).multipliers[0].bias == pytest.approx(-2.0)
