"""The page of a checked log: the verdict, where findings lie, and each finding with a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from forcegp.checks import KINDS, Finding, Log, Report
from forcegp.checks.log import describe, of_robot
from forcegp.constraints import ConstrainedSystem
from forcegp.files import write_text
from forcegp.report.check_pictures import draw_overview, picture_of
from forcegp.report.html import render
from forcegp.report.style import Picture


@dataclass(frozen=True)
class Section:
    """One finding on the page.

    Attributes:
        finding: the finding.
        title: its kind in words, and those of its alternatives.
        rows: the rows in words.
        picture: what it looks like.
    """

    finding: Finding
    title: str
    rows: str
    picture: Picture


def write_check(path: Path, title: str, report: Report, system: ConstrainedSystem, log: Log) -> Path:
    """Write the page of a checked log: one HTML file that needs no other.

    Args:
        path: where it goes.
        title: log and scene.
        report: what was found.
        system, log: what was checked.

    Returns:
        The path.
    """
    log = of_robot(log, system.robot)
    sections = [
        Section(finding, _title(finding), _rows(finding, report), picture_of(finding, system, log))
        for finding in report.findings
    ]
    overview = draw_overview(report) if report.findings else None
    write_text(
        path, render("check.html.j2", title=title, report=report, sections=sections, overview=overview)
    )
    return path


def _title(finding: Finding) -> str:
    return ", or ".join(KINDS[kind].title for kind in finding.kinds)


def _rows(finding: Finding, report: Report) -> str:
    return "all rows" if finding.intervals == ((0, report.samples),) else describe(finding.intervals, most=6)
