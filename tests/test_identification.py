"""Regressor, base parameters, and least-squares identification with honest standard errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import forcegp
from forcegp import dynamics
from forcegp.errors import DataError
from forcegp.identification import base_parameters, identify, parameter_vector, regressor
from robots import ARMS, Arm, random_states

RELATIVE = 1e-10  # the regressor sums ten products a link, so it costs no more digits than the dynamics
NOISE = 0.1  # N m


@pytest.fixture(scope="module")
def robot() -> forcegp.RobotModel:
    return forcegp.load_robot("kuka_iiwa")


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_regressor_times_parameters_is_inverse_dynamics(arm: Arm) -> None:
    robot = arm.load(base_rpy=(0.2, 0.4, -0.3))
    states = random_states(robot, 4)[:3]
    expected = dynamics.inverse_dynamics(robot, *states)
    ours = regressor(robot, *states) @ parameter_vector(robot)
    assert float((ours - expected).abs().max() / expected.abs().max()) < RELATIVE


@pytest.mark.parametrize(("name", "rank"), [("double_pendulum", 6), ("franka_panda", 43), ("kuka_iiwa", 43)])
def test_number_of_base_parameters(name: str, rank: int) -> None:
    """43 for a seven-joint arm on a vertical first axis (Gaz et al. 2019); 3 a joint for a planar one."""
    assert base_parameters(forcegp.load_robot(name)).rank == rank


def test_base_parameters_carry_the_whole_motion(robot: forcegp.RobotModel) -> None:
    base = base_parameters(robot)
    Y = regressor(robot, *random_states(robot, 10, seed=4)[:3]).flatten(0, 1).numpy()
    np.testing.assert_allclose(Y[:, base.columns] @ base.combination, Y, atol=1e-9 * np.abs(Y).max())
    assert base.combination[:, base.columns].tolist() == np.eye(base.rank).tolist()
    assert len(set(base.names)) == base.rank


def _log(robot: forcegp.RobotModel, count: int, seed: int, friction: bool = False) -> list[torch.Tensor]:
    q, qd, qdd, _ = random_states(robot, count, seed)
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd)
    if friction:
        tau = tau - dynamics.damping_force(robot, qd)
    noise = torch.randn(tau.shape, generator=torch.Generator().manual_seed(seed), dtype=tau.dtype)
    return [q, qd, qdd, tau + NOISE * noise]


def test_a_few_hundred_noisy_samples_identify_the_kuka(robot: forcegp.RobotModel) -> None:
    """Over many logs the errors are standard normal in units of the standard errors that are predicted."""
    truth = base_parameters(robot).of(robot)
    results = [identify(robot, *_log(robot, 300, seed)) for seed in range(12)]
    z = np.array([(result.value - truth) / result.standard_error for result in results])
    # 12 · 43 draws: mean square 1 ± 0.06, and the largest of them beyond 5 once in 4000 runs of this test.
    assert 0.75 < (z**2).mean() < 1.25
    assert np.abs(z).max() < 5.0
    assert np.abs(results[0].noise_std - NOISE).max() < 0.3 * NOISE
    assert results[0].condition < 20


def test_joint_friction_is_identified_with_the_inertia(robot: forcegp.RobotModel) -> None:
    rough = robot.replace(friction=torch.linspace(0.2, 1.4, 7, dtype=robot.dtype))
    result = identify(robot, *_log(rough, 400, 3, friction=True), friction=True)
    assert result.damping is not None and result.friction is not None
    np.testing.assert_allclose(result.damping, 0.5, atol=0.05)
    np.testing.assert_allclose(result.friction, rough.friction, atol=0.08)


def test_an_exact_log_gives_the_exact_parameters(robot: forcegp.RobotModel) -> None:
    q, qd, qdd, _ = random_states(robot, 100)
    heavy = robot.replace(armature=torch.full_like(robot.armature, 0.3))
    result = identify(heavy, q, qd, qdd, dynamics.inverse_dynamics(heavy, q, qd, qdd))
    np.testing.assert_allclose(result.value, result.base.of(robot), atol=1e-10)


def test_a_robot_in_single_precision_is_identified_as_well(robot: forcegp.RobotModel) -> None:
    single = robot.to(dtype=torch.float32)
    log = [x.float() for x in _log(robot, 200, 0)]
    result = identify(single, *log)
    assert result.base.rank == base_parameters(robot).rank
    np.testing.assert_allclose(result.noise_std, NOISE, rtol=0.3)
    assert np.abs((result.value - result.base.of(robot)) / result.standard_error).max() < 5.0


def test_logs_that_cannot_identify_are_refused(robot: forcegp.RobotModel) -> None:
    log = _log(robot, 100, 0)
    still = [log[0][:1].expand(100, 7), torch.zeros_like(log[1]), torch.zeros_like(log[2]), log[3]]
    with pytest.raises(DataError, match="does not excite"):
        identify(robot, *still)
    with pytest.raises(DataError, match=r"too few samples(.|\n)*more than 7"):
        identify(robot, *(x[:6] for x in log))
    with pytest.raises(DataError, match="not finite"):
        identify(robot, *log[:3], log[3] * float("nan"))
