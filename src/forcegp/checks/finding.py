"""Findings, the report of a check, and the table of all kinds of findings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import Any, Literal, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from forcegp.errors import check_name
from forcegp.rows import Intervals, describe, intervals
from forcegp.scene.document import tomllib

Severity = Literal["note", "warning", "error"]


@dataclass(frozen=True)
class Kind:
    """A kind of finding with its family, default severity, title and remedy."""

    family: str
    severity: Severity
    title: str
    remedy: str


_FAMILIES = tomllib.loads((files("forcegp.checks") / "kinds.toml").read_text(encoding="utf-8"))
TESTS: dict[str, str] = _FAMILIES.pop("tests")
"""For each kind of fault, tests that distinguish it from its alternatives, in order of preference."""
KINDS = {name: Kind(family, *row) for family, rows in _FAMILIES.items() for name, row in rows.items()}
"""All kinds of findings, keyed by name."""


SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Severities, from most to least severe."""


@dataclass(frozen=True)
class Finding:
    """A fault or property of a log that a check has found.

    Args:
        kind: a key of `KINDS`.
        message: a sentence that states the relevant numbers.
        intervals: affected rows as half-open intervals in increasing order. Rows are counted from 0.
        joints: names of the affected joints.
        contact: name of the affected contact, if any.
        evidence: numbers on which the message is based, keyed by name.
        weight: the severity, if it differs from the default severity of the kind.
        alternatives: other explanations that fit the log equally well.
        told_apart_by: a test that distinguishes the alternatives.

    Raises:
        UnknownNameError: the kind does not exist.
    """

    kind: str
    message: str
    intervals: Intervals
    joints: tuple[str, ...] = ()
    contact: str | None = None
    evidence: Mapping[str, SupportsFloat] = field(default_factory=dict)
    weight: Severity | None = None
    alternatives: tuple[Finding, ...] = ()
    told_apart_by: str | None = None

    def __post_init__(self) -> None:
        check_name("kind of finding", self.kind, KINDS)

    @property
    def severity(self) -> Severity:
        """Severity of the finding.

        An `"error"` makes a fit worthless, a `"warning"` marks a fault that biases the fit, and a `"note"` is
        worth knowing. A finding with alternatives has the lowest of their severities.
        """
        weight: Severity = self.weight or KINDS[self.kind].severity
        every = {weight, *(other.severity for other in self.alternatives)}
        return next(severity for severity in reversed(SEVERITIES) if severity in every)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the finding and its alternatives, without duplicates."""
        return tuple(dict.fromkeys((self.kind, *(other.kind for other in self.alternatives))))

    @property
    def remedy(self) -> str:
        """Remedy for the fault, or a test and one remedy per fault if there are alternatives."""
        if not self.alternatives:
            return KINDS[self.kind].remedy
        each = "; ".join(f"{kind}: {KINDS[kind].remedy}" for kind in self.kinds)
        return f"{self.told_apart_by}; then {each}" if self.told_apart_by else each

    @property
    def rows(self) -> int:
        """Number of affected rows."""
        return sum(stop - start for start, stop in self.intervals)

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as JSON-compatible values."""
        plain = ("kind", "severity", "message", "remedy", "contact", "told_apart_by")
        return {name: getattr(self, name) for name in plain} | {
            "kinds": list(self.kinds),
            "intervals": [list(interval) for interval in self.intervals],
            "joints": list(self.joints),
            "evidence": {name: float(value) for name, value in self.evidence.items()},
            "alternatives": [other.to_dict() for other in self.alternatives],
        }


def with_alternatives(finding: Finding, others: Iterable[Finding]) -> Finding:
    """Return the finding with any alternatives, and with a test that distinguishes them."""
    alternatives: list[Finding] = []
    for other in others:
        alike = (f for f in (finding, *alternatives) if f.kind == other.kind)
        if not any({*f.joints} & {*other.joints} or not other.joints for f in alike):
            alternatives.append(other)
    if not alternatives:
        return finding
    message = "; or ".join(one.message for one in (finding, *alternatives))
    test = next(TESTS[kind] for kind in TESTS if kind in {finding.kind, *(f.kind for f in alternatives)})
    return replace(finding, message=message, alternatives=tuple(alternatives), told_apart_by=test)


def at_rows(
    mask: NDArray[np.bool_], kind: str, text: str, joints: tuple[str, ...] = (), **evidence: SupportsFloat
) -> list[Finding]:
    """Return a list with one finding that names the rows selected by a mask, or an empty list."""
    rows = intervals(mask)
    return [Finding(kind, f"{text} {describe(rows)}", rows, joints, evidence=evidence)] if rows else []


class NotJudgedError(Exception):
    """Raised if a check cannot be applied to a log. The message is stored in `Report.skipped`."""


@dataclass(frozen=True)
class Report:
    """All findings on a log, sorted by severity, and the reasons why checks were skipped."""

    findings: tuple[Finding, ...]
    samples: int
    joint_names: tuple[str, ...]
    skipped: Mapping[str, str] = field(default_factory=dict)

    def count(self, severity: Severity) -> int:
        """Return the number of findings with a given severity."""
        return sum(finding.severity == severity for finding in self.findings)

    @property
    def usable(self) -> bool:
        """Whether a model can be fitted to the log."""
        return self.count("error") == 0

    @property
    def verdict(self) -> str:
        """One-line verdict on whether a model can be fitted."""
        errors, warnings = self.count("error"), self.count("warning")
        if errors:
            return f"verdict: stop; repair {errors} error{'s' * (errors > 1)} before fitting a model"
        if warnings:
            return f"verdict: go on with care; {warnings} warning{'s' * (warnings > 1)} to review"
        return "verdict: go on"

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON-compatible values."""
        return {
            "samples": self.samples,
            "joint_names": list(self.joint_names),
            "usable": self.usable,
            "verdict": self.verdict,
            "findings": [finding.to_dict() for finding in self.findings],
            "skipped": dict(self.skipped),
        }
