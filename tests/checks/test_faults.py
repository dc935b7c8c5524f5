"""Each planted fault is found, at the right rows; logs in order raise nothing but notes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import forcegp
from forcegp.checks import Report, check, excitation, log_of
from forcegp.constraints import ConstrainedSystem
from forcegp.logs import import_log
from forcegp.scene import load_scene
from forcegp.simulate import make_engine, simulate
from planted_faults import FAULTS, REAL, Case, Fault, found, free_log, real_iiwa, real_pendulum, serious
from slow import slow_except

SOLVER: dict[str, Any] = {"engine": "mujoco", "contact": "solver"}
FAST = (
    *("12 samples missing", "a spike of the encoder by 0.3 rad", "degrees"),
    *("torque of the wrong sign", "masses × 0.6 and × 1.5", "noise stated 5 times too small"),
)
"""One fault of each family of checks: clock, values, units, torque, robot file, noise."""
FAST_IN_CONTACT = ("a surface 5 cm too high",)
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="the published logs are not here")


def test_there_are_enough_kinds() -> None:
    assert len({fault.kind for fault in FAULTS}) >= 40


def test_a_clean_log_of_free_motion_is_silent(free: Case) -> None:
    report = check(*free)
    assert serious(report) == set() and report.usable and report.verdict == "verdict: go on"


def test_torques_from_mujoco_are_silent() -> None:
    """The engine's own inverse dynamics is the oracle: a sign or frame of ours cannot excuse itself."""
    robot = forcegp.load_robot("double_pendulum")
    log = free_log(robot, seconds=10.0, seed=4, noise=0.0)
    engine = make_engine(robot, 1.0 / 240.0, "mujoco")
    rows = zip(*(torch.from_numpy(x) for x in (log.q, log.qd, log.qdd)), strict=True)
    tau = torch.stack([engine.inverse_dynamics(*row) for row in rows])
    engine.close()
    tau = tau - forcegp.dynamics.damping_force(robot, torch.from_numpy(log.qd))
    header = log.header.model_copy(update={"noise_std": None})
    assert serious(check(ConstrainedSystem(robot, []), log.replace(tau=tau.numpy(), header=header))) == set()


@pytest.mark.parametrize(
    "fault",
    slow_except((f for f in FAULTS if f.contact is not True), *FAST, name=lambda f: f.name),
    ids=lambda f: f.name,
)
def test_a_fault_in_free_motion_is_found(free: Case, fault: Fault) -> None:
    system, log, rows = fault.plant(*free)
    report = check(system, log)
    assert found(fault, report, log, rows), _told(report)
    if fault.kind == "masses-mismatch":
        assert not report.skipped, "a robot without contacts does not lack their checks"


@pytest.mark.slow
def test_a_clean_log_in_contact_is_silent(touching: Case) -> None:
    assert serious(check(*touching)) == set()


@pytest.mark.parametrize(
    "fault",
    slow_except((f for f in FAULTS if f.contact), *FAST_IN_CONTACT, name=lambda f: f.name),
    ids=lambda f: f.name,
)
def test_a_fault_of_a_contact_is_found(touching: Case, fault: Fault) -> None:
    system, log, rows = fault.plant(*touching)
    report = check(system, log)
    assert found(fault, report, log, rows), _told(report)


PUSH, CURRENT = "a push of 120 rows, 20 to 0.3 N m", "current, at 14 to 6 N m/A"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "solver", "name"),
    [("pendulum_wire", {}, PUSH), ("panda_tilted", SOLVER, CURRENT)],
)
def test_a_fault_is_found_where_little_torque_is_left(scene: str, solver: dict, name: str) -> None:
    """A push along a wire leaves one torque of two; friction makes most of the torque of light wrists."""
    case = _lifting(scene, seed=11, **solver)
    fault = next(fault for fault in FAULTS if fault.name == name)
    system, log, rows = fault.plant(*case)
    report = check(system, log)
    assert found(fault, report, log, rows), _told(report)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 122])
def test_a_wrist_that_sticks_and_slips_is_silent(seed: int) -> None:
    """Joint 5 of this arm hardly moves; when it breaks loose, its dry friction is in the torque.

    It is slower than its declared friction takes to rise (seed 122), and so shows nothing beyond it.
    """
    case = _lifting("panda_sphere", seed=seed, lift_probability=0.2, joint_friction=False, **SOLVER)
    assert serious(check(*case)) <= {"joint-still"}


@pytest.mark.slow
def test_torques_do_not_move_a_tip_off_its_surface() -> None:
    """Torques of this log fit better with 2° added to joint 2, which takes the tip 17 mm off the board."""
    case = _lifting("panda_tilted", seed=9, lift_probability=0.2, joint_friction=False, **SOLVER)
    assert serious(check(*case)) == set()


def _lifting(scene: str, joint_friction: bool = True, **settings: Any) -> Case:
    """A bundled scene in which the tip is lifted now and then."""
    loaded = load_scene(scene)
    config = replace(loaded.simulation, **{"duration": 14.0, "lift_probability": 0.15, **settings})
    if not joint_friction:
        config = replace(config, solver=replace(config.solver, joint_friction=(), joint_damping=()))
    system = loaded.system()
    return system, log_of(simulate(system, config).data)


TRUE_OF_IIWA = {"friction-undeclared", "torque-offset", "joint-still", "velocity-delay"}
"""The robot file declares more damping than the sensors see, they have offsets, and joint 1 hardly moves."""
ON_IIWA = (
    "milliseconds",
    "degrees",
    "torque of the wrong sign",
    "joints exchanged",
    "current, at 14 to 6 N m/A",
    "torque less gravity",
    "masses × 0.6 and × 1.5",
)


