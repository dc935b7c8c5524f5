"""Estimates that a log does not determine are not given, and a log that is in order is not stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp import dynamics
from forcegp.checks import Log, Report, check, log_of
from forcegp.checks.excitation import Fault, force_of
from forcegp.checks.explain import Explanation
from forcegp.checks.fit import TorqueFit
from forcegp.checks.hypotheses import Hypothesis, plausible, problem_of, unchanged
from forcegp.checks.limits import check_saturation
from forcegp.checks.values import check_stuck
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset, SavitzkyGolay
from forcegp.logs import import_log, parse_mapping
from forcegp.scene import load_scene
from forcegp.simulate import simulate
from logs import random_log
from planted_faults import Case, free_log

PENDULUM = ConstrainedSystem(forcegp.load_robot("double_pendulum"))


@pytest.fixture(scope="module")
def wiped() -> Case:
    """A log of MuJoCo's solver whose joints have friction that the robot file lacks."""
    scene = load_scene("ur5_wiping")
    config = replace(scene.simulation, duration=20.0, dt=0.004, seed=0, lift_probability=0.2)
    return scene.system(), log_of(simulate(scene.system(), config).data)


@pytest.fixture(scope="module")
def wiping(wiped: Case) -> Report:
    return check(*wiped)


def of_kind(report: Report, kind: str) -> list:
    return [finding for finding in report.findings if finding.kind == kind]


@pytest.mark.slow
def test_friction_of_a_contact_is_not_that_of_the_joints(wiping: Report) -> None:
    """It was 70 % where it is 30, as the friction of the joints passed for a force at the tip."""
    (finding,) = of_kind(wiping, "contact-friction")
    assert 0.25 < float(finding.evidence["friction_coefficient"]) < 0.35


@pytest.mark.slow
def test_friction_that_would_drive_a_joint_is_not_determined(wiping: Report) -> None:
    """It was −12 N m s/rad at the shoulder, where 3 is right."""
    (finding,) = of_kind(wiping, "friction-undeclared")
    sizes = {name: float(x) for name, x in finding.evidence.items()}
    assert "shoulder_lift_joint" in finding.joints and "not determined" in finding.message
    assert "viscous shoulder_lift_joint" not in sizes and min(sizes.values()) > 0.0


def heavier(system: ConstrainedSystem, link: int, share: float) -> ConstrainedSystem:
    factor = 1.0 + share * (torch.arange(system.robot.nq) == link).double()
    robot = system.robot
    changed = {"mass": robot.mass * factor, "inertia": robot.inertia * factor[:, None, None]}
    return system.with_robot(replace(robot, **changed))


def leaning(system: ConstrainedSystem, degrees: float) -> ConstrainedSystem:
    angle = np.radians(degrees)
    gravity = 9.81 * torch.tensor([np.sin(angle), 0.0, -np.cos(angle)], dtype=torch.float64)
    return system.with_robot(replace(system.robot, gravity=gravity))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rival", "size"),
    [("base-tilted", "base-tilted", 5.0), ("heavier-link elbow_joint", "masses-mismatch", 0.3)],
)
def test_what_this_motion_hides_is_said(
    name: str, rival: str, size: float, wiping: Report, wiped: Case
) -> None:
    """The clean log says that the fault is too small; where an offset is reported for it, it is a rival."""
    (note,) = of_kind(wiping, "faults-hidden")
    assert note.evidence[name] > size
    assert "a tilt of the base " in note.message and "a heavier link: " in note.message
    assert "(3°: force at the contact off by about " in note.message
    system = leaning(wiped[0], size) if name == "base-tilted" else heavier(wiped[0], 2, size)
    (offset,) = of_kind(check(system, wiped[1]), "torque-offset")
    assert rival in offset.kinds[1:] and offset.told_apart_by


@pytest.mark.slow
def test_a_torque_that_drifts_is_found_with_its_size(free: Case) -> None:
    system, log = free
    drift = np.linspace(0.0, 6.0, len(log))[:, None] * (np.arange(log.nq) == 1)
    found = of_kind(check(system, log.replace(tau=log.tau + drift)), "torque-offset")
    (finding,), joint = [f for f in found if "drifts" in f.message], log.joint_names[1]
    assert finding.joints == (joint,)
    assert float(finding.evidence[f"drift {joint}"]) == pytest.approx(6.0, rel=0.1)


def test_positions_later_than_their_velocities_are_found(free: Case) -> None:
    system, log = free
    late = np.concatenate([np.repeat(log.q[:1], 8, axis=0), log.q[:-8]])
    found = of_kind(check(system, log.replace(q=late)), "velocity-delay")
    assert found and "ahead of the rate of change" in found[0].message


