"""Faults that once passed in silence or under another name are named as what they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import forcegp
from forcegp import dynamics
from forcegp.checks import Log, Report, check, log_of
from forcegp.checks.placement import check_placement
from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.scene import load_scene
from forcegp.simulate import simulate
from planted_faults import Case, free_log, serious


def kinds_of(report: Report) -> set[str]:
    return {kind for finding in report.findings for kind in finding.kinds}


@pytest.mark.parametrize("low", [-np.pi, 0.0, 0.3])
def test_wrapped_angles_are_named_and_nothing_else_is(low: float) -> None:
    robot = forcegp.load_robot("double_pendulum")
    log = free_log(robot, seconds=10.0)
    q = log.q - np.median(log.q, axis=0) + low
    robot = replace(robot, lower=robot.lower - 10.0, upper=robot.upper + 10.0, gravity=0.0 * robot.gravity)
    state = [torch.from_numpy(x) for x in (q, log.qd, log.qdd)]
    tau = dynamics.inverse_dynamics(robot, *state) - dynamics.damping_force(robot, state[1])
    log = log.replace(tau=tau.numpy())
    wrapped = log.replace(q=np.mod(q - low, 2.0 * np.pi) + low)
    for header in ({}, {"derived": ("qdd",), "noise_std": None}):
        wrapped = wrapped.replace(header=wrapped.header.model_copy(update=header))
        report = check(ConstrainedSystem(robot, []), wrapped)
        assert serious(report) == {"angle-wrapped"}, report.findings
        assert set(report.findings[0].joints) == set(robot.joint_names)
        assert "unwrap" in report.findings[0].remedy and "segment" not in report.findings[0].remedy


@pytest.fixture(scope="module")
def solver() -> Case:
    """A tip that presses, slides and lifts by a solver of contacts, with impacts."""
    scene = load_scene("ur5_wiping")
    config = replace(scene.simulation, seed=11, duration=8.0, engine="mujoco", contact="solver")
    return scene.system(), log_of(simulate(scene.system(), config).data)


@pytest.mark.parametrize("seconds", [0.01, 0.02])
def test_a_velocity_that_lags_is_named(solver: Case, seconds: float) -> None:
    system, log = solver
    a = np.exp(-log.dt / seconds)
    late = lfilter([1.0 - a], [1.0, -a], log.qd, axis=0, zi=a * log.qd[:1])[0]
    (found,) = (f for f in check(system, log.replace(qd=late)).findings if f.kind == "velocity-delay")
    assert set(found.joints) == set(log.joint_names) and "behind" in found.message


def test_neither_a_lag_nor_another_torque_is_named_on_the_log_itself(solver: Case) -> None:
    kinds = kinds_of(check(*solver))
    assert not kinds & {"velocity-delay", "torque-modelled", "torque-without-gravity"}


def test_a_tip_on_its_surface_although_the_contact_never_closes() -> None:
    scene = load_scene("kuka_plane")
    system = scene.system()
    log = log_of(simulate(system, replace(scene.simulation, duration=4.0)).data)
    assert log.contact["table"].mean() > 0.3
    wrong = log.replace(contact={"table": np.zeros(len(log), bool)})
    (found,), corrected = check_placement(system, wrong)
    assert found.kind == "contact-missed" and found.severity == "error" and found.contact == "table"
    assert (corrected.contact["table"] == log.contact["table"]).mean() > 0.95
    assert check_placement(system, log)[0] == []


def _modelled(system: ConstrainedSystem, log: Log) -> np.ndarray:
    state = [torch.from_numpy(x) for x in (log.q, log.qd, log.qdd)]
    tau = dynamics.inverse_dynamics(system.robot, *state).numpy()
    return tau * (1.0 + 0.01 * np.random.default_rng(0).standard_normal(tau.shape))


def _lighter(system: ConstrainedSystem, log: Log) -> np.ndarray:
    return log.tau + dynamics.gravity_force(system.robot, torch.from_numpy(log.q)).numpy()


@pytest.mark.parametrize(
    ("kind", "torque"), [("torque-modelled", _modelled), ("torque-without-gravity", _lighter)]
)
def test_torques_that_are_something_else(
    solver: Case, kind: str, torque: Callable[[ConstrainedSystem, Log], np.ndarray]
) -> None:
    system, log = solver
    report = check(system, log.replace(tau=torque(system, log)))
    families = [f for f in report.findings if f.kind.startswith("torque")]
    assert families[0].kind == kind, report.findings


def test_the_same_robot_with_another_base_is_not_another_robot() -> None:
    robot = forcegp.load_robot("ur5")
    log = free_log(robot, seconds=3.0)
    header = log.header.model_copy(update={"robot": robot.name, "robot_fingerprint": robot.fingerprint})
    turned = forcegp.load_robot("ur5", base_rpy=(0.0, 0.0, 1.0))
    report = check(ConstrainedSystem(turned, []), log.replace(header=header))
    assert "robot-changed" in kinds_of(report) and "robot-mismatch" not in kinds_of(report)
    other = header.model_copy(update={"robot": "ur10"})
    assert "robot-mismatch" in kinds_of(check(ConstrainedSystem(turned, []), log.replace(header=other)))


def test_a_fit_of_another_robot_with_the_same_joints_is_refused() -> None:
    robot = forcegp.load_robot("double_pendulum")
    heavier = replace(robot, mass=2.0 * robot.mass)
    log = free_log(robot, seconds=0.5)
    columns = {name: torch.from_numpy(getattr(log, name)) for name in ("t", "q", "qd", "qdd", "tau")}
    data = forcegp.Dataset(**columns, joint_names=robot.joint_names)
    models = [
        forcegp.StructuredGP(
            forcegp.ConstrainedSystem(one, []), force_priors=[forcegp.priors.JointForcePrior()], noise=0.1
        )
        for one in (robot, heavier)
    ]
    fit = models[1].fit(data, learn=[])
    with pytest.raises(ModelError, match="another robot"):
        models[0].fit(data, learn=[], after=fit)
    assert models[1].fit(data, learn=[], after=fit)
