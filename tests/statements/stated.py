"""Numbers with error bars, read from printed sentences as a user reads them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from forcegp.checks import Report

NUMBER = r"(-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)"


def values(text: str, unit: str) -> list[tuple[float, float]]:
    """Return all "value ± bar unit" in a text."""
    found = re.findall(rf"{NUMBER} ± {NUMBER} {re.escape(unit)}(?![\w/]| m\b| s\b)", text)
    return [(float(value), float(bar)) for value, bar in found]


def friction_of(report: Report, joints: Sequence[str]) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the friction that a report states with bars, by joint and unit (N m or N m s/rad)."""
    text = " ".join(finding.message for finding in report.findings if "friction" in finding.message)
    ends = sorted((match.start(), name) for name in joints for match in re.finditer(rf"\b{name}\b", text))
    found = {}
    for (start, name), (end, _) in zip(ends, [*ends[1:], (len(text), "")], strict=True):
        for value, bar, unit in re.findall(rf"{NUMBER} ± {NUMBER} (N m s/rad|N m)", text[start:end]):
            found[name, unit] = float(value), float(bar)
    return found
