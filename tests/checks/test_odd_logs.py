"""Logs that are in order but unusual: at rest, passive, unordered, never in contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import forcegp
from forcegp.checks import Log, check, log_of
from forcegp.checks.explain import _possible
from forcegp.checks.finding import Finding, with_alternatives
from forcegp.checks.fit import cross_validate
from forcegp.checks.hypotheses import Hypothesis, problem_of, unchanged
from forcegp.scene import load_scene
from forcegp.simulate import simulate
from planted_faults import Case, free_log, serious


@pytest.fixture(scope="module")
def wire() -> Case:
    """The double pendulum on a wire, with lifts."""
    scene = load_scene("pendulum_wire")
    config = replace(scene.simulation, duration=8.0, lift_probability=0.3, seed=3)
    return scene.system(), log_of(simulate(scene.system(), config).data)


def kinds_of(case: Case) -> set[str]:
    return {kind for finding in check(*case).findings for kind in finding.kinds}


def rested(log: Log, rows: int) -> Log:
    """The log after a rest in the first pose that is in contact."""
    first = int(np.argmax(log.contact["wire"]))

    def led(x: np.ndarray, value: float | None = None) -> np.ndarray:
        head = np.repeat(x[first : first + 1], rows, axis=0)
        return np.concatenate([head if value is None else np.full_like(head, value), x])

    t = np.concatenate([log.t[0] - log.dt * np.arange(rows, 0, -1), log.t])
    contact = {"wire": led(log.contact["wire"])}
    segment = np.concatenate([np.zeros(rows, np.int64), log.segment + 1])
    return log.replace(
        t=t, q=led(log.q), qd=led(log.qd, 0.0), qdd=led(log.qdd, 0.0), tau=led(log.tau), contact=contact,
        segment=segment,
    )  # fmt: skip


def unlabelled(log: Log, kept: int = 0) -> Log:
    closed = np.flatnonzero(log.contact["wire"])
    return log.replace(contact={"wire": np.isin(np.arange(len(log)), closed[:kept])})


@pytest.mark.slow  # three checks
def test_a_rest_in_contact_hides_no_contact_that_was_missed(wire: Case) -> None:
    system, log = wire
    closed = np.flatnonzero(log.contact["wire"])
    missed = log.contact["wire"].copy()
    missed[closed[len(closed) // 2 :][:60]] = False
    wrong = log.replace(contact={"wire": missed})
    assert "contact-missed" in kinds_of((system, wrong))
    assert "contact-missed" in kinds_of((system, rested(wrong, len(closed))))
    assert not {"contact-missed", "contact-early"} & kinds_of((system, rested(log, len(closed))))


@pytest.mark.parametrize("kept", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_a_contact_column_that_is_hardly_ever_true(wire: Case, kept: int) -> None:
    system, log = wire
    assert "contact-missed" in kinds_of((system, unlabelled(log, kept)))


def test_one_joint_without_torque_is_a_warning(wire: Case) -> None:
    system, log = wire
    tau = log.tau.copy()
    tau[:, 1] = 0.0
    report = check(system, log.replace(tau=tau))
    (found,) = (finding for finding in report.findings if finding.kind == "torque-zero")
    assert found.severity == "warning" and found.joints == (log.joint_names[1],)


def test_an_arm_at_rest_says_nothing_of_the_clock(wire: Case) -> None:
    system, log = wire
    still = np.repeat(log.q[:1], len(log), axis=0)
    kinds = kinds_of((system, log.replace(q=still, qd=0 * log.qd, qdd=0 * log.qdd)))
    assert "joint-still" in kinds and not {"time-scale", "time-unit", "log-short"} & kinds


def test_what_cannot_be_judged_is_told(wire: Case) -> None:
    system, log = wire
    pieces = log.replace(segment=np.arange(len(log), dtype=np.int64) // 30)
    assert "fewer than 200 rows" in check(system, pieces).skipped["dynamics"]
    apart = log.replace(
        segment=np.arange(len(log), dtype=np.int64), header=log.header.model_copy(update={"ordered": False})
    )
    assert check(system, apart).samples == len(log)


def test_alternatives_of_one_kind_are_named_once() -> None:
    def of(kind: str, text: str, *joints: str) -> Finding:
        return Finding(kind, text, ((0, 1),), joints)

    gain, late, later = of("torque-gain", "gain", "a"), of("torque-delay", "8 rows"), of("torque-delay", "11")
    found = with_alternatives(gain, [late, later, of("torque-gain", "again", "a", "b")])
    assert found.alternatives == (late,)
    assert found.to_dict()["kinds"] == ["torque-gain", "torque-delay"]


@pytest.mark.parametrize(("change", "possible"), [(0.0, True), (1.0, True), (-10.0, False)])
def test_a_link_without_mass_may_stay_without(wire: Case, change: float, possible: bool) -> None:
    system, log = wire
    robot = system.robot
    massless = replace(system, robot=robot.replace(mass=robot.mass * (robot.mass == robot.mass.max())))
    rows = log.rows(400, margin=20)
    columns = np.zeros((len(rows), log.nq, 10 * log.nq))
    masses = Hypothesis("masses", 20, unchanged, columns)
    fit = cross_validate(problem_of(massless, log, rows), columns)
    theta = np.zeros(10 * log.nq)
    theta[10 * int(np.argmax(robot.mass.numpy()))] = change
    assert _possible(massless, masses, replace(fit, theta=theta)) == possible


def test_every_explanation_of_the_torque_can_be_an_alternative() -> None:
    """Two joints of which either may drift: both are torque offsets, and a test tells them apart."""
    one, two = (Finding("torque-offset", f"{j} drifts", ((0, 9),), (j,)) for j in "ab")
    both = with_alternatives(one, [two])
    assert both.message == "a drifts; or b drifts" and both.told_apart_by


def test_what_concerns_the_whole_log_comes_first() -> None:
    """A spike of one row must not hide that the clock is wrong; both are warnings."""
    robot = forcegp.load_robot("double_pendulum")
    log = free_log(robot, seconds=6.0)
    q, k = log.q.copy(), len(log) // 2
    q[k, 0] += 0.3
    report = check(forcegp.ConstrainedSystem(robot), log.replace(q=q, tau=log.tau + np.array([3.0, 0.0])))
    warnings = [finding.kind for finding in report.findings if finding.severity == "warning"]
    assert warnings[:2] == ["torque-offset", "spike"]


@pytest.mark.slow
def test_a_torque_that_is_not_logged_is_no_fault() -> None:
    """A motor without a sensor, declared in the header: its column holds zeros, and no finding names it."""
    robot = forcegp.load_robot("double_pendulum")
    log = free_log(robot, seconds=10.0)
    header = log.header.model_copy(update={"unmeasured_torques": (robot.joint_names[0],)})
    blind = log.replace(tau=log.tau * [0.0, 1.0])
    system = forcegp.ConstrainedSystem(robot)
    assert "torque-zero" in {finding.kind for finding in check(system, blind).findings}
    report = check(system, blind.replace(header=header))
    assert [finding.kind for finding in report.findings if finding.severity != "note"] == []


def test_milliseconds_beside_an_acceleration_that_the_import_derived() -> None:
    robot = forcegp.load_robot("double_pendulum")
    log = free_log(robot, seconds=6.0, noise=0.0)
    header = log.header.model_copy(update={"derived": ("qdd",), "dt": 1e3 * log.dt})
    late = log.replace(t=1e3 * log.t, qdd=1e-3 * log.qdd, header=header)
    kinds = [finding.kind for finding in check(forcegp.ConstrainedSystem(robot), late).findings]
    assert kinds[0] == "time-unit" and "filter-wide" not in kinds and "masses-mismatch" not in kinds


@pytest.mark.slow
def test_a_pulse_of_the_torque_that_drives_the_arm_is_no_outlier(free: Case) -> None:
    """A controller's pulse of one row, larger than the torque is elsewhere, accelerates every joint."""
    system, log = free
    k, pulse = 700, np.zeros(log.nq)
    pulse[0] = 2.0 * np.ptp(log.tau[:, 0])
    M = forcegp.dynamics.mass_matrix(system.robot, torch.from_numpy(log.q[k])).numpy()
    tau, qdd = log.tau.copy(), log.qdd.copy()
    tau[k] += pulse
    outliers = [f for f in check(system, log.replace(tau=tau)).findings if f.kind == "spike"]
    assert [f.intervals for f in outliers] == [((k, k + 1),)], (
        "a wrong value, without the motion that it makes"
    )
    qdd[k] += np.linalg.solve(M, pulse)
    assert "spike" not in serious(check(system, log.replace(tau=tau, qdd=qdd)))