@needs_real
@pytest.mark.slow
def test_a_real_log_shows_what_is_true_of_it() -> None:
    report = check(*real_iiwa())
    # A finding that is true may list what looks the same: here a tilt of 1° beside the offsets.
    kinds = {finding.kind for finding in report.findings if finding.severity != "note"}
    assert kinds <= TRUE_OF_IIWA and report.usable, _told(report)


@needs_real
@pytest.mark.slow
@pytest.mark.parametrize("fault", [f for f in FAULTS if f.name in ON_IIWA], ids=lambda f: f.name)
def test_a_fault_in_a_real_log_is_found(fault: Fault) -> None:
    system, log, rows = fault.plant(*real_iiwa())
    report = check(system, log)
    assert found(fault, report, log, rows), _told(report)


@needs_real
def test_the_inertia_of_a_published_pendulum_is_found_wrong(tmp_path: Path) -> None:
    """Its file gives inertias about the joints where URDF asks for the centres of mass."""
    report = check(*real_pendulum(tmp_path, run=2, mended=False))
    assert "masses-mismatch" in serious(report), _told(report)


@needs_real
@pytest.mark.parametrize("run", slow_except((0, 3), "3"))
def test_wrong_masses_of_a_published_pendulum_are_no_tilt_and_no_delay(run: int, tmp_path: Path) -> None:
    """The masses of its file do not fit: gravity of another size and friction of another shape do as well."""
    system, _ = real_pendulum(tmp_path)
    log = sorted((REAL / "double_pendulum/design_C.1").glob("*.csv"))[run]
    data = import_log(log, system, "double_pendulum_csv").data
    report = check(system, data)
    assert "masses-mismatch" in serious(report), _told(report)
    assert not serious(report) & {"base-tilted", "torque-delay"} and report.usable, _told(report)


@pytest.mark.slow
def test_one_fault_does_not_hide_another(free: Case) -> None:
    system, log = free
    tau = -log.tau
    tau[:, 2] += 4.0
    kinds = serious(check(system, log.replace(t=1e3 * log.t, tau=tau)))
    assert {"time-unit", "torque-sign", "torque-offset"} <= kinds


@pytest.mark.slow
def test_filtered_noise_is_reported_unless_the_log_declares_it(free: Case) -> None:
    filtered = next(fault for fault in FAULTS if fault.kind == "noise-filtered")
    system, log, _ = filtered.plant(*free)
    report = check(system, log)
    assert serious(report) == {"noise-filtered"}
    declared = log.header.model_copy(update={"filtered": True})
    assert serious(check(system, log.replace(header=declared))) == set()
    (finding,) = [finding for finding in report.findings if finding.kind == "noise-filtered"]
    small = declared.model_copy(update={"noise_std": float(finding.evidence["white_noise_std"]) / 3.0})
    assert "noise-understated" in serious(check(system, log.replace(header=small)))


@pytest.mark.slow
def test_a_joint_that_turns_more_than_once_is_not_in_degrees() -> None:
    robot = forcegp.load_robot("ur5")
    log = free_log(robot, seconds=10.0)
    q = log.q.copy()
    q[:, 5] += 9.0
    state = [torch.from_numpy(x) for x in (q, log.qd, log.qdd)]
    tau = forcegp.dynamics.inverse_dynamics(robot, *state) - forcegp.dynamics.damping_force(robot, state[1])
    for factor in (1.0, 0.1, -1.0):  # whatever the unit and sign of the torque
        kinds = serious(check(ConstrainedSystem(robot, []), log.replace(q=q, tau=factor * tau.numpy())))
        assert "position-limit" in kinds and "degrees" not in kinds


def test_what_no_fault_can_reach_is_not_given_as_a_size(free: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """An encoder off by more than half a turn, or a base on its head, is no size to wait for."""
    sizes = {"encoder-offset": 4.0, "base-tilted": 181.0}
    monkeypatch.setattr(excitation, "visible_size", lambda told, fault: sizes.get(fault.kind, 0.0))
    (note,) = [finding for finding in check(*free).findings if finding.kind == "faults-hidden"]
    assert "an encoder offset: " in note.message and " rad" not in note.message and " never" in note.message
    monkeypatch.setattr(excitation, "visible_size", lambda told, fault: 3.0)
    (note,) = [finding for finding in check(*free).findings if finding.kind == "faults-hidden"]
    assert "a tilt of the base from 3°" in note.message and " 3 rad" in note.message


def test_an_empty_or_broken_log_is_refused_or_stopped(free: Case) -> None:
    system, log = free
    report = check(system, log.replace(q=np.full_like(log.q, np.nan)))
    assert not report.usable and "not-finite" in serious(report) and report.skipped


@pytest.mark.slow
def test_rows_in_order_of_selection_are_checked_for_what_they_show(free: Case) -> None:
    system, log = free
    order = np.random.default_rng(0).permutation(len(log))[:1500]
    columns = {name: getattr(log, name)[order] for name in ("t", "q", "qd", "qdd", "tau", "segment")}
    header = log.header.model_copy(update={"ordered": False})
    picked = log.replace(**columns, header=header)
    assert serious(check(system, picked)) == set()
    assert "torque-sign" in serious(check(system, picked.replace(tau=-picked.tau)))


def _told(report: Report) -> list[tuple[str, str]]:
    return [(finding.kind, finding.message) for finding in report.findings]
