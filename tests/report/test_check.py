"""The page of a checked log: the colour of its verdict, and pictures of what a finding names, over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import forcegp
from forcegp.checks import Finding, Log, check
from forcegp.report.check import picture_of, write_check
from planted_faults import free_log

ROBOT = forcegp.load_robot("kuka_iiwa")
SYSTEM = forcegp.ConstrainedSystem(ROBOT)
LOG = free_log(ROBOT, seconds=4.0)
NAMES = ROBOT.joint_names


def page(folder: Path, log: Log) -> str:
    path = write_check(folder / "check.html", "a log", check(SYSTEM, log), SYSTEM, log)
    return path.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_verdict_is_green_amber_or_red(tmp_path: Path) -> None:
    assert '<p class="yes"><strong>verdict: go on<' in page(tmp_path, LOG)
    offset = LOG.replace(tau=LOG.tau + 3.0 * (np.arange(7) == 3))
    assert '<p class="care"><strong>verdict: go on with care' in page(tmp_path, offset)
    assert '<p class="stop"><strong>verdict: stop' in page(tmp_path, LOG.replace(tau=-LOG.tau))


@pytest.mark.parametrize(
    ("kind", "quantity"),
    [("acceleration-mismatch", "qdd"), ("velocity-sign", "qd"), ("torque-offset", "tau"), ("impact", "qd")],
)
def test_all_joints_of_a_finding_are_drawn_in_its_quantity(kind: str, quantity: str) -> None:
    joints = tuple(NAMES[k] for k in (0, 2, 3, 4, 6))
    picture = picture_of(Finding(kind, "something", LOG.all_rows, joints), SYSTEM, LOG)
    assert picture is not None and picture.alt.startswith(f"{quantity} of {', '.join(joints)} in rows 0 to ")


def test_pictures_are_over_time_unless_the_clock_is_at_fault() -> None:
    finding = Finding("torque-offset", "something", LOG.all_rows, NAMES[:1])
    wrong = LOG.t.copy()
    wrong[50] = wrong[48]
    labels = [drawn(finding, log) for log in (LOG, LOG.replace(t=wrong))]
    assert "time [s]" in labels[0] and "row" not in labels[0] and "row" in labels[1]
    assert "tau [N m]" in labels[0]


def drawn(finding: Finding, log: Log) -> list[str]:
    """Texts of a picture, which SVG holds as comments."""
    picture = picture_of(finding, SYSTEM, log)
    assert picture is not None
    return [line.strip()[5:-4] for line in picture.svg.splitlines() if line.strip().startswith("<!-- ")]


def test_what_an_import_found_has_no_picture() -> None:
    assert picture_of(Finding("import-doubt", "something", LOG.all_rows), SYSTEM, LOG) is None