def test_a_tool_that_the_arm_does_not_carry_is_found(free: Case) -> None:
    """The file states 0.5 kg too much at the last link, where its own link has more than that."""
    system, log = free
    robot = system.robot
    mass = robot.mass.clone()
    mass[-1] += 0.5
    findings = check(system.with_robot(replace(robot, mass=mass)), log).findings
    (finding,) = (f for f in findings if "payload-missing" in f.kinds)
    assert float(finding.evidence["mass_kg"]) == pytest.approx(-0.5, abs=0.1) and "less" in finding.message


def test_a_cause_comes_before_what_a_fit_learns(free: Case) -> None:
    """A late torque before the friction of a joint, however large; of offset and friction the larger."""
    system, log = free
    dry = 4.0 * np.tanh(log.qd / 0.02) * (np.arange(log.nq) == 0)
    late = np.roll(log.tau + dry + np.array([0.0, 0.0, 1.0, 0.0]), round(0.06 / log.dt), axis=0)
    kinds = [f.kind for f in check(system, log.replace(tau=late)).findings if f.severity == "warning"]
    assert kinds[:2] == ["torque-delay", "friction-undeclared"]


@pytest.mark.slow
def test_what_an_import_saw_of_the_clock_is_a_finding(free: Case) -> None:
    system, log = free
    seen = (
        ("faster than its source", "800 rows (80 %) repeat"),
        ("gap", "2 gaps"),
        ("jitter", "by up to 69 %"),
        ("lost", "q jumps in 3 rows"),
    )
    header = log.header.model_copy(update={"imported": seen})
    findings = check(system, log.replace(header=header)).findings
    assert [f.kind for f in findings[:3]] == ["rows-held", "time-gap", "time-jitter"]
    assert findings[1].message == "2 gaps; q jumps in 3 rows"
    assert findings[0].severity == "error"


@pytest.mark.slow
def test_a_late_torque_is_found_if_it_is_not_said_to_be_hidden(wiping: Report, wiped: Case) -> None:
    (note,) = of_kind(wiping, "faults-hidden")
    late = wiped[1].replace(tau=np.roll(wiped[1].tau, 10, axis=0))
    assert note.evidence["torque-delay"] < 0.04 and of_kind(check(wiped[0], late), "torque-delay")


def test_the_force_of_a_hidden_fault_is_what_no_fit_takes_for_friction(touching: Case) -> None:
    """A torque Jᵀf is a force |f|; a constant torque is an offset, which a fit learns, and no force."""
    system, log = touching
    rows = log.rows(400)
    problem = problem_of(system, log, rows)
    model = Explanation(system, log, rows, problem, np.zeros((*problem.r.shape, 0)), np.zeros(0))
    force = np.array([3.0, 0.0, -4.0])
    fault = Fault("base-tilted", "", np.einsum("nkj,k->nj", problem.J, force), log.nq)
    assert force_of(model, fault) == pytest.approx(5.0, rel=1e-6)
    constant = replace(fault, column=np.ones_like(problem.r))
    assert force_of(model, constant) == pytest.approx(0.0, abs=1e-4)


def torque_fit(theta: list[float], spread: list[float]) -> TorqueFit:
    none = np.zeros((8, 2))
    return TorqueFit(none, np.array(theta), np.array(spread), none, none, none, none)


@pytest.mark.parametrize(
    ("name", "theta", "spread", "possible"),
    [
        ("encoder-offset", [0.1], [0.01], True),
        ("encoder-offset", [2.11], [0.40], False),  # 121° ± 23°
        ("encoder-offset", [0.1], [0.2], False),
        ("gravity", [0.0, 0.0, -33.1], [0.1, 0.1, 0.1], False),  # 42.9 m/s²
        ("gravity", [0.0, 0.0, -1.5], [0.1, 0.1, 0.1], False),
        ("gravity", [1.02, 0.0, 0.05], [0.1, 0.1, 0.1], True),  # a base tilted by 6°
        ("gravity", [0.0, 0.0, 9.7], [0.1, 0.1, 0.1], True),  # a torque without gravity
        ("gravity", [9.81, 0.0, 9.81], [0.1, 0.1, 0.1], True),
        ("gains", [0.5], [0.7], False),
        ("gains", [0.5], [0.1], True),
    ],
)
def test_an_estimate_outside_physics_or_below_its_error_is_none(
    name: str, theta: list[float], spread: list[float], possible: bool
) -> None:
    hypothesis = Hypothesis(name, len(theta), unchanged, joints=(0,))
    assert plausible(PENDULUM, hypothesis, torque_fit(theta, spread)) is possible


