"""Faults of the clock are named as such, and nothing else is blamed for them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import forcegp
from forcegp.checks import Log, check
from forcegp.constraints import ConstrainedSystem
from planted_faults import Case, _keep, free_log, serious

DT = 1.0 / 240.0


@pytest.fixture(scope="module")
def pendulum() -> Case:
    robot = forcegp.load_robot("double_pendulum")
    return ConstrainedSystem(robot, []), free_log(robot, seconds=10.0)


def _derived(log: Log, *names: str) -> Log:
    """The log as if an import had computed the named columns."""
    header = log.header.model_copy(update={"derived": names, "noise_std": None, "dt": None})
    return log.replace(header=header)


def _bursts(count: int) -> Callable[[np.ndarray], np.ndarray]:
    """Messages that arrive together, `count` at a time, 20 µs apart."""
    return lambda k: DT * count * (k // count) + 2e-5 * (k % count)


DERIVED: list[tuple[str, ...]] = [(), ("qdd",), ("qd", "qdd")]
"""Columns that an import computed."""
CLOCKS = {
    "bursts of 10": _bursts(10),
    "bursts of 2": _bursts(2),
    "whole seconds": lambda k: np.floor(DT * k),
    "steps of 50 ms": lambda k: 0.05 * np.floor(DT * k / 0.05),
}


@pytest.mark.parametrize(("clock", "derived"), zip(CLOCKS.values(), [*DERIVED, ()], strict=True), ids=CLOCKS)
def test_a_clock_that_jumps_or_comes_in_bursts_alone_is_to_blame(
    pendulum: Case, clock: Callable[[np.ndarray], np.ndarray], derived: tuple[str, ...]
) -> None:
    system, log = pendulum
    report = check(system, _derived(log, *derived).replace(t=clock(np.arange(len(log)))))
    assert serious(report) == {"time-bursts"}
    found = report.findings[0]
    assert found.evidence["period"] == pytest.approx(DT, rel=0.02) and found.severity == "error"
    assert "contact" not in " ".join(f.message for f in report.findings)


def test_a_burst_per_segment_is_still_the_clock(pendulum: Case) -> None:
    """An import starts a segment after each gap."""
    system, log = pendulum
    k = np.arange(len(log))
    report = check(system, _derived(log, "qdd").replace(t=_bursts(12)(k), segment=k // 12))
    assert serious(report) == {"time-bursts"}


def test_gaps_in_time_that_the_motion_confirms_are_gaps(pendulum: Case) -> None:
    system, log = pendulum
    keep = np.arange(len(log)) % 100 < 20
    kinds = serious(check(system, _keep(log, keep)))
    assert "time-gap" in kinds and not kinds & {"time-bursts", "rows-lost"}


@pytest.mark.parametrize(
    ("factor", "derived"), zip([1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9], [*DERIVED, *DERIVED], strict=True), ids=str
)
def test_a_unit_that_is_off_is_the_fault_of_the_clock(
    pendulum: Case, factor: float, derived: tuple[str, ...]
) -> None:
    system, log = pendulum
    report = check(system, _derived(log, *derived).replace(t=factor * log.t))
    kinds = serious(report) - {"period-header"}
    assert kinds == {"time-unit"} and report.findings[0].kind == "time-unit"
    assert report.findings[0].evidence["seconds_per_unit"] == pytest.approx(1.0 / factor, rel=0.05)


@pytest.mark.parametrize("derived", [(), ("qdd",)], ids=", ".join)
def test_minutes_are_told_from_degrees_by_velocities(pendulum: Case, derived: tuple[str, ...]) -> None:
    system, log = pendulum
    report = check(system, _derived(log, *derived).replace(t=log.t / 60.0))
    assert serious(report) - {"period-header"} == {"time-unit"}
    assert report.findings[0].evidence["seconds_per_unit"] == pytest.approx(60.0, rel=0.01)


@pytest.mark.parametrize("derived", [(), ("qdd",)], ids=", ".join)
def test_positions_in_degrees_are_no_minutes(pendulum: Case, derived: tuple[str, ...]) -> None:
    system, log = pendulum
    kinds = serious(check(system, _derived(log, *derived).replace(q=np.degrees(log.q))))
    assert "degrees" in kinds and "time-unit" not in kinds


def _every_seventh(random: np.random.Generator, n: int) -> np.ndarray:
    return np.arange(n) % 7 != 6


def _thirty_per_cent(random: np.random.Generator, n: int) -> np.ndarray:
    return random.random(n) > 0.3


def _one_per_cent(random: np.random.Generator, n: int) -> np.ndarray:
    return random.random(n) > 0.01


@pytest.mark.parametrize(
    ("lose", "derived"), zip([_every_seventh, _thirty_per_cent, _one_per_cent], DERIVED, strict=True)
)
def test_rows_that_are_lost_and_renumbered_are_found(
    pendulum: Case, lose: Callable[[np.random.Generator, int], np.ndarray], derived: tuple[str, ...]
) -> None:
    system, log = pendulum
    keep = lose(np.random.default_rng(0), len(log))
    less = _keep(_derived(log, *derived), keep)
    report = check(system, less.replace(t=log.t[: len(less)]))
    assert serious(report) == {"rows-lost"}
    missing = report.findings[0].evidence["missing_samples"]
    # A lower limit: a lost row is counted only beside rows that are one step apart.
    assert 0.45 * (~keep).sum() < missing <= 1.05 * (~keep).sum()


def test_clean_logs_have_a_clean_clock(pendulum: Case) -> None:
    system, log = pendulum
    assert not serious(check(system, log))
    coarse = np.round(log.q / 2e-3) * 2e-3
    kinds = serious(check(system, _derived(log.replace(q=coarse), "qd", "qdd")))
    assert not kinds & {"time-bursts", "rows-lost", "time-unit"}


@pytest.mark.parametrize(
    ("rows", "rate"), [(1, 1e3), (5, 1e4), (30, 1e3), (400, 1e4), (800, 1e3), (800, 1e4)]
)
@pytest.mark.parametrize("derived", [(), ("qd", "qdd")], ids=", ".join)
def test_short_logs_are_checked_or_too_short(rows: int, rate: float, derived: tuple[str, ...]) -> None:
    robot = forcegp.load_robot("double_pendulum")
    log = free_log(robot, seconds=800 * DT)
    log = _keep(log, np.arange(len(log)) < rows)
    log = _derived(log.replace(t=np.arange(rows) / rate), *derived)
    report = check(ConstrainedSystem(robot, []), log)
    kinds = {finding.kind for finding in report.findings}
    assert rows / rate > 1.9 or kinds & {"log-short", "time-scale"}
