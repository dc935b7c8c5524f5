"""Explanations that a log cannot tell apart are named together; those that it can tell apart are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import forcegp
from forcegp.checks import KINDS, Finding, Report
from forcegp.checks.explain import alternatives_of, with_alternatives
from forcegp.checks.finding import TESTS
from forcegp.checks.fit import BLOCKS, TorqueFit
from forcegp.checks.hypotheses import Hypothesis, unchanged
from forcegp.constraints import ConstrainedSystem

ROWS = ((0, 100),)
GAIN = Finding("torque-gain", "elbow fits when multiplied by 0.6", ROWS, ("elbow",))
MASSES = Finding("masses-mismatch", "other masses fit", ROWS, ("shoulder",))
CURRENT = Finding("torque-current", "currents", ROWS, ("shoulder", "elbow"))


def fit(score: np.ndarray, theta: np.ndarray | None = None) -> TorqueFit:
    none = np.zeros(0)
    return TorqueFit(none, none if theta is None else theta, none, none, none, none, score)


@pytest.fixture
def system() -> ConstrainedSystem:
    return ConstrainedSystem(forcegp.load_robot("double_pendulum"), [])


WOBBLE = 0.1 * np.array([1.0, -1.0] * (BLOCKS // 2))
NULL = fit(np.zeros(BLOCKS))
CHOSEN = Hypothesis("gains", 1, unchanged, joints=(0,)), fit(np.full(BLOCKS, -1.0))
OTHER = Hypothesis("gains", 1, unchanged, joints=(1,))


def names(
    system: ConstrainedSystem, *tried: tuple[Hypothesis, TorqueFit]
) -> list[tuple[str, tuple[int, ...]]]:
    return [(h.name, h.joints) for h, _ in alternatives_of(system, CHOSEN, [CHOSEN, *tried], NULL)]


def test_what_explains_as_much_within_its_error_is_an_alternative(system: ConstrainedSystem) -> None:
    assert names(system, (OTHER, fit(-1.0 + WOBBLE))) == [("gains", (1,))]
    assert names(system, (OTHER, fit(-0.9 + WOBBLE))) == []
    assert names(system, (OTHER, fit(-1.1 + WOBBLE))) == []


def test_what_explains_nothing_on_its_own_is_none(system: ConstrainedSystem) -> None:
    """A score that scatters by more than it gains is within its error of anything."""
    assert names(system, (OTHER, fit(-1.0 + 20.0 * WOBBLE))) == []


def test_links_of_negative_mass_are_none(system: ConstrainedSystem) -> None:
    masses = Hypothesis("masses", 20, unchanged)
    theta = np.zeros(20)
    assert names(system, (masses, fit(-1.0 + WOBBLE, theta))) == [("masses", ())]
    theta[10] = -1.1 * float(system.robot.mass[1])
    assert names(system, (masses, fit(-1.0 + WOBBLE, theta))) == []


def test_masses_are_no_alternative_to_a_tool_which_they_contain(system: ConstrainedSystem) -> None:
    masses = Hypothesis("masses", 20, unchanged), fit(-1.0 + WOBBLE, np.zeros(20))
    tool = replace(CHOSEN[0], name="payload", joints=()), CHOSEN[1]
    assert [*alternatives_of(system, tool, [tool, masses], NULL)] == []


def test_a_finding_names_its_alternatives_and_what_tells_them_apart() -> None:
    found = with_alternatives(GAIN, [MASSES])
    assert found.kinds == ("torque-gain", "masses-mismatch")
    assert GAIN.message in found.message and MASSES.message in found.message
    assert found.told_apart_by == TESTS["torque-gain"] and TESTS["torque-gain"] in found.remedy
    assert all(KINDS[kind].remedy in found.remedy for kind in found.kinds)
    (other,) = found.to_dict()["alternatives"]
    assert other["kind"] == "masses-mismatch" and found.to_dict()["told_apart_by"] == found.told_apart_by
    assert GAIN.to_dict()["alternatives"] == [] and GAIN.remedy == KINDS["torque-gain"].remedy


def test_the_lightest_alternative_decides_on_the_severity() -> None:
    assert CURRENT.severity == "error"
    found = with_alternatives(CURRENT, [MASSES])
    assert found.severity == "warning" and Report((found,), 100, ("shoulder", "elbow")).usable


def test_the_same_kind_at_the_same_joint_is_named_once() -> None:
    assert with_alternatives(GAIN, [replace(GAIN, message="again")]) == GAIN
    elsewhere = replace(GAIN, joints=("shoulder",))
    assert with_alternatives(GAIN, [elsewhere]).alternatives == (elsewhere,)


def test_every_kind_that_the_torque_tells_has_a_test() -> None:
    assert set(TESTS) <= set(KINDS)