def test_a_joint_that_stands_has_no_stuck_acceleration(free: Case) -> None:
    """The acceleration of a joint at rest is one value, however the rest of the arm moves."""
    system, log = free
    columns = {name: getattr(log, name).copy() for name in ("q", "qd", "qdd")}
    rest = slice(len(log) // 3, 2 * len(log) // 3)
    columns["q"][rest, 2] = columns["q"][rest.start, 2]
    columns["qd"][rest, 2] = columns["qdd"][rest, 2] = 0.0
    findings, _ = check_stuck(system, log.replace(**columns))
    assert [f.message for f in findings if "qdd" in f.message] == []
    columns["q"], columns["qd"] = log.q, log.qd  # the joint moves, and its acceleration does not
    findings, _ = check_stuck(system, log.replace(**columns))
    assert [f.kind for f in findings] == ["channel-stuck"]


def test_broad_peaks_of_a_torque_are_no_limit() -> None:
    """One long pose with an extreme torque, and short visits near it, are no drive that saturates."""
    t = 1e-3 * np.arange(3000)
    peaks = ((0.6, 0.3, 1.0), (1.6, 0.006, 0.985), (2.4, 0.006, 0.99))
    bumps = sum(h * np.exp(-(((t - at) / width) ** 6)) for at, width, h in peaks)
    tau = np.where(
        bumps > 0.5, 4.0 * bumps, np.sin(40.0 * t) + np.sin(23.0 * t)
    ) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    qd = np.sin(7.0 * t + 0.3)
    log = log_of(random_log(len(t), joints=PENDULUM.robot.joint_names))
    log = log.replace(t=t, tau=np.column_stack([tau, 2.0 * np.sin(t)]), qd=np.column_stack([qd, qd]))
    assert check_saturation(PENDULUM, log)[0] == []


def fast_log(path: Path, window: int, order: int) -> Log:
    """A fast motion whose accelerations a filter computed, read back from its file."""
    robot = PENDULUM.robot
    t = 0.004 * torch.arange(3000, dtype=torch.float64)
    rate = torch.tensor([9.0, 11.0], dtype=torch.float64)
    q, qd = torch.sin(t[:, None] * rate), rate * torch.cos(t[:, None] * rate)
    tau = dynamics.inverse_dynamics(robot, q, qd, -(rate**2) * q)
    table = {
        f"{n}.{j}": x[:, i]
        for n, x in (("q", q), ("qd", qd), ("tau", tau))
        for i, j in enumerate(robot.joint_names)
    }
    lines = [",".join(["t", *table])]
    lines += [",".join(f"{float(x):.9g}" for x in row) for row in zip(t, *table.values(), strict=True)]
    path.write_text("\n".join(lines))
    return log_of(Dataset.read(path, differentiate=SavitzkyGolay(window, order)))


@pytest.mark.slow
def test_an_acceleration_that_was_computed_here_is_no_reason_to_stop(tmp_path: Path) -> None:
    report = check(PENDULUM, fast_log(tmp_path / "log.csv", 121, 2))
    assert report.usable and [f.remedy for f in of_kind(report, "filter-wide")] == [
        "import with a narrower window"
    ]
    report = check(PENDULUM, fast_log(tmp_path / "log.csv", 11, 3))
    assert not of_kind(report, "filter-wide") and report.usable


def test_what_an_import_doubted_is_not_forgotten(tmp_path: Path) -> None:
    """CHECK lines that the user left in the mapping, and what the import found, travel with the log."""
    log = free_log(PENDULUM.robot, seconds=4.0)
    names = [f"{name}.{joint}" for name in ("q", "qd", "tau") for joint in log.joint_names]
    table = np.column_stack([log.t, log.q, log.qd, log.tau])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header=",".join(["t", *names]), comments="")
    shoulder, elbow = log.joint_names
    mapping = f"""
time = {{ column = "t" }}
position = {{ columns = {{ {shoulder} = "q.{shoulder}", {elbow} = "q.{elbow}" }}, unit = "rad" }}
# CHECK: a current: give the gear ratio
torque = {{ columns = {{ {shoulder} = "tau.{shoulder}", {elbow} = "tau.{elbow}" }}, unit = "Nm" }}
"""
    imported = import_log(tmp_path / "run.csv", PENDULUM, parse_mapping(mapping.encode(), "mapping"))
    imported.data.write(tmp_path / "log.parquet")
    data = Dataset.read(tmp_path / "log.parquet")
    assert data.header.derived == ("qd", "qdd")
    (finding,) = of_kind(check(PENDULUM, data), "import-doubt")
    assert finding.message == "a current: give the gear ratio" and finding.severity == "warning"


@pytest.mark.parametrize("seed", [0, 2])
def test_friction_of_joints_that_stick_is_no_other_fault(seed: int) -> None:
    """Joints reverse where they accelerate most, and hold any load at rest."""
    scene = load_scene("ur5_free")
    config = replace(scene.simulation, duration=12.0, seed=seed)
    report = check(scene.system(), log_of(simulate(scene.system(), config).data))
    named = {kind for f in report.findings if f.severity != "note" for kind in f.kinds}
    assert named == {"friction-undeclared", "joint-still"}
